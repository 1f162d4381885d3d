"""Gyroscope against LiDAR: the mounting's rotation, the clocks' offset, the gyroscope's scale and bias, from how both turned.

Over the interval between two scans the LiDAR turns at the mean rate ω_L and the gyroscope shows s R_imu_lidar ω_L + b, at times
that differ by the clocks' offset. Two sets of vectors give the rotation between them (Wahba, SIAM Review 1965; Kabsch 1976;
Umeyama 1991); offset, scale and bias join in a Gauss-Newton estimate with one covariance for all eight, so that what the motion
does not show is not claimed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.sensors.inertial.gyro_attitude import GyroAttitude
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.lidar_inertial_agreement.held_back import turns_held_back
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.scan_pairs import scan_pairs

_LARGEST_OFFSET_S = 0.6
_OFFSET_KNOWN_S = 0.012
_OFFSET_STEP_S = 0.02
FEWEST_INTERVALS = 8
SCALE = 6  # its row of the covariance
_ROUNDS = 8
_NO_BETTER = 0.5
_DEGREES = 180.0 / np.pi
_SLOPE_S = 0.05  # each way, over which rates change: the noise of a gyroscope changes at every sample
_LEAST_SIGMA = 0.02  # rad/s: of a mean rate between two scans by registration alone
_FLOOR = np.array([2e-3, 2e-3, 2e-3, 0.0, 0.0, 0.0, 5e-3, 3e-3])  # what no number of scans averages away: registration lags
_LED_ASTRAY = 0.02  # of what is explained, by which steps must not make it less
_OPEN_RAD = 0.35  # standard deviation about an axis that the motion does not show
_SAME_AXIS = 0.9  # cosine: the axis that a covariance leaves open also follows scale and clocks, and lies near that of the turns
_FASTEST = 0.75  # of the intervals count by their rates, those above as much as these
_IDENTITY = 1e-3  # pull towards the identity, of the LiDAR's power: decides what the motion leaves open


def turned_towards(R: NDArray[np.float64], R_other: NDArray[np.float64], axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) R turned about a unit axis (3,) on its left as close to another rotation as that brings it."""
    between = R @ R_other.T
    along, across = float(axis @ between @ axis), np.trace(so3.hat(axis) @ between)
    angle = np.arctan2(across, np.trace(between) - along)
    return np.asarray(so3.exp(angle * axis) @ R, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class RotationFit:
    """What the comparison of both rotations shows.

    Attributes:
        R_imu_lidar: (3, 3). Where the motion leaves it open, the closest to what was expected.
        offset_s: add this to the LiDAR's times to bring them to the IMU's clock [s].
        scale: the gyroscope's rotation over the LiDAR's: 1, or 57.3 for a gyroscope in deg/s.
        bias: (3,) of the gyroscope, in its own unit.
        covariance: (8, 8) of [θ about the IMU's axes, bias, log scale, offset].
        sigma: rms of what is left of the rates [rad/s].
        explained: share of the LiDAR's rotation rates (squared) that the gyroscope shows, 0 to 1.
        mirrored: the same share if one of both were mirrored (no rotation has a determinant of −1), clocks as they are.
        together: share of both sensors' rotation that is common to them, 0 to 1; small where either turns and the other does not.
        sigma_registration: what of the LiDAR's rates changes from scan to scan without a trend [rad/s], its noise at most.
        excitation: (3,) rms rates of the LiDAR along its principal axes, descending [rad/s].
        intervals: pairs of scans compared.
        covered: share of the path that these pairs span, 0 to 1.
        coarse: whether the pairs are scans farther apart, as neighbours did not know their attitudes well enough.
        main_axis: (3,) unit, IMU frame, about which the LiDAR's rate changed most.
    """

    R_imu_lidar: NDArray[np.float64]
    offset_s: float
    scale: float
    bias: NDArray[np.float64]
    covariance: NDArray[np.float64]
    sigma: float
    explained: float
    mirrored: float
    together: float
    sigma_registration: float
    excitation: NDArray[np.float64]
    intervals: int
    covered: float
    coarse: bool
    main_axis: NDArray[np.float64]

    def closest_to(self, R_imu_lidar: NDArray[np.float64]) -> NDArray[np.float64]:
        """(3, 3) what the motion shows of the mounting, and about an axis that it leaves open as another mounting is.

        Covariances are of small turns. About an open axis the estimate is any turn away from a mounting, and along axes that are
        not quite across it, some of that turn would pass for a disagreement.
        """
        return self.R_imu_lidar if self.open_axis is None else turned_towards(self.R_imu_lidar, R_imu_lidar, self.open_axis)

    @property
    def open_axis(self) -> NDArray[np.float64] | None:
        """(3,) unit, IMU frame: the one about which the mounting stays open, as all else turned about it; None where none is."""
        std, axes = self.rotation_std
        if np.count_nonzero(std > _OPEN_RAD) != 1 or abs(float(axes[:, -1] @ self.main_axis)) < _SAME_AXIS:
            return None
        return self.main_axis

    @property
    def rotation_std(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(3,) standard deviations of R_imu_lidar [rad], ascending, and the axes in the IMU frame, one a column (3, 3)."""
        variance, axes = np.linalg.eigh(self.covariance[:3, :3])
        return np.minimum(np.sqrt(variance), np.pi), axes

    @property
    def offset_std_s(self) -> float:
        return float(np.sqrt(self.covariance[7, 7]))

    @property
    def knows_offset(self) -> bool:
        """Whether the offset of the clocks is known well enough to be told."""
        return self.offset_std_s < _OFFSET_KNOWN_S

    @property
    def scale_std(self) -> float:
        """Relative."""
        return float(np.sqrt(self.covariance[SCALE, SCALE]))


def compare_rotations(path: LidarPath, imu: ImuSamples, R_expected: NDArray[np.float64] | None = None) -> RotationFit | None:
    """Compare the rotations of a LiDAR's path with a gyroscope's; None with fewer than eight scan pairs within its samples.

    Args:
        path: from `lidar_path`.
        imu: finite samples in order of time.
        R_expected: (3, 3) R_imu_lidar to stay close to where the motion does not tell; the identity when None.
    """
    attitude = GyroAttitude(imu.time_ns, imu.gyro)
    pairs = scan_pairs(path, imu, attitude)
    if len(pairs.first) < FEWEST_INTERVALS:
        return None
    begin_ns, end_ns = path.time_ns[pairs.first], path.time_ns[pairs.last]
    step_s = (end_ns - begin_ns)[:, None] * 1e-9
    turned = np.swapaxes(path.R_path_lidar[pairs.first], 1, 2) @ path.R_path_lidar[pairs.last]
    rate_lidar = so3.log(turned) / step_s
    expected = np.eye(3) if R_expected is None else R_expected

    def plain(offset_s: float) -> NDArray[np.float64]:
        shift = round(offset_s * 1e9)
        return (attitude.integral(end_ns + shift) - attitude.integral(begin_ns + shift)) / step_s

    # First unit and offset, with plain integrals: a gyroscope in deg/s turns several times around between two scans.
    room_s = min(_LARGEST_OFFSET_S, 0.5 * float(path.time_ns[-1] - path.time_ns[0]) * 1e-9)
    steps = max(round(room_s / _OFFSET_STEP_S), 1)
    offsets = np.arange(-steps, steps + 1) * _OFFSET_STEP_S
    fits = [_Kabsch(plain(offset), rate_lidar, expected) for offset in offsets]
    best = int(np.argmin([fit.cost for fit in fits]))
    unit = _DEGREES if 7.6 < fits[best].scale < 430.0 else 1.0 / _DEGREES if fits[best].scale < 1.0 / 7.6 else 1.0
    attitude = attitude.scaled(1.0 / unit)

    def exact(offset_s: float) -> NDArray[np.float64]:
        shift = round(offset_s * 1e9)
        return so3.log(np.swapaxes(attitude.at(begin_ns + shift), 1, 2) @ attitude.at(end_ns + shift)) / step_s

    # From the best offset of the search and from none: where they come to the same, the sharper one is right.
    candidates = [_Refined(exact, rate_lidar, expected, offset) for offset in dict.fromkeys((0.0, float(offsets[best])))]
    best_fit = max(candidates, key=lambda fit: fit.explained)
    if candidates[0].explained > best_fit.explained - _NO_BETTER * (1.0 - best_fit.explained):
        best_fit = candidates[0]
    R, scale, bias, offset = best_fit.R, best_fit.scale, best_fit.bias, best_fit.offset_s
    weight, residual = best_fit.weight, best_fit.residual
    # Intervals that overlap count once.
    H: NDArray[np.float64] = best_fit.H / pairs.overlap
    count = float(weight.sum()) / pairs.overlap
    noise = (weight[:, None] * residual).T @ residual / pairs.overlap
    variance = max(float(np.trace(noise)) / max(3.0 * count - 8.0, 1.0), _LEAST_SIGMA**2 / 9.0, _variance_turning(best_fit))
    changes = 3.0 * count * _change_variance(imu, float(np.median(step_s))) / unit**2
    covariance = _covariance(_without_noise_of_changes(H / variance, changes / variance, count), noise / variance, count)
    covariance += np.diag(_FLOOR**2)
    held = turns_held_back(path)
    covariance[SCALE, SCALE] += held**2
    covariance[:3, :3] += (0.5 * held) ** 2 * np.eye(3)  # less of a turn about one of two axes bends what both make by half of it
    centred = rate_lidar - rate_lidar.mean(axis=0)
    power = np.maximum(np.linalg.eigvalsh(centred.T @ centred / len(centred))[::-1], 0.0)
    total = float((centred**2).sum())
    # A flipped sign is looked for with clocks as they are: at some other offset anything fits a little.
    final, unshifted = exact(offset), exact(0.0)
    proper, improper = _Kabsch(final, rate_lidar, expected), _Kabsch(unshifted, rate_lidar, expected, mirrored=True)
    explained, mirrored = proper.explained, improper.explained
    # Of both: a gyroscope that turns while the LiDAR rests fits no better than the other way round.
    both = float(((final - final.mean(axis=0)) ** 2).sum()) + proper.scale**2 * total
    together = max(1.0 - 2.0 * float((proper.residual**2).sum()) / max(both, 1e-12), 0.0)
    fit = RotationFit(
        R,
        offset,
        scale * unit,
        bias * unit,
        covariance,
        float(np.sqrt(variance)),
        explained,
        mirrored,
        together,
        pairs.jitter,
        np.sqrt(power),
        len(pairs.first),
        pairs.covered,
        pairs.overlap > 1.0,
        _main_axis(best_fit),
    )
    closest = fit.closest_to(expected)
    mean = weight @ rate_lidar / weight.sum()
    return replace(fit, R_imu_lidar=closest, bias=unit * (bias + scale * (R - closest) @ mean))


def _counts(rate: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K,) how much intervals show of a mounting: their squared rates (K, 3), but none more than a quarter of them all.

    A few fast ones, at a bump that registrations follow roughly, would else be all that counts.
    """
    squared = ((rate - rate.mean(axis=0)) ** 2).sum(axis=1)
    counts: NDArray[np.float64] = np.minimum(squared, np.quantile(squared, _FASTEST)) + 1e-12
    return counts


def _typical(off: NDArray[np.float64], rate: NDArray[np.float64]) -> float:
    """The median of what intervals are off by (K,), each as often as it counts by its rate (K, 3), the gyroscope's.

    Where a platform rests and then moves, most intervals are off by the noise of rest only, and show nothing. Against that, those
    that show the mounting would all be outliers, but for the few that happen to fit.
    """
    order = np.argsort(off)
    counts = np.cumsum(_counts(rate)[order])
    return float(off[order[np.searchsorted(counts, 0.5 * counts[-1])]])


def _variance_turning(fit: _Refined) -> float:
    """Variance of the rates [(rad/s)²] of the intervals that show the mounting, each as it counts."""
    counts = fit.weight * _counts(fit.seen)
    many = float(counts.sum() ** 2 / (counts**2).sum())
    return float(counts @ (fit.residual**2).sum(axis=1) / counts.sum()) * many / max(3.0 * many - 8.0, 1.0)


def _main_axis(fit: _Refined) -> NDArray[np.float64]:
    """(3,) about which most turned, IMU frame, by the intervals that the fit counts: one bad registration turns any axis."""
    rate = fit.seen - fit.weight @ fit.seen / fit.weight.sum()
    axis: NDArray[np.float64] = np.linalg.eigh((fit.weight[:, None] * rate).T @ rate)[1][:, -1]
    return axis


def _covariance(H: NDArray[np.float64], noise: NDArray[np.float64], count: float) -> NDArray[np.float64]:
    """(8, 8) of the estimate, of which the rates that are turned carry noise themselves (errors in variables).

    Noise looks like turning about every axis: where a platform turns about one only, it would make the mounting about that axis
    known. What it adds to the information of the rotation is taken off again, with three standard deviations of that sum; with
    the rest S₀ the rotation has the covariance S₀⁻¹ S S₀⁻¹, and all else what it has for a known rotation, and
    what follows from it.

    Args:
        H: (8, 8) information of [θ, bias, log scale, offset]; noise: (3, 3) sum of squares of what is left of the rates about the
            IMU's axes, over the same variance; count: of the rates.
    """
    H = H + np.diag(1.0 / np.array([np.pi, np.pi, np.pi, 10.0, 10.0, 10.0, 3.0, 1.0]) ** 2)
    rest = np.linalg.inv(H[3:, 3:])
    follows = np.vstack([np.eye(3), -rest @ H[3:, :3]])
    S = H[:3, :3] - H[:3, 3:] @ rest @ H[3:, :3]
    added = (1.0 + 3.0 * np.sqrt(2.0 / max(count, 1.0))) * (np.trace(noise) * np.eye(3) - noise)
    values, axes = np.linalg.eigh(S - added)
    inverse = (axes / np.maximum(values, 1.0 / np.pi**2)) @ axes.T
    values, axes = np.linalg.eigh(inverse @ S @ inverse)
    rotation = (axes * np.minimum(values, np.pi**2)) @ axes.T
    covariance: NDArray[np.float64] = follows @ rotation @ follows.T
    covariance[3:, 3:] += rest
    return covariance


def _change_variance(imu: ImuSamples, step_s: float) -> float:
    """What noise adds to the squared change of a mean rate over `step_s`, by which an offset is known; an axis, own unit²/s²."""
    if len(imu) < 3:
        return 0.0
    second = np.diff(imu.gyro, n=2, axis=0)
    sample = float(np.median((second**2).sum(axis=1))) / (2.37 * 6.0)  # the median of the square of a 3-d normal's length
    mean = sample * float(np.median(np.diff(imu.time_ns))) * 1e-9 / step_s
    return 2.0 * mean * min(2.0 * _SLOPE_S / step_s, 1.0) / (2.0 * _SLOPE_S) ** 2


def _without_noise_of_changes(H: NDArray[np.float64], added: float, count: float) -> NDArray[np.float64]:
    """The information H (8, 8) without what the gyroscope's noise added to that of the offset, as `_covariance` for the rotation.

    Args:
        H: of [θ, bias, log scale, offset]; added: the sum of squared changes that is noise, over the same variance.
        count: of rates.
    """
    others = H[:7, :7] + 1e-9 * np.eye(7)
    known = 1.0 + float(H[7, 7] - H[7, :7] @ np.linalg.solve(others, H[:7, 7]))  # by itself to a second
    rest = max(known - (1.0 + 3.0 * np.sqrt(2.0 / max(3.0 * count, 1.0))) * added, 1.0)
    H = H.copy()
    H[7, 7] -= known - rest**2 / known
    return H


class _Refined:
    """Gauss-Newton on rotation, bias, scale and offset together, robustly, from the best rotation at one offset."""

    R: NDArray[np.float64]
    scale: float
    bias: NDArray[np.float64]
    offset_s: float

    def __init__(
        self,
        exact: Callable[[float], NDArray[np.float64]],
        rate_lidar: NDArray[np.float64],
        R_expected: NDArray[np.float64],
        offset_s: float,
    ) -> None:
        self._exact, self._rate_lidar = exact, rate_lidar
        start = _Kabsch(exact(offset_s), rate_lidar, R_expected)
        self._begin(start, offset_s)
        for _ in range(_ROUNDS):
            step = -np.linalg.solve(*self._linearized())
            self.R = so3.exp(step[:3]) @ self.R
            self.bias = self.bias + step[3:6]
            self.scale *= float(np.exp(np.clip(step[6], -0.7, 0.7)))
            self.offset_s += float(np.clip(step[7], -0.02, 0.02))
            if np.abs(step).max() < 1e-6:
                break
        if self._explained() < start.explained - _LED_ASTRAY:
            # What hardly changes shows neither scale nor offset, and steps along them lead anywhere.
            self._begin(start, offset_s)
            self._linearized()
        self.explained = _Kabsch(exact(self.offset_s), rate_lidar, R_expected).explained

    def _begin(self, start: _Kabsch, offset_s: float) -> None:
        self.R, self.scale, self.bias, self.offset_s = start.R, max(start.scale, 1e-3), start.bias, offset_s

    def _explained(self) -> float:
        """Share of the LiDAR's turning that these rotation, scale and offset explain, as `_Kabsch.explained` is of its own."""
        left = self._exact(self.offset_s) - self.scale * self._rate_lidar @ self.R.T
        turned = self._rate_lidar - self._rate_lidar.mean(axis=0)
        return 1.0 - float(((left - left.mean(axis=0)) ** 2).sum()) / max(self.scale**2 * float((turned**2).sum()), 1e-12)

    def _linearized(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The normal equations (8, 8), (8,) of a step from where the estimate is; residuals, weights and information there."""
        rate_imu = self._exact(self.offset_s)
        slope = (self._exact(self.offset_s + _SLOPE_S) - self._exact(self.offset_s - _SLOPE_S)) / (2.0 * _SLOPE_S)
        self.seen = seen = self.scale * self._rate_lidar @ self.R.T
        self.residual = rate_imu - seen - self.bias
        norm = np.linalg.norm(self.residual, axis=1)
        sigma = max(1.4826 * _typical(norm, rate_imu) / 1.54, 1e-3)  # the median of a 3-d normal's length is 1.54 sigma
        self.weight: NDArray[np.float64] = 1.0 / (1.0 + (norm / (4.0 * sigma)) ** 2) ** 2
        # Derivatives of the residual: R <- Exp(θ) R, bias, log scale, offset.
        J = np.zeros((len(self._rate_lidar), 3, 8))
        J[:, :, :3] = so3.hat(seen)
        J[:, :, 3:6] = -np.eye(3)
        J[:, :, 6] = -seen
        J[:, :, 7] = slope
        root = np.sqrt(self.weight)
        flat = (J * root[:, None, None]).reshape(-1, 8)
        self.H: NDArray[np.float64] = flat.T @ flat
        # What the motion does not show stays: a pull too small to matter where it does.
        prior = np.array([1e-3, 1e-3, 1e-3, 1e-6, 1e-6, 1e-6, 1e-3, 1e-3]) * sigma**2
        return self.H + np.diag(prior), flat.T @ (self.residual * root[:, None]).reshape(-1)


class _Kabsch:
    """rate_imu ≈ scale R rate_lidar + bias, robustly (Geman-McClure on the scale of the median residual)."""

    def __init__(
        self,
        rate_imu: NDArray[np.float64],
        rate_lidar: NDArray[np.float64],
        R_expected: NDArray[np.float64],
        *,
        mirrored: bool = False,
    ) -> None:
        weight = np.ones(len(rate_imu))
        for _ in range(4):
            total = weight.sum()
            mean_imu, mean_lidar = weight @ rate_imu / total, weight @ rate_lidar / total
            a, b = rate_imu - mean_imu, rate_lidar - mean_lidar
            power = max(float(((b * weight[:, None]) * b).sum()) / total, 1e-12)
            H = (a * weight[:, None]).T @ b / total
            pull = _IDENTITY * max(float(np.linalg.norm(H)), 1e-12)
            U, _, Vt = np.linalg.svd(H + pull * R_expected)
            sign = np.linalg.det(U @ Vt) * (-1.0 if mirrored else 1.0)
            self.R: NDArray[np.float64] = U @ np.diag([1.0, 1.0, np.sign(sign)]) @ Vt
            rotated = b @ self.R.T
            self.scale: float = max(float((weight[:, None] * a * rotated).sum()) / float(total) / power, 1e-6)
            self.bias: NDArray[np.float64] = mean_imu - self.scale * self.R @ mean_lidar
            self.residual: NDArray[np.float64] = a - self.scale * rotated
            norm = np.linalg.norm(self.residual, axis=1)
            # Of a platform that mostly turns steadily the median is far below what registration knows of its few fast turns:
            # these would be thrown out as outliers, and with them all that shows the mounting about the other axes.
            sigma = max(float(np.median(norm)), self.scale * _LEAST_SIGMA / 3.0)
            weight = 1.0 / (1.0 + (norm / (3.0 * sigma)) ** 2) ** 2
        left, turned = float((self.residual**2).sum()), float((b * b).sum())
        self.explained: float = 1.0 - min(left / max(self.scale**2 * turned, 1e-12), 1.0)
        # Relative to what turned, so that a scale near zero does not look like a good fit.
        self.cost = float(np.median(norm)) / (self.scale * np.sqrt(power))
