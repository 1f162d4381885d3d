"""The motion of the first LiDAR over a few seconds, at any instant: cubic splines through its poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FEWEST_POSES = 4


class LidarMotion:
    """Poses of the first LiDAR, interpolated.

    Args:
        time_ns: (K,) int64, rising, at least 4.
        R_world_lidar, p_world_lidar: (K, 3, 3) and (K, 3) [m].
    """

    def __init__(
        self, time_ns: NDArray[np.int64], R_world_lidar: NDArray[np.float64], p_world_lidar: NDArray[np.float64]
    ) -> None:
        from scipy.interpolate import CubicSpline
        from scipy.spatial.transform import Rotation, RotationSpline

        self.begin_ns, self.end_ns = int(time_ns[0]), int(time_ns[-1])
        self.seconds = (self.end_ns - self.begin_ns) * 1e-9
        seconds = (time_ns - self.begin_ns) * 1e-9
        self._turn = RotationSpline(seconds, Rotation.from_matrix(R_world_lidar))
        self._position = CubicSpline(seconds, p_world_lidar)

    def at(
        self, seconds: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """R_world_lidar (N, 3, 3), p_world_lidar (N, 3), angular velocity in the LiDAR frame [rad/s] and velocity in the world
        [m/s], (N, 3) each, so long after the first pose [s]."""
        R = self._turn(seconds).as_matrix()
        # The spline's rates are along the axes of the rotated frame, as R(t + dt) = R(t) Exp(ω dt).
        return R, self._position(seconds), self._turn(seconds, 1), self._position(seconds, 1)
