"""Mounting, clocks, scales and biases of LiDAR and IMU in one estimate over several stretches of a recording.

The comparisons of rotations and of accelerations (`compare_sensors`) each take half of the data. Here both are one least squares
problem, with the attitude from the gyroscope, which over seconds is steadier than any registration: over short pieces of a path
(2 s) begin q₀, v₀ and the attitude A₀ of the IMU are free, and

    A(t) = A₀ ΔR(t),  ΔR from (ω / c − b_ω),     R_L(t) = A(t) R_imu_lidar,
    p_L(t) = q₀ + v₀ t + ½ g t² + ∬ A (s a − b_a) + A(t) p_imu_lidar,

with gravity g and the biases b_ω, b_a of each stretch, and one R_imu_lidar, p_imu_lidar, offset of the clocks, gyroscope's scale
c and ratio of lengths s for all. Gauss-Newton. The IMU's noise, integrated, joins that of the registrations in the covariance of
attitudes and positions; how large both are is what makes the rest of the fit most likely. See docs/agreement.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import STANDARD_GRAVITY
from boxplus.manifolds import so3
from boxplus.sensors.inertial.gyro_attitude import GyroAttitude
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.lidar_inertial_agreement.agreement import Agreement
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath

_PIECE_S = 2.0
_FEWEST_POSES = 6
_ROUNDS, _PLAIN_ROUNDS = 14, 4
_NOISE_ROUNDS = 8  # after which it is held: its ratio has steps, between which the fit would go to and fro for ever
_SETTLED = 1e-6
_SIGMA_ROTATION, _SIGMA_POSITION = 2e-3, 4e-3  # rad, m: to begin with
_LEAST_ROTATION, _LEAST_POSITION = 3e-4, 1e-3
_TIE_STD = 0.05  # m/s²: |g| is one gravity as the accelerometer shows it
_ROBUST = 4.0
_RATIOS = tuple(0.1 * 2.0**k for k in range(8))
_WANDERING = 1.5  # 1/s
_STEP = 1e-5
THETA, ARM, OFFSET, SCALE, SLOPE = slice(0, 3), slice(3, 6), 6, 7, 8
_SHARED = 9
_PRIOR_STD = np.array([np.pi] * 3 + [1.0] * 3 + [1.0, 3.0, 5.0])
_W_GYRO, _W_ACCEL, _W_GRAVITY, _W_SIZE = slice(0, 3), slice(3, 6), slice(6, 9), 9
_W_PRIOR_STD = np.array([0.5] * 3 + [0.5] * 3 + [100.0] * 3)
_FLOOR = np.array([1e-3] * 3 + [3e-3] * 3 + [1e-3, 1e-3, 2e-3])
"""What no number of scans averages away: registration lags, sensors are not quite linear."""
_CORRELATED = 2.0
"""Neighbouring registrations share their map and so their errors: their standard deviations are this much larger."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """What the stretches together show.

    Attributes:
        T_imu_lidar: (4, 4): p_imu = T_imu_lidar p_lidar.
        offset_s: add this to the LiDAR's times to bring them to the IMU's clock [s].
        gyro_scale: rotation of the gyroscope over that of the LiDAR.
        slope: lengths of the LiDAR over those of the accelerometer.
        gyro_bias: (3,) [rad/s], mean over the stretches.
        gyro_bias_std: (3,) [rad/s].
        covariance: (9, 9) of [θ about the IMU's axes, p_imu_lidar, offset, log gyro_scale, slope].
        sigma_rotation, sigma_position: what the fit leaves of the LiDAR's attitudes [rad] and positions [m] along an axis.
        poses: of the LiDAR that were compared.
        last_step: (9,) what the last round would still have moved, in the order of `covariance`; nothing where it came to rest.
    """

    T_imu_lidar: NDArray[np.float64]
    offset_s: float
    gyro_scale: float
    slope: float
    gyro_bias: NDArray[np.float64]
    gyro_bias_std: NDArray[np.float64]
    covariance: NDArray[np.float64]
    sigma_rotation: float
    sigma_position: float
    poses: int
    last_step: NDArray[np.float64]

    @property
    def moving(self) -> NDArray[np.float64]:
        """(9,) the last step in standard deviations: what is beyond one had not come to rest where the rounds ended."""
        return np.asarray(np.abs(self.last_step) / self.std)

    @property
    def std(self) -> NDArray[np.float64]:
        """(9,) standard deviations, in the order of `covariance`."""
        std: NDArray[np.float64] = np.sqrt(np.diag(self.covariance))
        return std


def calibrate(stretches: Sequence[tuple[Agreement, ImuSamples]]) -> Calibration | None:
    """Estimate everything over stretches in which the sensors have been compared; None where there is no rotation to begin with.

    Args:
        stretches: what `compare_sensors(..., refine=True)` found, and the samples it was given (finite, in order of time,
            gyroscope in rad/s).
    """
    windows = [_Window(agreement, imu) for agreement, imu in stretches if agreement.rotation is not None]
    windows = [window for window in windows if window.pieces]
    known = [agreement.rotation for agreement, _ in stretches if agreement.rotation is not None]
    if not windows or not known:
        return None
    best = min(known, key=lambda fit: float(fit.rotation_std[0].max()))
    at = _Shared(best.R_imu_lidar, np.zeros(3), best.offset_s if best.offset_std_s < 0.05 else 0.0, 0.0, 1.0)
    noise = _Noise(_SIGMA_ROTATION, 0.1), _Noise(_SIGMA_POSITION, 0.4)
    size = _SHARED + sum(window.size for window in windows)
    covariance: NDArray[np.float64] = np.eye(size)
    step = np.full(size, np.inf)
    for number in range(_ROUNDS):
        H, b = np.zeros((size, size)), np.zeros(size)
        H[range(_SHARED), range(_SHARED)] = 1.0 / _PRIOR_STD**2
        b[:_SHARED] = -np.concatenate([np.zeros(3), at.p, [at.offset_s, at.log_scale, at.slope - 1.0]]) / _PRIOR_STD**2
        left: tuple[list[_Left], list[_Left]] = [], []
        first = _SHARED
        for window in windows:
            index = np.concatenate([np.arange(_SHARED), np.arange(first, first + window.size)])
            for seconds, r, J in window.linearised(at):
                for kind in (0, 1):
                    rows = slice(3 * kind, 3 * kind + 3)
                    root = noise[kind].root(seconds, kind)
                    white = np.linalg.solve(root, r[:, rows]).reshape(-1)
                    slopes = np.linalg.solve(root, J[:, rows].reshape(len(r), -1)).reshape(-1, len(index))
                    # What does not fit counts less (Geman-McClure), once the fit is about right.
                    weight = 1.0 / (1.0 + (white / _ROBUST) ** 2) ** 2 if number >= _PLAIN_ROUNDS else np.ones(len(white))
                    H[np.ix_(index, index)] += (slopes * weight[:, None]).T @ slopes
                    b[index] -= slopes.T @ (weight * white)
                    left[kind].append((seconds, r[:, rows]))
            prior = np.arange(first, first + _W_SIZE)
            H[prior, prior] += 1.0 / _W_PRIOR_STD**2
            b[prior] -= window.x / _W_PRIOR_STD**2
            tie, value = window.tie(at.slope, first, size)
            H += np.outer(tie, tie) / _TIE_STD**2
            b -= tie * value / _TIE_STD**2
            first += window.size
        step = np.asarray(np.linalg.solve(H, b), dtype=np.float64)
        covariance[:] = np.linalg.inv(H)
        at = at.moved(step[:_SHARED])
        first = _SHARED
        for window in windows:
            window.move(step[first : first + window.size])
            first += window.size
        if number < _NOISE_ROUNDS:
            noise = _noise_of(left[0], 0), _noise_of(left[1], 1)
        if number > _PLAIN_ROUNDS and np.abs(step[:_SHARED]).max() < _SETTLED:
            break
    covariance = covariance * _CORRELATED**2
    covariance[range(_SHARED), range(_SHARED)] += _FLOOR**2
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = at.R, at.p
    firsts = _SHARED + np.concatenate([[0], np.cumsum([window.size for window in windows])[:-1]]).astype(int)
    biases = np.array([window.x[_W_GYRO] for window in windows])
    variances = np.array([np.diag(covariance)[first : first + 3] for first in firsts])
    share = (1.0 / variances) / (1.0 / variances).sum(axis=0)
    return Calibration(
        T,
        at.offset_s,
        float(np.exp(at.log_scale)),
        at.slope,
        (share * biases).sum(axis=0),
        np.sqrt(1.0 / (1.0 / variances).sum(axis=0)),
        covariance[:_SHARED, :_SHARED],
        noise[0].white,
        noise[1].white,
        sum(window.poses for window in windows),
        step[:_SHARED],
    )


@dataclass(frozen=True, slots=True)
class _Shared:
    """What is one for all stretches."""

    R: NDArray[np.float64]
    p: NDArray[np.float64]
    offset_s: float
    log_scale: float
    slope: float

    def moved(self, step: NDArray[np.float64]) -> _Shared:
        return _Shared(
            so3.exp(step[THETA]) @ self.R,
            self.p + step[ARM],
            self.offset_s + float(np.clip(step[OFFSET], -0.02, 0.02)),
            self.log_scale + float(np.clip(step[SCALE], -0.3, 0.3)),
            self.slope + float(step[SLOPE]),
        )


class _Window:
    """The equations of one stretch; `x` (9,) are its biases and its gravity."""

    def __init__(self, agreement: Agreement, imu: ImuSamples) -> None:
        rotation = agreement.rotation
        self._path, self._imu = agreement.path, imu
        self.x = np.zeros(_W_SIZE)
        if rotation is not None:
            self.x[_W_GYRO] = rotation.bias
        if agreement.translation is not None:
            self.x[_W_GRAVITY], self.x[_W_ACCEL] = agreement.translation.gravity, agreement.translation.bias
        self.pieces = [_Piece(index) for index in _pieces(agreement.path, imu)]
        for piece in self.pieces:
            R = np.eye(3) if rotation is None else rotation.R_imu_lidar
            piece.A = agreement.path.R_path_lidar[piece.index[0]] @ R.T
            piece.q = agreement.path.p_path_lidar[piece.index[0]].copy()
        self.size = _W_SIZE + 9 * len(self.pieces)
        self.poses = sum(len(piece.index) for piece in self.pieces)

    def tie(self, slope: float, first: int, size: int) -> tuple[NDArray[np.float64], float]:
        """|g| − s · 9.81 = 0 as (row (size,), value)."""
        norm = max(float(np.linalg.norm(self.x[_W_GRAVITY])), 1e-9)
        row = np.zeros(size)
        row[first + 6 : first + 9] = self.x[_W_GRAVITY] / norm
        row[SLOPE] = -np.sign(slope) * STANDARD_GRAVITY
        return row, norm - abs(slope) * STANDARD_GRAVITY

    def linearised(self, at: _Shared) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
        """Of every piece: times since its begin (n,) [s], residuals (n, 6) [rad, m] and their Jacobian (n, 6, 9 + size)."""
        pieces = self._evaluate(at, with_jacobian=True)
        # Offset, scale and bias act through the integrals: by differences.
        moved: list[tuple[int, float, Callable[[float], tuple[_Shared, NDArray[np.float64]]]]] = [
            (OFFSET, 1e-3, lambda h: (replace(at, offset_s=at.offset_s + h), np.zeros(3))),
            (SCALE, _STEP, lambda h: (replace(at, log_scale=at.log_scale + h), np.zeros(3))),
        ]
        moved += [(_SHARED + i, _STEP, lambda h, i=i: (at, h * np.eye(3)[i])) for i in range(3)]  # type: ignore[misc]
        for column, h, change in moved:
            for (_, _, J), (_, more, _), (_, less, _) in zip(
                pieces, self._evaluate(*change(h)), self._evaluate(*change(-h)), strict=True
            ):
                J[:, :, column] = (more - less) / (2.0 * h)
        yield from pieces

    def move(self, step: NDArray[np.float64]) -> None:
        """Take a step of the stretch's own unknowns (size,)."""
        self.x = self.x + step[:_W_SIZE]
        for number, piece in enumerate(self.pieces):
            own = step[_W_SIZE + 9 * number : _W_SIZE + 9 * (number + 1)]
            piece.q, piece.v = piece.q + own[:3], piece.v + own[3:6]
            piece.A = piece.A @ so3.exp(own[6:])

    def _evaluate(
        self, at: _Shared, bias_step: NDArray[np.float64] | None = None, *, with_jacobian: bool = False
    ) -> list[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
        imu, path = self._imu, self._path
        bias = self.x[_W_GYRO] + (0.0 if bias_step is None else bias_step)
        turning = GyroAttitude(imu.time_ns, imu.gyro * np.exp(-at.log_scale) - bias)
        shift_ns = at.offset_s * 1e9
        found = []
        for number, piece in enumerate(self.pieces):
            index = piece.index
            time_ns = path.time_ns[index] + round(shift_ns)
            t0, t1 = int(time_ns[0]), int(time_ns[-1])
            low, high = np.searchsorted(imu.time_ns, [t0, t1], side="right")
            grid = np.unique(np.concatenate([imu.time_ns[low:high], time_ns]))
            R = turning.at(grid)
            dR = R[0].T @ R
            a = np.stack([np.interp(grid, imu.time_ns, imu.accel[:, i]) for i in range(3)], axis=1)
            seconds = (grid - t0) * 1e-9
            dt = np.diff(seconds)[:, None]
            integrand = np.concatenate([np.einsum("nij,nj->ni", dR, a), dR.reshape(-1, 9)], axis=1)
            speed = np.vstack([np.zeros(12), np.cumsum(0.5 * (integrand[1:] + integrand[:-1]) * dt, axis=0)])
            swept = speed[:-1] * dt + (2.0 * integrand[:-1] + integrand[1:]) / 6.0 * dt**2
            position = np.vstack([np.zeros(12), np.cumsum(swept, axis=0)])
            k = np.searchsorted(grid, time_ns)
            n, t = len(index), seconds[k]
            turned, forced, held = dR[k], position[k, :3], position[k, 3:].reshape(n, 3, 3)
            body = at.slope * forced - held @ self.x[_W_ACCEL] + turned @ at.p
            p = piece.q + t[:, None] * piece.v + 0.5 * (t**2)[:, None] * self.x[_W_GRAVITY] + body @ piece.A.T
            seen = np.swapaxes(path.R_path_lidar[index], 1, 2) @ piece.A @ turned @ at.R
            r = np.concatenate([so3.log(seen), p - path.p_path_lidar[index]], axis=1)
            if not with_jacobian:
                found.append((t, r, np.empty((n, 6, 0))))
                continue
            J = np.zeros((n, 6, _SHARED + self.size))
            own = _SHARED + _W_SIZE + 9 * number
            back = so3.right_jacobian_inverse(r[:, :3])
            J[:, :3, THETA] = back @ at.R.T
            J[:, :3, own + 6 : own + 9] = back @ np.swapaxes(turned @ at.R, 1, 2)
            J[:, 3:, ARM] = piece.A @ turned
            J[:, 3:, SLOPE] = forced @ piece.A.T
            J[:, 3:, _SHARED + 3 : _SHARED + 6] = -piece.A @ held
            J[:, 3:, _SHARED + 6 : _SHARED + 9] = 0.5 * (t**2)[:, None, None] * np.eye(3)
            J[:, 3:, own : own + 3] = np.eye(3)
            J[:, 3:, own + 3 : own + 6] = t[:, None, None] * np.eye(3)
            J[:, 3:, own + 6 : own + 9] = -piece.A @ so3.hat(body)
            found.append((t, r, J))
        return found


_Left = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class _Noise:
    """Of attitudes or positions: white, of the registration, and integrated, of the IMU, as multiples of it."""

    white: float
    ratio: float

    def root(self, seconds: NDArray[np.float64], kind: int) -> NDArray[np.float64]:
        """(n, n) Cholesky factor of the covariance along one axis at times (n,) since the begin of a piece."""
        covariance = np.eye(len(seconds)) + self.ratio**2 * _integrated(seconds, kind)
        return self.white * np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)


def _integrated(seconds: NDArray[np.float64], kind: int) -> NDArray[np.float64]:
    """(n, n) covariance of white noise of density one, integrated once (attitudes) or twice and with its drift (positions)."""
    s, t = np.minimum(seconds[:, None], seconds), np.maximum(seconds[:, None], seconds)
    if kind == 0:
        return np.asarray(s, dtype=np.float64)
    twice = s**2 * (3.0 * t - s) / 6.0
    # A bias that wanders, and attitude errors that tilt gravity: once more integrated.
    thrice = s**3 * (10.0 * t**2 - 5.0 * s * t + s**2) / 120.0
    total: NDArray[np.float64] = twice + _WANDERING**2 * thrice
    return total


def _noise_of(left: list[_Left], kind: int) -> _Noise:
    """The noise that makes what is left most likely."""
    best = (np.inf, _Noise(1.0, 0.0))
    freed = 3.0 * (1 + kind) * len(left)
    for ratio in (0.0, *_RATIOS):
        squares, log_det, count = 0.0, 0.0, 0
        for seconds, r in left:
            root = _Noise(1.0, ratio).root(seconds, kind)
            white = np.linalg.solve(root, r)
            scale = max(1.4826 * float(np.median(np.abs(white))), 1e-9)
            squares += float((np.minimum(np.abs(white), _ROBUST * scale) ** 2).sum())
            log_det += 6.0 * float(np.log(np.diag(root)).sum())
            count += r.size
        variance = squares / max(count - freed, 1.0)
        cost = count * np.log(max(variance, 1e-18)) + log_det
        if cost < best[0]:
            best = (cost, _Noise(max(float(np.sqrt(variance)), (_LEAST_ROTATION, _LEAST_POSITION)[kind]), ratio))
    return best[1]


class _Piece:
    """Poses `index` of a path, over which begin (q, v) and attitude A of the IMU are free."""

    def __init__(self, index: NDArray[np.intp]) -> None:
        self.index = index
        self.q, self.v, self.A = np.zeros(3), np.zeros(3), np.eye(3)


def _pieces(path: LidarPath, imu: ImuSamples) -> list[NDArray[np.intp]]:
    """Consecutive poses of one segment, determined in all directions, within the samples, over about two seconds each."""
    information = np.linalg.eigvalsh(path.information)[:, 0]
    first = np.concatenate([[True], path.segment[1:] != path.segment[:-1]])
    margin = 100_000_000
    good = ((information > 0.0) & ~path.weak) | first
    good &= (path.time_ns > imu.time_ns[0] + margin) & (path.time_ns < imu.time_ns[-1] - margin)
    found: list[NDArray[np.intp]] = []
    run: list[int] = []
    for k in np.flatnonzero(good):
        new = bool(run) and (path.segment[k] != path.segment[run[-1]] or path.time_ns[k] - path.time_ns[run[0]] > _PIECE_S * 1e9)
        if new:
            found.append(np.array(run))
            run = []
        run.append(int(k))
    found.append(np.array(run, np.intp))
    return [index for index in found if len(index) >= _FEWEST_POSES]
