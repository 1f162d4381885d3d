"""What an uncertain mounting makes of the path.

The LiDAR shows how the LiDAR moves, L = T_lidar0_lidar. The path of the IMU is A = T L T⁻¹ with T = T_imu_lidar: where T is off
by an angle, the whole path is turned by it against the first pose, however well every scan fits. A mounting that was estimated
beforehand is uncertain from the first scan on, and refining it later does not move the map that was made with it. This is kept
beside the filter, as a constant that it does not know (a consider state: Schmidt, 1966).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import PL, RL, P, R
from boxplus.manifolds import so3
from boxplus.systems.lidar_inertial_odometry.config import LioConfig


class UnknownMounting:
    """Follows one start.

    Args:
        x: (36,) first state.
        config: of the odometry: a mounting that is not estimated while running is taken for exact.
    """

    def __init__(self, x: NDArray[np.float64], config: LioConfig) -> None:
        self._first = x.copy()
        is_known = config.extrinsic_estimation == "off"
        rotation, translation = np.deg2rad(config.extrinsic_rotation_sigma_deg), config.extrinsic_translation_sigma
        self._variance = np.repeat([0.0 if is_known else rotation**2, 0.0 if is_known else translation**2], 3)

    def widened(self, cov: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
        """A covariance (6, 6) of the pose at x (36,), [θ about the IMU's axes, p along the world's], and that of the mounting."""
        if not self._variance.any():
            return cov
        J = mounting_jacobian(self._first, x)
        wide: NDArray[np.float64] = cov + (J * self._variance) @ J.T
        return wide


def mounting_jacobian(first: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6, 6) of the pose [θ, p] at x (36,), the first one and the LiDAR's motion held, by the first state's [θ_L, p_L].

    A = T L T⁻¹ with T ← T Exp(δθ_L), p_L ← p_L + δp_L: with φ = R_imu_lidar δθ_L

        δθ = (R_Aᵀ − I) φ,    δp_A = (I − R_A) δp_L − [p_A − p_L + R_A p_L]ₓ φ + R_A [p_L]ₓ δθ
    """
    R_first, p_first = first[R : R + 9].reshape(3, 3), first[P : P + 3]
    R_imu_lidar, p_imu_lidar = first[RL : RL + 9].reshape(3, 3), first[PL : PL + 3]
    R_A = R_first.T @ x[R : R + 9].reshape(3, 3)
    p_A = R_first.T @ (x[P : P + 3] - p_first)
    J = np.zeros((6, 6))
    J[:3, :3] = R_A.T - np.eye(3)
    J[3:, :3] = R_A @ so3.hat(p_imu_lidar) @ J[:3, :3] - so3.hat(p_A - p_imu_lidar + R_A @ p_imu_lidar)
    J[:, :3] = J[:, :3] @ R_imu_lidar
    J[3:, 3:] = np.eye(3) - R_A
    J[3:] = R_first @ J[3:]
    return J
