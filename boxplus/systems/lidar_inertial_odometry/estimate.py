"""What LiDAR-inertial odometry says about one scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus._words import signed
from boxplus.filtering.degeneracy import PoseDirections
from boxplus.filtering.nav_state import NavState

Status = Literal["ok", "weak", "lost"]

# The six axes of a pose, in the order of its covariance: rotation about the IMU's axes, then position along the world's.
AXES = ("rotation x", "rotation y", "rotation z", "position x", "position y", "position z")
WAITED = "sensors compared"
"""The stage of a scan in which a run over a recording waits for what goes on beside it."""
_PART = 0.3  # of a unit direction, a smaller part of which is none to speak of


@dataclass(frozen=True, slots=True)
class WeakDirection:
    """A direction of the pose that the scan does not determine; there the filter keeps its prediction.

    Attributes:
        rotation_imu: (3,) part of the unit direction that turns, about the IMU's axes (scaled by `lever_arm`).
        translation_world: (3,) part that moves, along the world's axes.
        information_ratio: information along it over what noise of the planes' normals alone would give; 1 is noise.

    Example:
        >>> from boxplus.systems.lidar_inertial_odometry import WeakDirection
        >>> str(WeakDirection(np.zeros(3), np.array([1.0, 0.0, 0.0]), 1.1))
        'position along (+1.00, +0.00, +0.00) in the world frame'
    """

    rotation_imu: NDArray[np.float64]
    translation_world: NDArray[np.float64]
    information_ratio: float

    @property
    def moves(self) -> NDArray[np.float64]:
        """(3,) `translation_world`, or zero where the direction is one of rotation."""
        return self.translation_world if np.linalg.norm(self.translation_world) > _PART else np.zeros(3)

    @classmethod
    def all_of(cls, directions: PoseDirections) -> tuple[WeakDirection, ...]:
        """Those of a scan."""
        found, ratios = directions.vectors[:, directions.weak].T, directions.ratios[directions.weak]
        return tuple(cls(vector[:3], vector[3:], float(ratio)) for vector, ratio in zip(found, ratios, strict=True))

    def __str__(self) -> str:
        parts = []
        for name, vector, frame in (("position", self.translation_world, "world"), ("rotation", self.rotation_imu, "IMU")):
            if np.linalg.norm(vector) > _PART:
                parts.append(f"{name} along {signed(vector, 2)} in the {frame} frame")
        return " with ".join(parts)


@dataclass(frozen=True, slots=True)
class Estimate:
    """State, covariance and diagnosis at the end of one scan.

    Attributes:
        time_ns: the instant the estimate holds for: the last point of the scan, absolute [ns].
        state: pose, velocity, biases, gravity and extrinsic at `time_ns`.
        covariance: (24, 24) float64 of the tangent `[θ, p, v, b_ω, b_a, g, θ_L, p_L]` at `state`: rotations
            perturbed on the right (IMU frame) [rad], position and velocity along the world's axes. It is the filter's, which
            takes the map for exact: the pose is meant relative to the map around it.
        pose_covariance: (6, 6) float64 of the pose `[θ, p]`, order and axes as above, relative to the first pose: with what the
            map has taken over from the errors of earlier poses. It grows with the way (see `filtering.pose_covariance`).
        status: "ok"; "weak": over half a second most scans left a direction open, which was predicted only; "lost": no update was
            possible, or too few points fit the map, scan after scan.
        weak_directions: the directions the scan did not determine.
        lidar_share: (6,) for each of `AXES`, how much of the information came from the LiDAR: 1 − posterior / prior
            variance. 1 is measured, 0 is predicted only.
        points_raw: points of the scan; points_filtered: after the voxel filter; points_used: in the last iteration.
        rejected: filtered points that were not used, by reason; they add up with `points_used` to `points_filtered`.
        residual_rms: root mean square point-to-plane distance of the used points [m].
        iterations: Gauss-Newton steps taken; converged: whether the last one was below the threshold.
        warnings: what went wrong on the way to this scan (gaps or saturation of the IMU, sensors that contradict each other,
            …), one sentence each.
        timing_s: seconds spent, by stage of the pipeline.
        p_lidar: (N, 3) float32, all points of the scan in the LiDAR frame at `time_ns`, corrected for motion.
        intensity: (N,) float32 or None.
        lidar: (N,) uint8, which LiDAR saw each point, where several were merged; else None.

    Example:
        >>> with bp.open_recording("flight.bag") as recording:
        ...     odometry = bp.LidarInertialOdometry(bp.LioConfig(T_imu_lidar=recording.info.T_imu_lidar.tolist()))
        ...     estimates = []
        ...     for event in recording:
        ...         estimates += odometry.push_scan(event) if isinstance(event, bp.Scan) else odometry.push_imu(event)
        >>> last = estimates[-1]
        >>> last.status, last.T_world_imu.shape, last.pose_covariance.shape, last.weak_directions
        ('ok', (4, 4), (6, 6), ())
        >>> last.lidar_share.shape  # of each axis: 1 is measured, 0 predicted only
        (6,)
    """

    time_ns: int
    state: NavState
    covariance: NDArray[np.float64]
    pose_covariance: NDArray[np.float64]
    status: Status
    weak_directions: tuple[WeakDirection, ...]
    lidar_share: NDArray[np.float64]
    points_raw: int
    points_filtered: int
    points_used: int
    rejected: Mapping[str, int]
    residual_rms: float
    iterations: int
    converged: bool
    warnings: tuple[str, ...]
    timing_s: Mapping[str, float]
    p_lidar: NDArray[np.float32]
    intensity: NDArray[np.float32] | None
    lidar: NDArray[np.uint8] | None = None

    @property
    def T_world_imu(self) -> NDArray[np.float64]:
        """(4, 4) pose of the IMU in the world."""
        T = np.eye(4)
        T[:3, :3] = self.state.R_world_imu
        T[:3, 3] = self.state.p_world_imu
        return T

    def points_world(self) -> NDArray[np.float64]:
        """(N, 3) float64, the scan's points registered in the world."""
        return self.state.to_world(self.p_lidar)


@dataclass(frozen=True, slots=True)
class Prediction:
    """The state between scans, from the IMU alone since the last scan.

    Attributes:
        time_ns: the newest IMU sample, absolute [ns].
        state: pose, velocity, biases, gravity and extrinsic at `time_ns`.
        covariance: (24, 24), as in `Estimate`.

    Example:
        >>> with bp.open_recording("flight.bag") as recording:
        ...     odometry = bp.LidarInertialOdometry(bp.LioConfig(T_imu_lidar=recording.info.T_imu_lidar.tolist()))
        ...     for event in recording:
        ...         estimates = odometry.push_scan(event) if isinstance(event, bp.Scan) else odometry.push_imu(event)
        >>> now = odometry.predict()  # at the newest sample of the IMU
        >>> now.state.p_world_imu.shape, now.covariance.shape
        ((3,), (24, 24))
    """

    time_ns: int
    state: NavState
    covariance: NDArray[np.float64]
