"""The offset between two clocks, from the motion that both trajectories saw."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.evaluation.clock_fit import LEAST_STRETCHES, ClockFit, MotionPair, as_good, jackknife
from boxplus.evaluation.clock_rate import ClockRate
from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import so3

_LEAST_OVERLAP_S = 5.0
_NEAR, _FAR = (2.0, 0.8), (60.0, 0.9)  # largest offset [s] and the correlation it takes; far ones have more to choose from
_MOST_SAMPLES = 60_000
_AROUND_S = 0.5  # [s] of what correlation found, within which the offset is refined
_APART_S = 0.25  # between starts of the regression, where nothing correlates; half of a step of a walk
_ALIKE = 0.95  # correlation of the places as a whole, from which on an offset is looked for that speeds do not tell
_SURE = 3.0  # of its standard deviations, that an offset has to be to show
# How much more of the variance an offset may leave than the best one, to be held against the motions.
_AS_GOOD, _LEAST_UNEXPLAINED = 2.0, 0.02
# Offsets beyond the near ones that are held against the motions: the nearest, and the best; and how far apart they are at least.
_NEAREST, _BEST, _SAME_S = 15, 5, 0.02
_PARTS, _FEW = 5, 2.2  # of the way, by which an offset scatters; what Student's t makes of three deviations of so few, over three
_NAMED = 3

Floats = NDArray[np.float64]
_Speed = Callable[[NDArray[np.int64], Trajectory, Floats, float], Floats]


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """The offset that makes two motions fit best.

    Attributes:
        offset_s: to be added to the stamps of the estimate [s].
        correlation: normalised correlation of the two motions at that offset, at most 1.
        signal: `rotation`, `translation` or both: which motion tells it.
        deviation_s: standard deviation of the offset, as it scatters over the stretches of the path and between the signals [s].
        others_s: offsets that fit as well, as the motion repeats itself, in order of their size [s].
        rate: of the clocks against each other, found together with an offset; None where the motions do not tell it.
    """

    offset_s: float
    correlation: float
    signal: str
    deviation_s: float
    others_s: tuple[float, ...] = ()
    rate: ClockRate | None = None

    @property
    def least_s(self) -> float:
        """What an offset has to exceed to show: three standard deviations [s]."""
        return _SURE * self.deviation_s

    @property
    def shows(self) -> bool:
        """Whether the motions know it well enough not to have come by it by noise."""
        return abs(self.offset_s) > self.least_s

    def __str__(self) -> str:
        digits = 3 if self.deviation_s >= 0.001 else 4
        return f"{round(self.offset_s, digits) + 0.0:+.{digits}f} ± {self.deviation_s:.{digits}f} s"

    @property
    def repetition(self) -> str:
        """`; as the motion repeats itself, +1.480 s or -1.480 s fit as well`, or nothing."""
        if not self.others_s:
            return ""
        listed = " or ".join(f"{offset:+.3f} s" for offset in self.others_s[:_NAMED])
        more = f" or {len(self.others_s) - _NAMED} more" if len(self.others_s) > _NAMED else ""
        return f"; as the motion repeats itself, {listed}{more} fit as well"


def estimate_time_offset(
    t_estimate: NDArray[np.int64], estimate: Trajectory, t_ground_truth: NDArray[np.int64], ground_truth: Trajectory
) -> TimeOffset | None:
    """Correlate the speeds of both trajectories within ±2 s and within ±60 s, hold what fits against the motions, and refine.

    Speeds (of rotation and of translation) do not depend on the frames of the trajectories, and the normalised correlation not
    on their scale. Motion that repeats itself (laps, steps) correlates at every period: of all offsets that correlate those are
    dropped whose motions or places are clearly farther apart than another's, and of the rest, which nothing tells apart, the
    smallest is taken. From there a regression on the velocities, stretch by stretch, finds offset and deviation. Both signals
    count, each as well as it knows the offset. Where slow motion leaves nothing to correlate, but the places are alike, the
    regression is begun everywhere within ±2 s.

    Args:
        t_estimate, t_ground_truth: (N,) int64 stamps to use [ns], in the place of the trajectories' own.
        estimate, ground_truth: the trajectories.

    Returns:
        None where the trajectories overlap for less than 5 s, or their motions do not tell an offset: none gives a correlation of
        0.8 (beyond 2 s 0.9) inside the range, that is a quarter of the overlap at most, and places neither.
    """
    begin, end = max(t_estimate[0], t_ground_truth[0]), min(t_estimate[-1], t_ground_truth[-1])
    if float(end - begin) * 1e-9 < _LEAST_OVERLAP_S or min(len(estimate), len(ground_truth)) < 20:
        return None
    pair = MotionPair(t_estimate, estimate, t_ground_truth, ground_truth)
    coarse = _correlated(t_estimate, estimate, t_ground_truth, ground_truth)
    if coarse:
        told = [_told(pair, one) for one in _not_refuted(pair, coarse)]
    else:
        largest_s = min(_NEAR[0], 0.25e-9 * float(end - begin))
        starts = np.arange(-largest_s, largest_s + 0.5 * _APART_S, _APART_S)
        fits = [fit for start in starts if (fit := _refined(pair, float(start))) is not None]
        alike = [fit for fit in fits if pair.are_alike(fit.offset_s, _ALIKE)]
        found = [TimeOffset(fit.offset_s, fit.correlation, fit.signal, fit.deviation_s) for fit in alike]
        told = _not_refuted(pair, _distinct(found))
    told = [one for one in told if math.isfinite(one.deviation_s)]
    if not told:
        return None
    nearest, *others = _distinct(sorted(told, key=lambda one: abs(one.offset_s)))
    rates = [rate for signal in pair.signals if (rate := pair.fit_rate(signal, nearest.offset_s, _NEAR[0])) is not None]
    rate = min(rates, key=lambda one: one.deviation, default=None)
    return replace(nearest, others_s=tuple(one.offset_s for one in others), rate=rate)


def _refined(pair: MotionPair, start_s: float) -> ClockFit | None:
    """The offset near another one, by both signals."""
    return ClockFit.together([fit for signal in pair.signals if (fit := pair.fit(signal, start_s, _AROUND_S)) is not None])


def _told(pair: MotionPair, coarse: TimeOffset) -> TimeOffset:
    """What correlated, refined; as it is where no signal does that."""
    fit = _refined(pair, coarse.offset_s)
    return coarse if fit is None else TimeOffset(fit.offset_s, coarse.correlation, fit.signal, fit.deviation_s)


def _distinct(found: list[TimeOffset]) -> list[TimeOffset]:
    """Of those that are one offset the first."""
    distinct: list[TimeOffset] = []
    for one in found:
        if all(abs(one.offset_s - other.offset_s) > _SAME_S for other in distinct):
            distinct.append(one)
    return distinct


def _not_refuted(pair: MotionPair, found: list[TimeOffset]) -> list[TimeOffset]:
    """Those of the offsets that no other one explains the motions or the places clearly better than."""
    if len(found) < 2:
        return found
    left = np.arange(len(found))
    for parts in pair.misfits([one.offset_s for one in found]):
        if parts.shape[1] >= LEAST_STRETCHES:
            left = left[as_good(parts[left])]
    return [found[k] for k in left]


def _correlated(
    t_estimate: NDArray[np.int64], estimate: Trajectory, t_ground_truth: NDArray[np.int64], ground_truth: Trajectory
) -> list[TimeOffset]:
    """The offsets at which the speeds correlate about as well as they do anywhere, if they do; by either signal."""
    begin, end = max(t_estimate[0], t_ground_truth[0]), min(t_estimate[-1], t_ground_truth[-1])
    step = max(
        float(np.median(np.diff(t_ground_truth))), 0.2 * float(np.median(np.diff(t_estimate))), float(end - begin) / _MOST_SAMPLES
    )
    grid = np.arange(0.0, float(end - begin), step)
    # Both speeds over the same window: that of the estimate's own rate, or 0.1 s.
    window = max(float(np.median(np.diff(t_estimate))), 1e8, 2.0 * step)
    signals: tuple[tuple[Literal["rotation", "translation"], _Speed], ...] = (
        ("rotation", _rotation_speed),
        ("translation", _translation_speed),
    )
    found: list[TimeOffset] = []
    for signal, speed in signals:
        a, b = (speed(t - begin, one, grid, window) for t, one in ((t_estimate, estimate), (t_ground_truth, ground_truth)))
        for largest_s, least in (_NEAR, _FAR):
            lags = min(int(largest_s * 1e9 / step), len(grid) // 4)
            if lags < 2:
                continue
            for lag, correlation in _lags(a, b, lags, least):
                deviation = _deviation_s(a, b, lag, lags, step * 1e-9)
                found.append(TimeOffset(lag * step * 1e-9, correlation, signal, deviation))
    best = max((one.correlation for one in found), default=0.0)
    able = [one for one in found if _unexplained(one.correlation) < _AS_GOOD * _unexplained(best) + _LEAST_UNEXPLAINED]
    return _chosen(_distinct(sorted(able, key=lambda one: -one.correlation)))


def _chosen(found: list[TimeOffset]) -> list[TimeOffset]:
    """Of offsets in order of their correlation all near ones, the nearest of the others and the best of these.

    Where steps repeat themselves for minutes, noise decides which of a hundred peaks is the highest; the smallest is what counts.
    """
    near = [one for one in found if abs(one.offset_s) <= _NEAR[0]]
    far = [one for one in found if abs(one.offset_s) > _NEAR[0]]
    by_size = sorted(far[_BEST:], key=lambda one: abs(one.offset_s))
    return [*near, *far[:_BEST], *by_size[:_NEAREST]]


def _unexplained(correlation: float) -> float:
    """Share of the variance that a correlation leaves."""
    return 1.0 - min(correlation, 1.0) ** 2


def _deviation_s(a: Floats, b: Floats, lag: float, lags: int, step_s: float) -> float:
    """How far the offset scatters at which speeds `a` (n,) fit `b` best, near a lag, when each fifth is left out in turn [s]."""
    n = len(a)
    t = np.arange(lags, n - lags)  # those that correlated
    x, y = a[t], np.interp(t + lag, np.arange(n), b)
    x, y = x - x.mean(), y - y.mean()
    x *= float(x @ y) / max(float(x @ x), 1e-300)
    if len(t) < _PARTS:
        return math.inf
    u, v = np.gradient(x, step_s), np.gradient(y, step_s)
    edges = np.linspace(0, len(t), _PARTS, endpoint=False).astype(np.intp)
    return _FEW * jackknife(np.add.reduceat(0.5 * (u + v) * (x - y), edges), np.add.reduceat(u * v, edges))


def _translation_speed(
    t: NDArray[np.int64], trajectory: Trajectory, grid: NDArray[np.float64], window: float
) -> NDArray[np.float64]:
    early, late = (
        np.stack([np.interp(grid + side * window / 2, t, trajectory.p[:, axis]) for axis in range(3)], axis=1) for side in (-1, 1)
    )
    return np.asarray(np.linalg.norm(late - early, axis=1))


def _rotation_speed(
    t: NDArray[np.int64], trajectory: Trajectory, grid: NDArray[np.float64], window: float
) -> NDArray[np.float64]:
    """Angle turned within the window, from the nearest measured poses, per time between them."""
    rows = [_nearest_row(t, grid + side * window / 2) for side in (-1, 1)]
    R = trajectory.R
    angle = np.linalg.norm(so3.log(R[rows[0]].transpose(0, 2, 1) @ R[rows[1]]), axis=1)
    return np.asarray(angle / np.maximum(t[rows[1]] - t[rows[0]], 1.0))


def _nearest_row(t: NDArray[np.int64], at: NDArray[np.float64]) -> NDArray[np.intp]:
    after = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
    return after - (at - t[after - 1] < t[after] - at)


def _correlate(b: Floats, core: Floats) -> Floats:
    """(n − m + 1,) Σ_j b[k + j] core[j] of b (n,) and core (m,); NumPy's, as SciPy's takes a second to be there."""
    n = len(b)
    return np.asarray(np.fft.irfft(np.fft.rfft(b) * np.conj(np.fft.rfft(core, n)), n)[: n - len(core) + 1])


def _lags(a: Floats, b: Floats, lags: int, least: float) -> list[tuple[float, float]]:
    """The lags (in samples, refined by a parabola) by which `a` has to be moved later to fit `b`, where the correlation has a
    maximum of at least `least`, and the correlations there; none at the end of the range."""
    n = len(a)
    core = a[lags : n - lags] - a[lags : n - lags].mean()
    m = len(core)
    # Correlation of the middle of `a` with every window of `b`, each window centred and normalised by itself.
    sums = np.concatenate([[0.0], np.cumsum(b)])
    squares = np.concatenate([[0.0], np.cumsum(b * b)])
    mean = (sums[m:] - sums[:-m]) / m
    spread = np.sqrt(np.maximum((squares[m:] - squares[:-m]) / m - mean**2, 0.0))
    scale = float(np.sqrt(np.mean(core**2)))
    if scale < 1e-12 or spread.max() < 1e-12:
        return []
    with np.errstate(divide="ignore", invalid="ignore"):
        values = _correlate(b, core) / (m * scale * spread)
    values = np.where(np.isfinite(values), values, 0.0)
    middle = values[1:-1]
    peaks = 1 + np.flatnonzero((middle >= least) & (middle >= values[:-2]) & (middle > values[2:]))
    left, at, right = values[peaks - 1], values[peaks], values[peaks + 1]
    bend = left - 2.0 * at + right
    finer = np.where(bend < 0.0, 0.5 * (left - right) / np.where(bend < 0.0, bend, 1.0), 0.0)
    return [(float(lag), float(value)) for lag, value in zip(peaks - lags + finer, at, strict=True)]
