"""What an uncertain mounting makes of state and path.

The LiDAR shows how the LiDAR moves: the map is made of what it sees, and a scan tells where the LiDAR is in it, L. The IMU is at
L T⁻¹, T = T_imu_lidar: an error of T is one of all poses of the IMU alike, and no scan tells one from the other. Only the motion
does, by how the IMU feels it. A filter that takes both for independent takes the one for the other: after the first turn it has
the lever arm to millimetres, and wrong. The covariance of the state therefore has both, from the first scan on,

    P = P_T + B Σ Bᵀ        P_T: the rest of the state, T known;  Σ: of T;  B: how the rest moves with T        (with_mounting)

While T is not to be estimated, because a platform that does not turn shows nothing of it, scans move P_T and B alone: what they
say of T is not listened to (a consider state: Schmidt, 1966).

Against the first pose, the path of the IMU is A = T L T⁻¹: where T is off by an angle, the whole path is turned by it, however
well every scan fits. Refining T while running does not move the map that was made with it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.errors_in_variables import without_noise
from boxplus.filtering.iterated_update import Information, Measurement
from boxplus.filtering.nav_state import PL, RL, T_G, T_P, T_THETA, T_THETA_L, TANGENT, G, P, R
from boxplus.manifolds import so3
from boxplus.systems.lidar_inertial_odometry.config import LioConfig

MOUNTING = slice(T_THETA_L, TANGENT)
_REST = slice(0, T_THETA_L)
_POSE = slice(0, 6)


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
        """What the mounting adds to a covariance (6, 6) of the pose at x (36,), [θ about the IMU's axes, p along the world's].

        As uncertain as it was at first, for the map was made with it; and where it has changed since, the first pose was not
        where it is known to have been now, which counts as it is.
        """
        if not self._variance.any():
            return cov
        J, off = mounting_jacobian(self._first, x), self._moved_since(x)
        wide: NDArray[np.float64] = cov + (J * self._variance) @ J.T + np.outer(off, off)
        return wide

    def _moved_since(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(6,) how the pose at x (36,) would move if the path began, with the present mounting, where it was said to begin."""
        first, T_first = T_world_imu_of(self._first), T_imu_lidar_of(self._first)
        T_now, mounted = T_world_imu_of(x), T_imu_lidar_of(x)
        moved = first @ mounted @ np.linalg.inv(first @ T_first) @ T_now
        return np.concatenate([so3.log(T_now[:3, :3].T @ moved[:3, :3]), moved[:3, 3] - T_now[:3, 3]])


class HeldMounting:
    """A measurement of pose and mounting that is asked about the pose alone.

    Args:
        measurement: of both.

    Attributes:
        last: what it said of both at the last iterate.
    """

    def __init__(self, measurement: Measurement) -> None:
        self._measurement = measurement
        self.last: Information

    def at(self, x: NDArray[np.float64], *, rematch: bool) -> Information:
        """See `Measurement`."""
        self.last = self._measurement.at(x, rematch=rematch)
        A, b, pull = self.last.A.copy(), self.last.b.copy(), self.last.pull.copy()
        A[6:], A[:, 6:], b[6:], pull[6:] = 0.0, 0.0, 0.0, 0.0
        return replace(self.last, A=A, b=b, pull=pull)

    def has_moved(self, x: NDArray[np.float64]) -> bool:
        """See `Measurement`."""
        return self._measurement.has_moved(x)


def T_world_imu_of(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4) T_world_imu of a state (36,)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = x[R : R + 9].reshape(3, 3), x[P : P + 3]
    return T


def T_imu_lidar_of(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4) T_imu_lidar of a state (36,)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = x[RL : RL + 9].reshape(3, 3), x[PL : PL + 3]
    return T


def first_sensitivity(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """(18, 6) how the state at rest moves with the mounting, the LiDAR's pose and what the accelerometer shows held.

    With φ = R_imu_lidar δθ_L:    δθ = −φ,    δp = −R [p_L]ₓ φ − R δp_L,    δg = [g]ₓ R φ
    """
    rotation, R_imu_lidar = x[R : R + 9].reshape(3, 3), x[RL : RL + 9].reshape(3, 3)
    B = np.zeros((T_THETA_L, 6))
    B[T_THETA : T_THETA + 3, :3] = -R_imu_lidar
    B[T_P : T_P + 3, :3] = -rotation @ so3.hat(x[PL : PL + 3]) @ R_imu_lidar
    B[T_P : T_P + 3, 3:] = -rotation
    B[T_G : T_G + 3, :3] = so3.hat(x[G : G + 3]) @ rotation @ R_imu_lidar
    return B


def with_mounting(cov: NDArray[np.float64], B: NDArray[np.float64]) -> NDArray[np.float64]:
    """P (24, 24) of a covariance with the mounting known, and how the rest of the state moves with it, B (18, 6)."""
    whole = cov.copy()
    shared = B @ cov[MOUNTING, MOUNTING]
    whole[_REST, _REST] += shared @ B.T
    whole[_REST, MOUNTING], whole[MOUNTING, _REST] = shared, shared.T
    return whole


def mounting_known(cov: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The same backwards: P (24, 24) with the mounting known, its own variances beside, and B (18, 6)."""
    B = np.linalg.solve(cov[MOUNTING, MOUNTING], cov[MOUNTING, _REST]).T.astype(np.float64)
    known = cov.copy()
    known[_REST, _REST] -= B @ cov[MOUNTING, _REST]
    known[_REST, MOUNTING], known[MOUNTING, _REST] = 0.0, 0.0
    return known, B


def moved_sensitivity(
    B: NDArray[np.float64], cov_prior: NDArray[np.float64], cov: NDArray[np.float64], information: Information
) -> NDArray[np.float64]:
    """B (18, 6) after a scan that was not asked about the mounting: B − K (H_x B + H_T), K H = P A.

    Args:
        B: before it; cov_prior, cov: (24, 24) before and after it, with the mounting known.
        information: what the scan says of pose and mounting.
    """
    left = without_noise(
        information.A,
        information.b - information.pull,
        information.directions,
        cov_prior=np.ascontiguousarray(cov_prior[_POSE, _POSE]),
        used=information.used,
        since_match=np.zeros(6),
    )
    if left is None:
        return B
    A = left[0]
    moved: NDArray[np.float64] = B - cov[_REST, _POSE] @ (A[:6, :6] @ B[_POSE] + A[:6, 6:])
    return moved


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
