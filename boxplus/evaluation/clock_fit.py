"""How well the motions that two trajectories saw tell the offset between their clocks, and which one fits.

Where stamps of an estimate lack τ it lies, but for its frame and its scale, at p(t + τ) ≈ p(t) + τ v(t) of the ground truth. So τ
is a regression of what is left after an alignment on the velocity. Both are cut into stretches with an alignment each, which
takes drift away, and what τ becomes without one of the stretches in turn says how well it is known, whatever the errors are
(jackknife). Slow motion, noise and drift show in that, where a formula for white noise would promise milliseconds. What lasts
longer than a stretch shows as two in a row are left out together; what turns have, and places do not, or the other way round,
as their offsets are held against each other (`ClockFit.together`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.evaluation.clock_rate import ClockRate
from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import so3

Signal = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Vectors (n, 3) of a motion at times (n,) [s]."""

_STRETCHES, _LEAST_SAMPLES = 10, 12  # at most, and samples in each
LEAST_STRETCHES = 3
_LEAST_OF_RATE = 5  # stretches, as it takes two numbers
_MOST_SAMPLES = 2000
_SLOPE_S = 0.1  # shortest time over which a velocity is taken
_TURN_S = 0.5  # over which rotations are compared
_TOLD_BY_REST = 1e-6  # least eigenvalue of what all stretches but one tell, by what all of them do
_GAP_S, _GAP_STEPS = 0.25, 5.0  # and that of median steps: what is farther apart is not interpolated
_STEPS, _SETTLED_S = 10, 1e-5
# Standard deviations, and times (of squares), by which an offset fits worse than another that refutes it.
_CLEARLY, _WORSE = 4.0, 2.0
_OTHER_S = 0.1  # between the offsets of two signals, from which on they are not those of one clock
_AGREE = 1.5  # standard deviations, by which two signals differ without an error of their own
_ROUNDING = 1e-9  # of the squared slopes, that an alignment leaves of those it explains


@dataclass(frozen=True, slots=True)
class ClockFit:
    """An offset that fits, as one signal tells it.

    Attributes:
        offset_s: to be added to the stamps of the estimate [s].
        deviation_s: its standard deviation, by the jackknife over stretches [s].
        correlation: of the aligned motions at that offset, at most 1.
        signal: `rotation` or `translation`, or both.
    """

    offset_s: float
    deviation_s: float
    correlation: float
    signal: str

    @classmethod
    def together(cls, fits: list[ClockFit]) -> ClockFit | None:
        """What both signals tell, weighted; where they contradict each other one is off by an error that no stretch shows.

        Nothing tells which: half of the square by which their difference exceeds what they know is added to the variance. Offsets
        far apart are two, of motion that repeats itself: the better known counts.
        """
        best = sorted(fits, key=lambda fit: fit.deviation_s)
        if len(best) < 2 or abs(best[0].offset_s - best[1].offset_s) > _OTHER_S:
            return best[0] if best else None
        first, second = best
        known = first.deviation_s**2 + second.deviation_s**2
        beside = max(0.0, 0.5 * ((first.offset_s - second.offset_s) ** 2 - _AGREE**2 * known))
        share = first.deviation_s**2 / known if known > 0.0 else 0.0
        offset_s = (1.0 - share) * first.offset_s + share * second.offset_s
        deviation_s = math.sqrt(share * second.deviation_s**2 + beside)
        return cls(offset_s, deviation_s, first.correlation, f"{first.signal} and {second.signal}")


class MotionPair:
    """Two trajectories over the time that both cover, to be compared at any offset.

    Args:
        t_estimate, t_ground_truth: (N,) int64 stamps to use [ns]. estimate, ground_truth: the poses.
    """

    def __init__(
        self, t_estimate: NDArray[np.int64], estimate: Trajectory, t_ground_truth: NDArray[np.int64], ground_truth: Trajectory
    ) -> None:
        begin, end = max(t_estimate[0], t_ground_truth[0]), min(t_estimate[-1], t_ground_truth[-1])
        own, true = ((t - begin) * 1e-9 for t in (t_estimate, t_ground_truth))
        steps = [float(np.median(np.diff(t))) for t in (own, true)]
        self._slope_s = max(_SLOPE_S, *(2.0 * step for step in steps))
        inside = own[(own >= 0.0) & (own <= (end - begin) * 1e-9)]
        self._begin_ns = int(begin)
        self._t = inside[:: max(1, math.ceil(len(inside) / _MOST_SAMPLES))]
        turn_s = max(_TURN_S, self._slope_s)
        # What a signal needs on both sides of an instant, itself and for its slope.
        self.signals = {
            "translation": (_places(own, estimate), _places(true, ground_truth), 0.5 * self._slope_s),
            "rotation": (
                _turns(own, estimate, turn_s),
                _turns(true, ground_truth, turn_s),
                0.5 * (self._slope_s + turn_s),
            ),
        }
        self._covered = [_Covered(t, max(_GAP_S, _GAP_STEPS * step)) for t, step in zip((own, true), steps, strict=True)]

    def are_alike(self, offset_s: float, least: float) -> bool:
        """Whether the places of both make one shape, as a whole, with at least this correlation."""
        own, true, _ = self.signals["translation"]
        t = self._t[self._covered[0](self._t, 0.0) & self._covered[1](self._t + offset_s, 0.0)]
        if len(t) < _LEAST_SAMPLES:
            return False
        x, y = own(t), true(t + offset_s)
        left, size = float((_aligned_error(x, y) ** 2).sum()), float(((y - y.mean(axis=0)) ** 2).sum())
        return left < (1.0 - least**2) * size

    def misfits(self, offsets_s: list[float]) -> list[NDArray[np.float64]]:
        """What every offset leaves, (offsets, k) squares over k stretches of the path, the same samples for all.

        Of the places as a whole, with one alignment, then of either signal, with an alignment for every stretch.
        """
        own, true, _ = self.signals["translation"]
        widest_s = max(map(abs, offsets_s))
        t = self._t[self._covered[0](self._t, 0.0) & self._covered[1](self._t, widest_s)]
        parts = []
        if len(t) >= _STRETCHES * _LEAST_SAMPLES:
            off = [(_aligned_error(own(t), true(t + offset_s)) ** 2).sum(axis=1) for offset_s in offsets_s]
            parts.append(np.array([[part.sum() for part in np.array_split(one, _STRETCHES)] for one in off]))
        for name in self.signals:
            stretches = [self._stretches(name, offset_s, widest_s=widest_s) for offset_s in offsets_s]
            parts.append(np.array([[part.left for part in one] for one in stretches]).reshape(len(offsets_s), -1))
        return parts

    def fit(self, name: str, offset_s: float, largest_s: float) -> ClockFit | None:
        """The offset near `offset_s`, at most `largest_s` from it; None where the motions do not tell one."""
        at, stretches, step = offset_s, [], 0.0
        for _ in range(_STEPS):
            stretches = self._stretches(name, at)
            told = sum(one.told for one in stretches)
            if len(stretches) < LEAST_STRETCHES or not told > _ROUNDING * sum(one.moved for one in stretches):
                return None
            if not _white_deviation(stretches) < largest_s:
                return None
            step = sum(one.pull for one in stretches) / told
            at += float(step)
            if not abs(at - offset_s) < largest_s:
                return None
            if abs(step) < _SETTLED_S:
                break
        pull, told_by = (np.array([getattr(one, name) for one in stretches]) for name in ("pull", "told"))
        deviation = jackknife(pull, told_by)
        if len(stretches) >= 2 * LEAST_STRETCHES:  # errors that last longer than one
            pairs = np.arange(0, len(stretches), 2)
            deviation = max(deviation, jackknife(np.add.reduceat(pull, pairs), np.add.reduceat(told_by, pairs)))
        # Slopes of noise alone, as of a circle at constant speed, where a turn is an offset, scatter less than they know.
        deviation = max(deviation, _white_deviation(stretches))
        if not math.isfinite(deviation) or abs(step) > 0.1 * deviation:
            return None
        left, size = sum(one.left for one in stretches), sum(one.size for one in stretches)
        return ClockFit(at, deviation, math.sqrt(max(1.0 - left / max(size, 1e-300), 0.0)), name)

    def fit_rate(self, name: str, offset_s: float, largest_s: float) -> ClockRate | None:
        """Offset and rate together, at most `largest_s` from an offset anywhere; None where the motions do not tell them."""
        middle_s = 0.5 * float(self._t[0] + self._t[-1])
        at, half_s = np.array([offset_s, 0.0]), max(middle_s - float(self._t[0]), 1e-9)
        parts: list[_RateStretch] = []
        for _ in range(_STEPS):
            shift_s = at[0] + at[1] * (self._t - middle_s)
            parts = [_RateStretch.of(part, middle_s) for part in self._cut(name, shift_s, shift_s, 0.0)]
            told = np.sum([part.told for part in parts], axis=0)
            if len(parts) < _LEAST_OF_RATE or not np.linalg.eigvalsh(told)[0] > 0.0:
                return None
            step = np.linalg.solve(told, np.sum([part.pull for part in parts], axis=0))
            at += step
            if not abs(at[0] - offset_s) + abs(at[1]) * half_s < largest_s:
                return None
            if abs(step[0]) + abs(step[1]) * half_s < _SETTLED_S:
                break
        else:
            return None
        # Where one stretch alone tells them, how far they scatter is not known.
        scale = np.sqrt(np.outer(told.diagonal(), told.diagonal()))
        if not all(np.linalg.eigvalsh((told - part.told) / scale)[0] > _TOLD_BY_REST for part in parts):
            return None
        without = [
            np.linalg.solve(told - part.told, np.sum([other.pull for other in parts if other is not part], axis=0))
            for part in parts
        ]
        spread = _scatter(np.array(without))
        rate, offset = (float(value) for value in at[::-1])
        return ClockRate(rate, float(spread[1]), offset, float(spread[0]), self._begin_ns + round(1e9 * middle_s), half_s)

    def _stretches(self, name: str, offset_s: float, widest_s: float = 0.0) -> list[_Stretch]:
        """Every stretch compared at an offset; of all offsets up to `widest_s` the same samples."""
        shift_s = np.full(len(self._t), offset_s)
        return [_Stretch.of(part) for part in self._cut(name, shift_s, 0.0 if widest_s else shift_s, widest_s)]

    def _cut(
        self, name: str, shift_s: NDArray[np.float64], covered_s: NDArray[np.float64] | float, widest_s: float
    ) -> list[_Part]:
        """The motions of both, the ground truth's later by `shift_s` (n,), in stretches; none where there are too few.

        Args:
            covered_s, widest_s: where the ground truth has to be there, around which shift and how far.
        """
        own, true, around = self.signals[name]
        inside = self._covered[0](self._t, around) & self._covered[1](self._t + covered_s, around + widest_s)
        t, shift_s = self._t[inside], shift_s[inside]
        count = min(_STRETCHES, len(t) // _LEAST_SAMPLES)
        if count < LEAST_STRETCHES:
            return []
        x, y = own(t), true(t + shift_s)
        half = 0.5 * self._slope_s
        u = (own(t + half) - own(t - half)) / self._slope_s
        v = (true(t + shift_s + half) - true(t + shift_s - half)) / self._slope_s
        edges = np.searchsorted(t, np.linspace(t[0], t[-1], count + 1)[1:-1])
        parts = zip(*(np.split(array, edges) for array in (t, x, y, u, v)), strict=True)
        return [_Part.of(*part) for part in parts if len(part[0]) >= _LEAST_SAMPLES]


@dataclass(frozen=True, slots=True)
class _Motion:
    """Vectors x (n, 3) of one motion over a stretch about their mean, and their slopes u (n, 3)."""

    x: NDArray[np.float64]
    u: NDArray[np.float64]

    def beyond(self, factor: NDArray[np.float64] | float = 1.0) -> NDArray[np.float64]:
        """(3 n,) of the slopes, each times a factor, what place, turn and scale of the stretch do not explain as well.

        By the motion's own turn and scale: of a circle at constant speed nothing is left but its own noise, which that of
        another motion has nothing to do with.
        """
        free = np.zeros((len(self.x), 3, 4))
        for axis, (one, other) in enumerate(((1, 2), (2, 0), (0, 1))):
            free[:, one, axis], free[:, other, axis] = -self.x[:, other], self.x[:, one]
        free[:, :, 3] = self.x
        basis, lengths, _ = np.linalg.svd(free.reshape(-1, 4), full_matrices=False)
        basis = basis[:, lengths > 1e-9 * max(lengths[0], 1e-300)]
        slope = factor * self.u
        flat = (slope - slope.mean(axis=0)).reshape(-1)
        return np.asarray(flat - basis @ (basis.T @ flat))


@dataclass(frozen=True, slots=True)
class _Part:
    """One stretch at times t (n,) [s]: the estimate, laid onto the ground truth by a similarity of its own, and that."""

    t: NDArray[np.float64]
    own: _Motion
    true: _Motion

    @classmethod
    def of(
        cls,
        t: NDArray[np.float64],
        x: NDArray[np.float64],
        y: NDArray[np.float64],
        u: NDArray[np.float64],
        v: NDArray[np.float64],
    ) -> _Part:
        """From vectors x of the estimate and y of the ground truth and their slopes u and v, all (n, 3)."""
        scale, R = _similarity(x, y)
        own = _Motion(scale * (x - x.mean(axis=0)) @ R.T, scale * u @ R.T)
        return cls(t, own, _Motion(y - y.mean(axis=0), v))

    @property
    def error(self) -> NDArray[np.float64]:
        """(3 n,) estimate less ground truth."""
        return (self.own.x - self.true.x).reshape(-1)


@dataclass(frozen=True, slots=True)
class _Stretch:
    """Of one stretch: the regression's two sums, squares of the slopes, of what is left and of the motion, and their number.

    `moved` are the slopes, `wide` what of them tells, with its noise.
    """

    pull: float
    told: float
    moved: float
    wide: float
    left: float
    size: float
    count: int

    @classmethod
    def of(cls, part: _Part) -> _Stretch:
        """The sums of a stretch."""
        u, v, e = part.own.beyond(), part.true.beyond(), part.error
        mean = 0.5 * (u + v)
        # The noise of one slope is not that of the other: their product is free of it, where a square would count it as motion.
        moved, size = sum(float((one.u * one.u).sum()) for one in (part.own, part.true)), float((part.true.x**2).sum())
        return cls(float(mean @ e), float(u @ v), moved, float(mean @ mean), float(e @ e), size, len(e))


@dataclass(frozen=True, slots=True)
class _RateStretch:
    """The two sums of the regression on offset and rate, (2,) and (2, 2)."""

    pull: NDArray[np.float64]
    told: NDArray[np.float64]

    @classmethod
    def of(cls, part: _Part, middle_s: float) -> _RateStretch:
        """The sums of a stretch, with the offset in the middle of the way."""
        since = (part.t - middle_s)[:, None]
        u, v = (np.stack([motion.beyond(), motion.beyond(since)]) for motion in (part.own, part.true))
        cross = u @ v.T
        return cls(0.5 * (u + v) @ part.error, 0.5 * (cross + cross.T))


def _white_deviation(stretches: list[_Stretch]) -> float:
    """Standard deviation of the offset, were what is left white noise: the least that it can be [s]."""
    told, wide = sum(one.told for one in stretches), sum(one.wide for one in stretches)
    variance = sum(one.left for one in stretches) / max(sum(one.count for one in stretches), 1)
    return math.sqrt(variance * wide) / max(told, 1e-300)


def _similarity(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """Scale and rotation (3, 3) that bring x (n, 3) nearest to y (n, 3), each about its mean (Umeyama 1991)."""
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    U, d, Vt = np.linalg.svd(y.T @ x)
    sign = np.array([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)])
    return float(d @ sign) / max(float((x * x).sum()), 1e-300), (U * sign) @ Vt


def _aligned_error(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) what is left between them after that."""
    scale, R = _similarity(x, y)
    return np.asarray(scale * (x - x.mean(axis=0)) @ R.T - (y - y.mean(axis=0)))


def as_good(parts: NDArray[np.float64]) -> NDArray[np.intp]:
    """Which of several offsets, that leave `parts` (offsets, k) over k stretches, none fits clearly better than.

    Every stretch gives a difference to the best one, and how these scatter says how clear their mean is.
    """
    best = parts[np.argmin(parts.sum(axis=1))]
    more = parts - best
    deviation = more.std(axis=1, ddof=1) / math.sqrt(parts.shape[1])
    is_worse = (parts.sum(axis=1) > _WORSE * best.sum()) & (more.mean(axis=1) > _CLEARLY * deviation)
    return np.flatnonzero(~is_worse)


def jackknife(pull: NDArray[np.float64], told: NDArray[np.float64]) -> float:
    """Standard deviation of Σ pull / Σ told, as it scatters when each stretch is left out; infinite where one alone tells.

    Args:
        pull, told: (k,) the two sums of the regression in every stretch.
    """
    without = told.sum() - told
    if len(told) < 2 or not (without > 0.0).all():
        return math.inf
    return float(_scatter((pull.sum() - pull) / without))


def _scatter(without: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation of what k stretches tell together, from what is told (k, …) when each is left out."""
    variance = (len(without) - 1) / len(without) * ((without - without.mean(axis=0)) ** 2).sum(axis=0)
    return np.asarray(np.sqrt(variance))


class _Covered:
    """Whether there are poses all around an instant."""

    def __init__(self, t: NDArray[np.float64], gap_s: float) -> None:
        self._begin, self._end = float(t[0]), float(t[-1])
        after = np.flatnonzero(np.diff(t) > gap_s)
        self._gaps = t[after], t[after + 1]

    def __call__(self, t: NDArray[np.float64], around: float) -> NDArray[np.bool_]:
        inside = (t - around >= self._begin) & (t + around <= self._end)
        # The number of gaps that began before the end of the window less those that ended before its begin.
        begun, ended = (np.searchsorted(edge, at) for edge, at in zip(self._gaps, (t + around, t - around), strict=True))
        return np.asarray(inside & (begun == ended))


def _places(t: NDArray[np.float64], trajectory: Trajectory) -> Signal:
    return lambda at: np.stack([np.interp(at, t, axis) for axis in trajectory.p.T], axis=1)


def _turns(t: NDArray[np.float64], trajectory: Trajectory, over_s: float) -> Signal:
    """Rotation vectors by which a body turns over a time, in its own frame."""
    R = trajectory.R
    steps = so3.log(R[:-1].transpose(0, 2, 1) @ R[1:])

    def orientation(at: NDArray[np.float64]) -> NDArray[np.float64]:
        before = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
        gap = t[before + 1] - t[before]  # none where a stamp is there twice
        share = (at - t[before]) / np.where(gap > 0.0, gap, 1.0)
        return np.asarray(R[before] @ so3.exp(share[:, None] * steps[before]))

    return lambda at: so3.log(orientation(at - 0.5 * over_s).transpose(0, 2, 1) @ orientation(at + 0.5 * over_s))
