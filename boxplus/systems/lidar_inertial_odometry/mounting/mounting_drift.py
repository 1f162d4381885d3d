"""What an uncertain mounting adds to the motion between two scans, as they have been placed.

With the mounting T = T_imu_lidar off by δ, the filter places the LiDAR where the scans want it, as far as they tell, and else
where the IMU's motion and T put it (`unknown_mounting`: the state moves by B δ). What is placed then moves by

    E δ,    E = B_pose − F        F: how the pose would have to move with T for the LiDAR to stay

and so does the map that is made of it. With the gain G of a scan, and the share f of the local map that it brings (of its points:
that `map_datum` tells it by direction matters where few rings drift, and a mounting is told by all of them),

    S ← (I − G)(S + ΔE) + G S_map,    S_map ← (1 − f) S_map + f S

ΔE: how E has changed from scan to scan, by the IMU. Against a marked pose S begins with zero, S_map less what S was there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import P, R
from boxplus.filtering.pose_covariance.correction import Correction
from boxplus.manifolds import so3
from boxplus.systems.lidar_inertial_odometry.mounting.unknown_mounting import first_sensitivity

_POSE = slice(0, 6)


class MountingDrift:
    """Follows one start, along the world's axes.

    Args:
        x: (36,) first state, at which LiDAR and map are where they are by definition.
    """

    def __init__(self, x: NDArray[np.float64]) -> None:
        self._p_world_imu = x[P : P + 3].copy()
        self._filter, self._pose, self._map = np.zeros((3, 6, 6))
        self._mounting, self._marked = np.zeros((2, 6, 6))

    def follow(
        self,
        prior: tuple[NDArray[np.float64], NDArray[np.float64]],
        posterior: tuple[NDArray[np.float64], NDArray[np.float64]],
        mounting: NDArray[np.float64],
        correction: Correction | None = None,
    ) -> None:
        """The filter has gone on by a scan.

        Args:
            prior, posterior: state (36,), and how its rest moves with the mounting, B (18, 6), before and after the scan.
            mounting: (6, 6) covariance of the mounting after the scan, [θ_L, p_L].
            correction: by the scan; None if the filter took none.
        """
        x = posterior[0]
        move = np.eye(6)
        move[3:, :3] = -so3.hat(x[P : P + 3] - self._p_world_imu)
        gain = np.zeros((6, 6)) if correction is None else _along_world(x) @ correction.gain[_POSE] @ _along_world(x).T
        self._map = move @ self._map
        predicted = move @ self._pose + _placement(*prior) - move @ self._filter
        self._pose = predicted + gain @ (self._map - predicted)
        self._filter, self._p_world_imu, self._mounting = _placement(*posterior), x[P : P + 3].copy(), mounting.copy()

    def insert(self, share: float) -> None:
        """The scan has brought a share of the local map, 0 to 1."""
        self._map = self._map + share * (self._pose - self._map)

    def mark(self) -> None:
        """Count against the present pose from now on, with the mounting as uncertain as it is now: the map is made with it."""
        self._map = self._map - self._pose
        self._pose = np.zeros((6, 6))
        self._marked = self._mounting

    def covariance_since_mark(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(6, 6) added to that of the pose at x (36,) against the marked one: [θ about the IMU's axes, p along the world's]."""
        moved = _along_world(x).T @ self._pose
        between: NDArray[np.float64] = moved @ self._marked @ moved.T
        return between


def _placement(x: NDArray[np.float64], B: NDArray[np.float64]) -> NDArray[np.float64]:
    """E (6, 6): how what is placed at x (36,) moves with the mounting, as a motion of the IMU along the world's axes."""
    placed: NDArray[np.float64] = _along_world(x) @ (B[_POSE] - first_sensitivity(x)[_POSE])
    return placed


def _along_world(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6, 6) from [θ about the IMU's axes, p] to [θ about the world's, p]."""
    turn = np.eye(6)
    turn[:3, :3] = x[R : R + 9].reshape(3, 3)
    return turn
