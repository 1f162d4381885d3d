"""What a finished run of LiDAR-inertial odometry leaves for refinement."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.refinement.outside.evidence import RunFixes, RunLoops
from boxplus.systems.slam.correction import Correction

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
        open_steps: (N, 3, 3) projectors, in the world, on what the step to a slice leaves open (`unshown.open_steps`).
        is_unshown: (N,) bool, from the first scan on that left something open (`unshown.after_unshown`).
        covariance: (N, 6, 6) that the run gives its poses, [θ, p], relative to the first one; None as long as all is shown.
        loops, fixes: that were closed, and that the world is laid onto the Earth by; None without.
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
    open_steps: Floats
    is_unshown: NDArray[np.bool_]
    covariance: Floats | None
    loops: RunLoops | None = None
    fixes: RunFixes | None = None

    def __len__(self) -> int:
        return len(self.time_ns)

    def corrected(self, correction: Correction, covariance: Floats | None) -> FinishedRun:
        """The same where closed loops put it, with the covariance (N, 6, 6) of the poses there."""
        T = correction.apply(self.time_ns, self.T_world_imu)
        turned = quaternion.to_matrix(T[:, :4]) @ np.swapaxes(quaternion.to_matrix(self.T_world_imu[:, :4]), 1, 2)
        velocity = np.einsum("nij,nj->ni", turned, self.velocity_bias[:, :3])
        down = (turned @ self.gravity_world).mean(axis=0)
        return replace(
            self,
            T_world_imu=T,
            velocity_bias=np.hstack([velocity, self.velocity_bias[:, 3:]]),
            open_steps=turned @ self.open_steps @ np.swapaxes(turned, 1, 2),
            covariance=covariance,
            gravity_world=down * np.linalg.norm(self.gravity_world) / np.linalg.norm(down),
        )
