"""What a finished run of LiDAR-inertial odometry leaves for refinement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.sensors.imu import ImuSamples

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class FinishedRun:
    """N scans, or slices of scans (`slices.cut`), as the filter placed them, and the IMU samples.

    Attributes:
        time_ns: (N,) int64, their ends, ascending.
        T_world_imu: (N, 7) wxyz and xyz; velocity_bias: (N, 9) v_world [m/s], b_a [m/s²], b_g [rad/s].
        gravity_world: (3,) [m/s²], down.
        T_imu_lidar: (7,).
        points: N arrays (n, 3) float32, each in the LiDAR frame at its end, corrected for motion [m]; empty where nobody knows
            where the scan belongs.
        imu: samples in order of time.
        noise: of the IMU as it is mounted.
        is_end: (N,) bool, whether a slice is the last one of its scan.
    """

    time_ns: NDArray[np.int64]
    T_world_imu: Floats
    velocity_bias: Floats
    gravity_world: Floats
    T_imu_lidar: Floats
    points: list[NDArray[np.float32]]
    imu: ImuSamples
    noise: ImuNoise
    is_end: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.time_ns)
