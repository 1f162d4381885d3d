"""The settings of refinement. None has to be given."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from boxplus.maps.plane_voxels.plane_map import PlaneVoxelConfig


class RefinementConfig(PlaneVoxelConfig):
    """Settings of `refine`; lengths in metres, times in seconds."""

    rounds: int = Field(3, ge=1, le=20, description="times that planes are found anew and everything is optimised")
    keyframe_distance: float = Field(0.7, gt=0, description="a new keyframe after this way [m]")
    keyframe_rotation_deg: float = Field(10.0, gt=0, description="or after this turn [deg]")
    keyframe_seconds: float = Field(1.0, gt=0, description="or after this time [s]")
    extrinsic_estimation: Literal["off", "on", "gated"] = Field(
        "off", description="refine T_imu_lidar: never, always, or where the motion turns about two axes"
    )
    extrinsic_rotation_sigma_deg: float = Field(0.5, gt=0, description="standard deviation of the rotation in T_imu_lidar [deg]")
    extrinsic_translation_sigma: float = Field(0.02, gt=0, description="standard deviation of the translation in T_imu_lidar [m]")
    time_offset_estimation: Literal["off", "on", "gated"] = Field(
        "off", description="refine the clock of the IMU against that of the LiDAR: never, always, or where the motion tells it"
    )
    time_offset_sigma: float = Field(0.005, gt=0, description="standard deviation of that time offset, about zero [s]")
    plane_roughness: float = Field(
        1.6,
        gt=1,
        description="thickness of a plane over what the noise of the range makes it, at most: what is thicker is curved",
    )
    plane_flatness: float = Field(0.001, ge=0, description="what a plane is not flat by, as each keyframe sees it [m]")
    max_iterations: int = Field(10, ge=1, description="steps of the solver in each round")
    max_points: int = Field(8000, ge=100, description="points of a scan that are kept")
    slices: int = Field(
        4, ge=1, description="slices with a pose of their own that a scan is cut into, as far as IMU samples suffice"
    )
    threads: int = Field(1, ge=1, description="threads that share the work; the result does not depend on it")
