"""The offset between two clocks, from the motion that both trajectories saw."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.evaluation.clock_fit import MotionPair
from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import so3

_LEAST_OVERLAP_S = 5.0
_NEAR, _FAR = (2.0, 0.8), (60.0, 0.9)  # largest offset [s] and the correlation it takes; far ones have more to choose from
_MOST_SAMPLES = 60_000
_AROUND_S = 0.5  # of what correlation or a scan found, within which the offset is refined
_ALIKE = 0.95  # correlation of the places as a whole, from which on an offset is looked for that speeds do not tell
_SURE = 3.0  # of its standard deviations, that an offset has to be to show


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """The offset that makes two motions fit best.

    Attributes:
        offset_s: to be added to the stamps of the estimate [s].
        correlation: normalised correlation of the two motions at that offset, at most 1.
        signal: `rotation` or `translation`: which motion tells it.
        deviation_s: standard deviation of the offset, as it scatters over the stretches of the path [s].
    """

    offset_s: float
    correlation: float
    signal: str
    deviation_s: float

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


def estimate_time_offset(
    t_estimate: NDArray[np.int64], estimate: Trajectory, t_ground_truth: NDArray[np.int64], ground_truth: Trajectory
) -> TimeOffset | None:
    """Correlate the speeds of both trajectories within ±2 s, and where nothing fits there, within ±60 s; then refine.

    Speeds (of rotation and of translation) do not depend on the frames of the trajectories, and the normalised correlation
    not on their scale. Where slow motion leaves nothing to correlate, but the places are alike, the offset within ±2 s is taken
    whose places fit best. From there a regression on the velocities, stretch by stretch, finds offset and deviation. The signal
    that knows the offset better counts.

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
    coarse = _correlated(t_estimate, estimate, t_ground_truth, ground_truth)
    pair = MotionPair(t_estimate, estimate, t_ground_truth, ground_truth)
    if coarse is not None:
        start = coarse.offset_s
    else:
        start = pair.scan("translation", min(_NEAR[0], 0.25e-9 * float(end - begin)))
        if not pair.are_alike(start, _ALIKE):
            return None
    fits = [fit for signal in pair.signals if (fit := pair.fit(signal, start, _AROUND_S)) is not None]
    if not fits:
        return coarse
    best = min(fits, key=lambda fit: fit.deviation_s)
    correlation = best.correlation if coarse is None else coarse.correlation
    return TimeOffset(best.offset_s, correlation, best.signal, best.deviation_s)


def _correlated(
    t_estimate: NDArray[np.int64], estimate: Trajectory, t_ground_truth: NDArray[np.int64], ground_truth: Trajectory
) -> TimeOffset | None:
    """The offset at which the speeds correlate best, where they do, with the deviation that white noise would leave it."""
    begin, end = max(t_estimate[0], t_ground_truth[0]), min(t_estimate[-1], t_ground_truth[-1])
    step = max(
        float(np.median(np.diff(t_ground_truth))), 0.2 * float(np.median(np.diff(t_estimate))), float(end - begin) / _MOST_SAMPLES
    )
    grid = np.arange(0.0, float(end - begin), step)
    # Both speeds over the same window: that of the estimate's own rate, or 0.1 s.
    window = max(float(np.median(np.diff(t_estimate))), 1e8, 2.0 * step)
    speeds = [
        (
            signal,
            difference(t_estimate - begin, estimate, grid, window),
            difference(t_ground_truth - begin, ground_truth, grid, window),
        )
        for signal, difference in (("rotation", _rotation_speed), ("translation", _translation_speed))
    ]
    for largest_s, least in (_NEAR, _FAR):
        lags = min(int(largest_s * 1e9 / step), len(grid) // 4)
        if lags < 2:
            return None
        tried = [(signal, *_best_lag(a, b, lags)) for signal, a, b in speeds]
        found = [
            TimeOffset(
                lag * step * 1e-9, correlation, signal, _deviation_s(b, step * 1e-9, correlation, float(end - begin) / window)
            )
            for (signal, lag, correlation), (_, _, b) in zip(tried, speeds, strict=True)
            if correlation >= least and abs(lag) < lags
        ]
        if found:
            return min(found, key=lambda offset: offset.deviation_s)
    return None


def _deviation_s(truth: NDArray[np.float64], step_s: float, correlation: float, count: float) -> float:
    """How well speeds `truth` (n,) tell an offset, where what does not correlate is noise with `count` independent values.

    An offset τ changes them by τ b′, so its variance is that of the noise over count · mean b′².
    """
    slope = float(np.mean((np.diff(truth) / step_s) ** 2))
    noise = (1.0 / min(correlation, 1.0) ** 2 - 1.0) * float(truth.var())
    return math.sqrt(noise / (count * slope)) if slope > 0.0 else math.inf


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


def _best_lag(a: NDArray[np.float64], b: NDArray[np.float64], lags: int) -> tuple[float, float]:
    """The lag (in samples, refined by a parabola) by which `a` must be moved later to fit `b` best, and the correlation there."""
    from scipy.signal import correlate

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
        return 0.0, 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        values = correlate(b, core, mode="valid") / (m * scale * spread)
    values = np.where(np.isfinite(values), values, 0.0)
    best = int(np.argmax(values))
    lag = float(best - lags)
    if 0 < best < len(values) - 1:
        left, middle, right = values[best - 1 : best + 2]
        bend = left - 2 * middle + right
        lag += 0.5 * (left - right) / bend if bend < 0 else 0.0
    return lag, float(values[best])
