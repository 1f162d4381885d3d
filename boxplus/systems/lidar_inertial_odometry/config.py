"""The settings of LiDAR-inertial odometry, and those of them that a LiDAR alone has. None has to be given."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from boxplus.errors import InputError
from boxplus.filtering.nav_state import check_transform
from boxplus.maps.registration_config import RegistrationConfig


class LidarOdometryConfig(RegistrationConfig):
    """Settings of `LidarOdometry`, which `LidarInertialOdometry` has as well; lengths in metres.

    Raises:
        InputError: a setting is unknown or out of range.
        InputError: `box_side` is too small for `detection_range`.

    Example:
        >>> bp.LidarOdometryConfig(max_points=1000).max_points
        1000
    """

    max_points: int = Field(
        3000, ge=100, description="about how many points of a scan the update takes; the voxels grow until it is so"
    )
    box_side: float = Field(1000.0, gt=0, description="side of the box around the sensor within which the map is kept [m]")
    detection_range: float = Field(100.0, gt=0, description="range of the LiDAR, for moving the map box [m]")
    min_matched_share: float = Field(
        0.1, ge=0, lt=1, description="with less than this share of a scan's points on the map, three scans in a row, it is lost"
    )

    @model_validator(mode="after")
    def _box_is_large_enough(self) -> LidarOdometryConfig:
        if self.box_side <= 3.5 * self.detection_range:
            raise InputError(
                f"box_side above 3.5 × detection_range = {3.5 * self.detection_range:g} m",
                f"{self.box_side:g} m",
                "enlarge box_side or lower detection_range; a smaller box oscillates and deletes map on every scan",
            )
        return self


class LioConfig(LidarOdometryConfig):
    """Settings of `LidarInertialOdometry`; lengths in metres, times in seconds, noise as densities (per √Hz).

    Example:
        >>> config = bp.LioConfig(scan_voxel=0.3, max_points=1000)
        >>> config.map_cell, bp.LioConfig.model_validate({"scan_voxel": 0.3}).scan_voxel
        (0.25, 0.3)
    """

    T_imu_lidar: tuple[tuple[float, ...], ...] | None = Field(
        None, description="pose of the LiDAR in the IMU frame, 4×4 row-major: p_imu = T_imu_lidar p_lidar; None is the identity"
    )
    extrinsic_rotation_sigma_deg: float = Field(
        0.2, gt=0, description="standard deviation of the rotation in T_imu_lidar, about each axis [deg]"
    )
    extrinsic_translation_sigma: float = Field(
        0.005, gt=0, description="standard deviation of the translation in T_imu_lidar, along each axis [m]"
    )
    extrinsic_estimation: Literal["off", "on", "gated"] = Field(
        "off", description="refine T_imu_lidar while running: never, always, or only while the platform turns"
    )
    max_iterations: int = Field(4, ge=1, le=50, description="most Gauss-Newton steps after the first, per scan")
    gyro_noise: float | None = Field(
        None, gt=0, description="gyroscope noise [rad/s/√Hz], vibration included; None is told from its samples, 0.0005 to 0.002"
    )
    accel_noise: float | None = Field(
        None, gt=0, description="accelerometer noise [m/s²/√Hz], likewise; None is told from its samples, 0.005 to 0.05"
    )
    gyro_scale_noise: float = Field(
        0.005, ge=0, le=0.1, description="what turning adds to gyro_noise, for scale and axes that are off [rad/s/√Hz per rad/s]"
    )
    gyro_bias_walk: float = Field(1e-4, gt=0, description="random walk of the gyroscope bias [rad/s²/√Hz]")
    accel_bias_walk: float = Field(1e-3, gt=0, description="random walk of the accelerometer bias [m/s³/√Hz]")
    stamp_noise: float = Field(
        3e-4, ge=0, le=0.1, description="standard deviation of a scan's time stamp from scan to scan, against the IMU's clock [s]"
    )
    max_imu_gap: float = Field(0.15, gt=0, description="longest interval between IMU samples that is integrated over [s]")
    gravity_aligned: bool = Field(True, description="world frame with z up; False: the first IMU frame is the world")
    start_duration: float = Field(1.0, gt=0, description="time over which the start is observed, at rest or moving [s]")

    @property
    def T_declared(self) -> NDArray[np.float64] | None:
        """T_imu_lidar (4, 4) that the sensors can contradict, the identity if nobody gave one; None where it is estimated."""
        if self.extrinsic_estimation != "off":
            return None
        return np.eye(4) if self.T_imu_lidar is None else np.array(self.T_imu_lidar)

    def of_lidar_alone(self) -> LidarOdometryConfig:
        """Those for a LiDAR without an IMU.

        Raises:
            InputError: one that only an IMU gives a meaning differs from its default.
        """
        own, shared = type(self).model_fields, LidarOdometryConfig.model_fields
        given = [name for name, field in own.items() if name not in shared and getattr(self, name) != field.default]
        if given:
            raise InputError("settings of a LiDAR alone", ", ".join(given), "leave them out: no IMU takes part")
        return LidarOdometryConfig.model_validate({name: getattr(self, name) for name in shared})

    @field_validator("T_imu_lidar")
    @classmethod
    def _rigid(cls, value: tuple[tuple[float, ...], ...] | None) -> tuple[tuple[float, ...], ...] | None:
        if value is None:
            return None
        return tuple(tuple(float(x) for x in row) for row in check_transform("T_imu_lidar", np.array(value)))
