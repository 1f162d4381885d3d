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

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import STANDARD_GRAVITY
from boxplus.manifolds import so3
from boxplus.sensors.inertial.gyro_attitude import GyroAttitude
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.lidar_inertial_agreement.held_back import rms_about_mean, shifts_held_back
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath

_FEWEST_POSES = 6  # of a stretch
_SIGMA_M = 0.004  # of a pose by registration
_LACKING_M = 0.1
_ATTITUDE_RAD = 0.02
_SHARED = 13
_TIE_STD = 0.05  # m/s²
_LEAST_CHI2 = 0.1
_GROUP_S = 0.5  # over which errors of registrations are alike
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
        covariance: (13, 13) of these, in this order; what it moves by when some poses are left out included.
        stretches: positions and velocities of the IMU at the beginnings of the stretches.
        sigma: rms of what is left of the positions [m].
        chi2: of it, per degree of freedom, before the covariance was scaled by it.
        explained: share of what the accelerometer could explain of the LiDAR's path that it does explain at this slope, 0 to 1.
        samples: positions compared.
        excursion_m: rms of the LiDAR's positions about their mean.
        slope_reserve: added to the slope's variance where this stretch alone decides, as few groups of poses tell that variance
            coarsely; several stretches together tell it by what they differ by.
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
    excursion_m: float
    slope_reserve: float = 0.0

    @property
    def slope_std(self) -> float:
        """Of the noise, and of what registrations may hold back (`held_back`)."""
        return float(np.hypot(np.sqrt(self.covariance[SLOPE, SLOPE]), shifts_held_back(self.excursion_m)))

    @property
    def slope_std_alone(self) -> float:
        """Where three of it are to hold for this stretch alone."""
        return float(np.hypot(self.slope_std, np.sqrt(self.slope_reserve)))


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
    last = path.part(newest)
    shift_ns = round(offset_s * 1e9)
    attitude = BodyAttitude(last, imu, R_imu_lidar, bias_gyro, shift_ns)
    time_ns = last.time_ns + shift_ns
    stretches = _equations(last, time_ns, imu, attitude, stretch_s)
    if not stretches:
        return None
    whole = _Solution([stretch.reduced() for stretch in stretches], prior)
    x = whole.x
    rest = max(whole.rest, 0.0)
    samples = sum(len(stretch.time_ns) for stretch in stretches)
    freedom = sum(stretch.freedom for stretch in stretches)
    chi2 = rest / max(freedom - _SHARED, 1)
    # What neighbours share is in the jackknife: beside it poses count as well as they fit, of a state to begin with no better
    # than usual.
    shared, groups = _jackknife(stretches, whole, prior)
    inflate = max(chi2, 1.0)
    scaled: NDArray[np.float64] = np.linalg.inv(whole.measured / inflate + whole.known).astype(np.float64) + shared
    fitted: NDArray[np.float64] = np.linalg.inv(whole.measured / max(chi2, _LEAST_CHI2) + whole.known).astype(np.float64) + shared
    begins = []
    for stretch in stretches:
        part = stretch.reduced()
        joint = np.zeros((6 + _SHARED, 6 + _SHARED))
        joint[6:, 6:] = scaled
        joint[:6, 6:] = -part.depends @ scaled
        joint[6:, :6] = joint[:6, 6:].T
        joint[:6, :6] = inflate * part.own + part.depends @ scaled @ part.depends.T
        begins.append(Stretch(int(stretch.time_ns[0]), part.alone - part.depends @ x, joint))
    # What is left grows by s² / var(s) when the slope is held at zero.
    without = x[SLOPE] ** 2 / np.linalg.inv(whole.measured + whole.known)[SLOPE, SLOPE]
    explained = float(without / max(without + rest, 1e-12))
    return TranslationFit(
        x[GRAVITY],
        x[BIAS],
        x[ARM],
        float(x[SLOPE]),
        x[TURN],
        fitted,
        begins,
        _SIGMA_M * np.sqrt(chi2),
        chi2,
        explained,
        samples,
        rms_about_mean(last.p_path_lidar),
        float((few_groups(groups) ** 2 - 1.0) * shared[SLOPE, SLOPE]),
    )


@dataclass(frozen=True, slots=True)
class _Reduced:
    """A stretch without q₀ and v₀.

    Attributes:
        information, right_side, squares: (13, 13), (13,) of the shared unknowns, and of the values.
        own, depends, alone: covariance (6, 6) of q₀, v₀ with all else known; they are `alone` (6,) − `depends` (6, 13) x.
    """

    information: NDArray[np.float64]
    right_side: NDArray[np.float64]
    squares: float
    own: NDArray[np.float64]
    depends: NDArray[np.float64]
    alone: NDArray[np.float64]


class _Equations:
    """Whitened equations of a stretch: rows A (n, 3, 6) of q₀ and v₀, B (n, 3, 13) of the shared unknowns, values y (n, 3)."""

    def __init__(
        self, time_ns: NDArray[np.int64], A: NDArray[np.float64], B: NDArray[np.float64], y: NDArray[np.float64], freedom: int
    ) -> None:
        self.time_ns, self.freedom = time_ns, freedom
        self._A, self._B, self._y = A, B, y

    def reduced(self, chosen: NDArray[np.bool_] | None = None) -> _Reduced:
        """q₀ and v₀ leave by a Schur complement; of all poses, or of those that are chosen (n,)."""
        take = slice(None) if chosen is None else chosen
        A, B, y = self._A[take].reshape(-1, 6), self._B[take].reshape(-1, _SHARED), self._y[take].reshape(-1)
        AtA = A.T @ A + np.diag(1.0 / np.repeat([_ANYWHERE_M, _ANY_SPEED_M_S], 3) ** 2)
        AtB, Aty = A.T @ B, A.T @ y
        own = np.asarray(np.linalg.inv(AtA), dtype=np.float64)
        solved = np.asarray(np.linalg.solve(AtA, np.column_stack([AtB, Aty])), dtype=np.float64)
        depends, alone = solved[:, :-1], solved[:, -1]
        squares = float(y @ y - Aty @ alone)
        return _Reduced(B.T @ B - AtB.T @ depends, B.T @ y - AtB.T @ alone, squares, own, depends, alone)


class _Solution:
    """The shared unknowns x (13,), what stretches and prior know of them (13, 13), and the squares that are left."""

    def __init__(self, reduced: Sequence[_Reduced], prior: tuple[NDArray[np.float64], NDArray[np.float64]]) -> None:
        mean, std = prior
        self.measured: NDArray[np.float64] = np.sum([part.information for part in reduced], axis=0)
        seen = np.sum([part.right_side for part in reduced], axis=0)
        rhs = seen + mean / std**2
        self.known = np.diag(1.0 / std**2)
        self.x: NDArray[np.float64] = np.linalg.solve(self.measured + self.known, rhs).astype(np.float64)
        for _ in range(3):
            # The accelerometer shows one gravity at rest: as long as the slope, |g| is tied to it.
            tie = np.zeros(_SHARED)
            tie[GRAVITY] = self.x[GRAVITY] / max(float(np.linalg.norm(self.x[GRAVITY])), 1e-9)
            tie[SLOPE] = -np.sign(self.x[SLOPE]) * STANDARD_GRAVITY
            self.known = np.diag(1.0 / std**2) + np.outer(tie, tie) / _TIE_STD**2
            self.x = np.linalg.solve(self.measured + self.known, rhs).astype(np.float64)
        self.rest = sum(part.squares for part in reduced) - float(2 * self.x @ seen - self.x @ self.measured @ self.x)


def _jackknife(
    stretches: Sequence[_Equations], whole: _Solution, prior: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> tuple[NDArray[np.float64], int]:
    """(13, 13) how far the solution moves when half a second of poses is left out, whichever, and of how many groups that is.

    Neighbouring registrations share their map and so their errors, which the equations take for independent: a path that is bent
    where a platform moves off fits a wrong slope to millimetres. (Delete-a-group jackknife: Shao and Wu, Annals of Statistics
    1989.)
    """
    whole_parts = [stretch.reduced() for stretch in stretches]
    moved = []
    for number, stretch in enumerate(stretches):
        group = (stretch.time_ns - stretch.time_ns[0]) // round(_GROUP_S * 1e9)
        for left_out in np.unique(group):
            parts = [*whole_parts]
            parts[number] = stretch.reduced(group != left_out)
            moved.append(_Solution(parts, prior).x - whole.x)
    groups = len(moved)
    off = np.array(moved) - np.mean(moved, axis=0)
    covariance: NDArray[np.float64] = (groups - 1) / groups * off.T @ off
    return covariance, groups


def few_groups(groups: int) -> float:
    """By how much a standard deviation from so few groups is to be widened for three of it to hold as often as of a known one.

    Quantile of Student's t over that of the normal distribution, at 3: Fisher's expansion. Eight groups: 1.5.
    """
    few = 1.0 / max(groups - 1, 1)
    return 1.0 + few * (2.5 + few * (5.75 + few * (10.1 + few * 12.9)))


def _equations(
    part: LidarPath, time_ns: NDArray[np.int64], imu: ImuSamples, attitude: BodyAttitude, stretch_s: float
) -> list[_Equations]:
    """Of every stretch that is long enough and whose attitudes are known."""
    found = []
    first = 0
    while first < len(time_ns) - 1:
        last = int(np.searchsorted(time_ns, time_ns[first] + round(stretch_s * 1e9), side="right"))
        index = np.arange(first, min(last, len(time_ns)))
        first = last
        index = index[(time_ns[index] > imu.time_ns[0]) & (time_ns[index] < imu.time_ns[-1])]
        if len(index) < _FEWEST_POSES or not _attitudes_known(part, index):
            continue
        rows, shared, values, weight = _stretch(part, time_ns, imu, attitude, index)
        A, B, y = (np.einsum("nij,njk->nik", weight, M) for M in (rows, shared, values[:, :, None]))
        freedom = int(np.count_nonzero(np.abs(weight).sum(axis=2))) - 6
        found.append(_Equations(time_ns[index], A, B, y[:, :, 0], freedom))
    return found


def _stretch(
    path: LidarPath, time_ns: NDArray[np.int64], imu: ImuSamples, attitude: BodyAttitude, index: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Equations of a stretch: q₀, v₀ (n, 3, 6), the shared unknowns (n, 3, 13), values (n, 3), root weights (n, 3, 3)."""
    half_ns, t0 = round(0.5e9 * path.scan_s), int(time_ns[index[0]])
    begins, ends = time_ns[index] - half_ns, time_ns[index] + half_ns
    low, high = np.searchsorted(imu.time_ns, [begins[0], ends[-1]], side="right")
    grid = np.unique(np.concatenate([imu.time_ns[low:high], time_ns[index], begins, ends]))
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
    # From where the IMU was at t0, and at the velocity that it had there.
    zero = int(np.searchsorted(grid, t0))
    position = position - position[zero] - seconds[:, None] * velocity[zero]
    position, R = (_mean_over(values, grid, begins, ends) for values in (position, R.reshape(-1, 9)))
    n, t = len(index), (time_ns[index] - t0) * 1e-9
    rows = np.zeros((n, 3, 6))
    rows[:, :, :3] = np.eye(3)
    rows[:, :, 3:] = t[:, None, None] * np.eye(3)
    shared = np.zeros((n, 3, _SHARED))
    shared[:, :, GRAVITY] = 0.5 * (t**2 + path.scan_s**2 / 12.0)[:, None, None] * np.eye(3)
    shared[:, :, BIAS] = -position[:, 3:12].reshape(n, 3, 3)
    shared[:, :, ARM] = R.reshape(n, 3, 3)
    shared[:, :, SLOPE] = position[:, :3]
    shared[:, :, TURN] = position[:, 12:].reshape(n, 3, 3)
    return rows, shared, path.p_path_lidar[index], _root_weights(path, index)


def _mean_over(
    values: NDArray[np.float64], grid: NDArray[np.int64], begins: NDArray[np.int64], ends: NDArray[np.int64]
) -> NDArray[np.float64]:
    """(n, c) means of values (m, c), linear between times (m,), from begins (n,) to ends (n,), which are among these [ns].

    The registration of a scan finds the mean of where the LiDAR was: undistorted at a constant velocity, a step of 1.8 Hz seems
    smaller by a twentieth in scans of 0.1 s.
    """
    first, last = np.searchsorted(grid, begins), np.searchsorted(grid, ends)
    if np.array_equal(first, last):
        return values[first]
    seconds = (grid - grid[0]) * 1e-9
    swept = 0.5 * (values[1:] + values[:-1]) * np.diff(seconds)[:, None]
    total = np.vstack([np.zeros(values.shape[1]), np.cumsum(swept, axis=0)])
    means: NDArray[np.float64] = (total[last] - total[first]) / (seconds[last] - seconds[first])[:, None]
    return means


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
