"""Accelerometer against LiDAR: gravity, velocity, bias, lever arm and the ratio of both scales, from where the LiDAR went.

In the frame of the LiDAR's path the IMU is at q(t) = p_L(t) − R(t) p_imu_lidar, with R(t) its attitude by LiDAR and gyroscope,
and

    p_L(t) = q₀ + v₀ t + ½ g t² + ∬ R (s a − b) + R(t) p_imu_lidar ,

linear in all that is unknown, to first order also in an error of the mounting's rotation, which turns R a: over short stretches
q₀, v₀, and over all of them gravity g, bias b, lever arm and the slope s. A slope of 1 says that metres and seconds of both
sensors agree; −1, that one of them is mirrored or reports gravity with the other sign; 3.28, that the LiDAR measures feet.
Along directions that the scene does not determine the LiDAR says nothing, and is not asked.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import STANDARD_GRAVITY
from boxplus.manifolds import so3
from boxplus.sensors.gyro_attitude import GyroAttitude
from boxplus.sensors.imu import ImuSamples
from boxplus.systems.lidar_inertial_agreement.lidar_motion import LidarPath

_FEWEST_POSES = 6  # of a stretch
_SIGMA_M = 0.004  # of a pose by registration
_LACKING_M = 0.1
_ATTITUDE_RAD = 0.02
_SHARED = 13
_TIE_STD = 0.05  # m/s²
_ANYWHERE_M, _ANY_SPEED_M_S = 1e3, 15.0  # where the LiDAR says nothing
GRAVITY, BIAS, ARM, SLOPE, TURN = slice(0, 3), slice(3, 6), slice(6, 9), 9, slice(10, 13)
_PRIOR_STD = np.array([100.0] * 3 + [0.2] * 3 + [0.5] * 3 + [5.0] + [0.5] * 3)


@dataclass(frozen=True, slots=True)
class Stretch:
    """Where a stretch began: [q₀, v₀] of the IMU (6,) in the path's frame, and their (19, 19) covariance with the shared ones."""

    time_ns: int
    state: NDArray[np.float64]
    covariance: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TranslationFit:
    """What the comparison of accelerations shows, in the frame of the LiDAR's path.

    Attributes:
        gravity: (3,) [m/s²]; bias: (3,) of the accelerometer [m/s²]; p_imu_lidar: (3,) [m]; slope: see the module.
        turn: (3,) rotation vector by which the accelerations would turn the mounting, R_imu_lidar ← Exp(turn) R_imu_lidar [rad].
        covariance: (13, 13) of these, in this order.
        stretches: positions and velocities of the IMU at the beginnings of the stretches.
        sigma: rms of what is left of the positions [m].
        chi2: of it, per degree of freedom, before the covariance was scaled by it.
        explained: share of what the accelerometer could explain of the LiDAR's path that it does explain at this slope, 0 to 1.
        samples: positions compared.
    """

    gravity: NDArray[np.float64]
    bias: NDArray[np.float64]
    p_imu_lidar: NDArray[np.float64]
    slope: float
    turn: NDArray[np.float64]
    covariance: NDArray[np.float64]
    stretches: list[Stretch]
    sigma: float
    chi2: float
    explained: float
    samples: int

    @property
    def slope_std(self) -> float:
        return float(np.sqrt(self.covariance[SLOPE, SLOPE]))


class BodyAttitude:
    """R_path_imu at any time: the LiDAR's at its poses, turned by the gyroscope in between."""

    def __init__(
        self, path: LidarPath, imu: ImuSamples, R_imu_lidar: NDArray[np.float64], bias_gyro: NDArray[np.float64], shift_ns: int
    ) -> None:
        self._time_ns = path.time_ns + shift_ns
        self._R = path.R_path_lidar @ R_imu_lidar.T
        self._gyro = GyroAttitude(imu.time_ns, imu.gyro - bias_gyro)
        at = self._gyro.at(self._time_ns)
        turned = np.swapaxes(at[:-1], 1, 2) @ at[1:]
        self._missing = so3.log(np.swapaxes(turned, 1, 2) @ np.swapaxes(self._R[:-1], 1, 2) @ self._R[1:])
        self._at = at

    def at(self, time_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """(N, 3, 3)."""
        k = np.clip(np.searchsorted(self._time_ns, time_ns, side="right") - 1, 0, len(self._time_ns) - 2)
        share = (time_ns - self._time_ns[k]) / (self._time_ns[k + 1] - self._time_ns[k])
        turned = np.swapaxes(self._at[k], 1, 2) @ self._gyro.at(time_ns)
        R: NDArray[np.float64] = self._R[k] @ turned @ so3.exp(np.clip(share, 0.0, 1.0)[:, None] * self._missing[k])
        return R


def wide_prior() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean (13,) and standard deviations (13,) of what is known of any IMU and any mounting."""
    mean = np.zeros(_SHARED)
    mean[SLOPE] = 1.0
    return mean, _PRIOR_STD.copy()


def compare_accelerations(
    path: LidarPath,
    imu: ImuSamples,
    R_imu_lidar: NDArray[np.float64],
    bias_gyro: NDArray[np.float64],
    offset_s: float,
    prior: tuple[NDArray[np.float64], NDArray[np.float64]],
    stretch_s: float = 2.0,
) -> TranslationFit | None:
    """Compare the path of a LiDAR with an accelerometer; None when no stretch of the path is long enough.

    Args:
        path: from `lidar_path`; its last segment is used.
        imu: finite samples in order of time; gyroscope in rad/s.
        R_imu_lidar, bias_gyro, offset_s: as found by `compare_rotations`.
        prior: (13,) mean and (13,) standard deviations of gravity, bias, lever arm, slope and turn, e.g. `wide_prior()`.
        stretch_s: time over which velocity and position are free once: errors of attitude grow with its square [s].
    """
    newest = path.segment == path.segment[-1]
    if newest.sum() < _FEWEST_POSES:
        return None
    part = path.part(newest)
    shift_ns = round(offset_s * 1e9)
    attitude = BodyAttitude(part, imu, R_imu_lidar, bias_gyro, shift_ns)
    time_ns = part.time_ns + shift_ns
    mean, std = prior
    N = np.diag(1.0 / std**2)
    rhs = mean / std**2
    rest, freedom, samples = 0.0, 0, 0
    eliminated = []
    first = 0
    while first < len(time_ns) - 1:
        last = int(np.searchsorted(time_ns, time_ns[first] + round(stretch_s * 1e9), side="right"))
        index = np.arange(first, min(last, len(time_ns)))
        first = last
        inside = (time_ns[index] > imu.time_ns[0]) & (time_ns[index] < imu.time_ns[-1])
        index = index[inside]
        if len(index) < _FEWEST_POSES or not _attitudes_known(part, index):
            continue
        rows, shared, values, weight = _stretch(part, time_ns, imu, attitude, index)
        # q₀ and v₀ leave by a Schur complement.
        A, B, y = (np.einsum("nij,njk->nik", weight, M).reshape(-1, M.shape[-1]) for M in (rows, shared, values[:, :, None]))
        AtA = A.T @ A + np.diag(1.0 / np.repeat([_ANYWHERE_M, _ANY_SPEED_M_S], 3) ** 2)
        AtB, Aty = A.T @ B, A.T @ y[:, 0]
        solved = np.linalg.solve(AtA, np.column_stack([AtB, Aty]))
        N += B.T @ B - AtB.T @ solved[:, :-1]
        rhs += B.T @ y[:, 0] - AtB.T @ solved[:, -1]
        rest += float(y[:, 0] @ y[:, 0] - Aty @ solved[:, -1])
        freedom += int(np.count_nonzero(np.abs(weight).sum(axis=2))) - 6
        samples += len(index)
        eliminated.append((int(time_ns[index[0]]), solved, np.linalg.inv(AtA)))
    if not samples:
        return None
    known = np.diag(1.0 / std**2)
    measured, seen = N - known, rhs - mean / std**2
    x: NDArray[np.float64] = np.linalg.solve(N, rhs).astype(np.float64)
    for _ in range(3):
        # The accelerometer shows one gravity at rest: as long as the slope, |g| is tied to it.
        tie = np.zeros(_SHARED)
        tie[GRAVITY], tie[SLOPE] = (
            x[GRAVITY] / max(float(np.linalg.norm(x[GRAVITY])), 1e-9),
            -np.sign(x[SLOPE]) * STANDARD_GRAVITY,
        )
        known = np.diag(1.0 / std**2) + np.outer(tie, tie) / _TIE_STD**2
        x = np.linalg.solve(measured + known, rhs).astype(np.float64)
    rest = max(rest - float(2 * x @ seen - x @ measured @ x), 0.0)
    chi2 = rest / max(freedom - _SHARED, 1)
    scaled: NDArray[np.float64] = np.linalg.inv(measured / max(chi2, 1.0) + known).astype(np.float64)
    inflate = max(chi2, 1.0)
    stretches = []
    for at, solved, own in eliminated:
        joint = np.zeros((6 + _SHARED, 6 + _SHARED))
        depends = solved[:, :-1]
        joint[6:, 6:] = scaled
        joint[:6, 6:] = -depends @ scaled
        joint[6:, :6] = joint[:6, 6:].T
        joint[:6, :6] = inflate * own + depends @ scaled @ depends.T
        stretches.append(Stretch(at, solved[:, -1] - depends @ x, joint))
    # What is left grows by s² / var(s) when the slope is held at zero.
    without = x[SLOPE] ** 2 / np.linalg.inv(measured + known)[SLOPE, SLOPE]
    explained = float(without / max(without + rest, 1e-12))
    return TranslationFit(
        x[GRAVITY],
        x[BIAS],
        x[ARM],
        float(x[SLOPE]),
        x[TURN],
        scaled,
        stretches,
        _SIGMA_M * np.sqrt(chi2),
        chi2,
        explained,
        samples,
    )


def _stretch(
    path: LidarPath, time_ns: NDArray[np.int64], imu: ImuSamples, attitude: BodyAttitude, index: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Equations of a stretch: q₀, v₀ (n, 3, 6), the shared unknowns (n, 3, 13), values (n, 3), root weights (n, 3, 3)."""
    t0, t1 = int(time_ns[index[0]]), int(time_ns[index[-1]])
    low, high = np.searchsorted(imu.time_ns, [t0, t1], side="right")
    grid = np.concatenate([[t0], imu.time_ns[low:high], [t1]])
    grid = np.unique(np.concatenate([grid, time_ns[index]]))
    R = attitude.at(grid)
    a = np.stack([np.interp(grid, imu.time_ns, imu.accel[:, i]) for i in range(3)], axis=1)
    seconds = (grid - t0) * 1e-9
    dt = np.diff(seconds)[:, None]
    # ∬ R a and ∬ R, both twice integrated with the integrand linear between grid points.
    turned = R @ so3.hat(a)  # R Exp(−θ) a ≈ R a + R [a]× θ
    integrand = np.concatenate([np.einsum("nij,nj->ni", R, a), R.reshape(-1, 9), turned.reshape(-1, 9)], axis=1)
    velocity = np.vstack([np.zeros(21), np.cumsum(0.5 * (integrand[1:] + integrand[:-1]) * dt, axis=0)])
    swept = velocity[:-1] * dt + (2.0 * integrand[:-1] + integrand[1:]) / 6.0 * dt**2
    position = np.vstack([np.zeros(21), np.cumsum(swept, axis=0)])
    at = np.searchsorted(grid, time_ns[index])
    n, t = len(index), seconds[at]
    rows = np.zeros((n, 3, 6))
    rows[:, :, :3] = np.eye(3)
    rows[:, :, 3:] = t[:, None, None] * np.eye(3)
    shared = np.zeros((n, 3, _SHARED))
    shared[:, :, GRAVITY] = 0.5 * (t**2)[:, None, None] * np.eye(3)
    shared[:, :, BIAS] = -position[at, 3:12].reshape(n, 3, 3)
    shared[:, :, ARM] = R[at]
    shared[:, :, SLOPE] = position[at, :3]
    shared[:, :, TURN] = position[at, 12:].reshape(n, 3, 3)
    return rows, shared, path.p_path_lidar[index], _root_weights(path, index)


def _attitudes_known(path: LidarPath, index: NDArray[np.intp]) -> bool:
    """Whether the scene determined the attitudes of a stretch: gravity is ten times what it is compared with."""
    later = index[path.information[index, 3, 3] + path.information[index, 4, 4] + path.information[index, 5, 5] > 0.0]
    known = np.linalg.eigvalsh(path.information[later, :3, :3])[:, 0] > 1.0 / _ATTITUDE_RAD**2
    return bool(known.mean() > 0.3) if len(later) else False


def _root_weights(path: LidarPath, index: NDArray[np.intp]) -> NDArray[np.float64]:
    """(n, 3, 3) square roots of the information about the positions, without the directions that any of them lacks.

    Where one pose of a stretch was only predicted along a direction, all later ones are displaced along it.
    """
    blocks = path.information[index, 3:, 3:]
    values, vectors = np.linalg.eigh(blocks)
    first = values[:, -1] <= 0.0  # the first pose of a path defines its frame
    lacking = np.where((values < 1.0 / _LACKING_M**2) & ~first[:, None], 1.0, 0.0)
    weak = np.einsum("nij,nj,nkj->ik", vectors, lacking, vectors)
    share, axes = np.linalg.eigh(weak)
    strong = axes[:, share < 0.5]
    variance = 1.0 / np.maximum(np.einsum("ij,nik,kj->nj", strong, blocks, strong), 1e-9) + _SIGMA_M**2
    variance[first] = _SIGMA_M**2
    roots = np.zeros((len(index), 3, 3))
    roots[:, : strong.shape[1]] = strong.T / np.sqrt(variance)[:, :, None]
    return roots
