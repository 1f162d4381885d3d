"""What to doubt about clocks: an offset or a rate that the motions show, and what becomes of the errors with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from boxplus.evaluation.association import Association
from boxplus.evaluation.clock_rate import ClockRate
from boxplus.evaluation.time_offset import TimeOffset
from boxplus.formats.trajectory import Trajectory

ErrorWith = Callable[[Trajectory, float], float | None]
"""The ATE of a trajectory to whose stamps an offset is added [m]; None where it cannot be compared."""

# Between clocks, and of the longer interval between poses; less is worth a word only where it makes the errors far smaller.
_NOTICED_OFFSET_S, _OF_INTERVAL = 0.02, 0.2
_FAR_BETTER = 0.8  # times the error of now, from which on an offset is told whatever motions say; as much worse refutes it
_BETTER = 0.99  # times the error of now, what an offset has to reach to be advised
_WITHIN = 2.0  # standard deviations of an offset, within which another one is advised instead
_CLEARLY = 0.97  # times the error with it, that the other one has to reach; with drift some always fits a little better


def clock_doubts(
    association: Association, estimate: Trajectory, ground_truth: Trajectory, rmse: float, error_with: ErrorWith
) -> list[str]:
    """A sentence on a rate of the clocks or on an offset, or none.

    Args:
        estimate, ground_truth: as they were read.
        rmse: the ATE as they were compared [m].
        error_with: the ATE otherwise.
    """
    noticed, offset_s = association.time_offset, association.offset_s
    if noticed is None:
        return []
    with_offset: float | None = None
    by_rate = None
    if noticed.rate is not None and noticed.rate.shows:
        on_time = replace(estimate, time_ns=noticed.rate.corrected(estimate.times + round(offset_s * 1e9)), lines=None)
        with_offset = error_with(estimate, offset_s + noticed.offset_s)
        by_rate = _rate_doubt(noticed.rate, rmse, with_offset, error_with(on_time, 0.0))
    if by_rate is not None:
        return [by_rate]
    if not (abs(noticed.offset_s) > _NOTICED_OFFSET_S or noticed.shows):
        return []
    with_offset = error_with(estimate, offset_s + noticed.offset_s)
    gain = 1.0 if with_offset is None else rmse / max(with_offset, 1e-300)
    if gain > 1.0 / _FAR_BETTER or (gain > _FAR_BETTER and _is_told(noticed, estimate, ground_truth)):
        return [_clock_doubt(noticed, offset_s, rmse, with_offset, lambda at_s: error_with(estimate, at_s))]
    return []


def _is_told(found: TimeOffset, estimate: Trajectory, ground_truth: Trajectory) -> bool:
    """Whether an offset is worth a word even if the errors hardly change with it."""
    interval_s = max(float(np.median(np.diff(poses.times))) * 1e-9 for poses in (estimate, ground_truth))
    return found.shows and abs(found.offset_s) > max(_NOTICED_OFFSET_S, _OF_INTERVAL * interval_s)


def _rate_doubt(found: ClockRate, rmse: float, with_offset: float | None, with_rate: float | None) -> str | None:
    """A sentence on a rate with which the errors do get smaller, than they are and than an offset alone makes them."""
    least = rmse if with_offset is None else min(rmse, with_offset)
    far_apart = abs(found.rate) * found.half_s > _NOTICED_OFFSET_S
    if with_rate is None or not with_rate < (_BETTER if far_apart else _FAR_BETTER) * least:
        return None
    beside = "" if with_offset is None else f", and {with_offset:.4g} m with a constant offset"
    return (
        f"the clocks do not run at the same rate: {found}; with stamps t {found.offset_s:+.4f} s {found.rate:+.4g} "
        f"(t − {found.middle_ns * 1e-9:.3f} s) the ATE is {with_rate:.4g} m instead of {rmse:.4g} m{beside}"
    )


def _clock_doubt(
    found: TimeOffset, applied_s: float, rmse: float, rmse_with: float | None, error_with: Callable[[float], float | None]
) -> str:
    """An offset is advised only where the errors do get smaller with it.

    Args:
        applied_s: what was added to the stamps before [s].
    """
    known = f"correlation {found.correlation:.3f}{found.repetition}"
    motions = f"the motions fit best with {found} added to the estimate's stamps ({known})"
    if rmse_with is None:
        return f"{motions}, but the poses cannot be compared with that: no offset is advised"
    if rmse_with >= _BETTER * rmse:
        return f"{motions}, but the ATE is no better with that ({rmse_with:.4g} m, now {rmse:.4g} m): no offset is advised"
    advised_s, least = _least_error(applied_s + found.offset_s, _WITHIN * found.deviation_s, rmse_with, error_with)
    sentence = f"{motions}: with --offset {advised_s:.3f} the ATE is {least:.4g} m instead of {rmse:.4g} m"
    is_other = f"{advised_s:.3f}" != f"{applied_s + found.offset_s:.3f}"
    return f"{sentence}, the least within {_WITHIN:g} standard deviations" if is_other else sentence


def _least_error(
    offset_s: float, reach_s: float, error: float, error_with: Callable[[float], float | None]
) -> tuple[float, float]:
    """The offset up to `reach_s` from another one with which the ATE is the least, or that where it is hardly more, and the ATE.

    The square of it is a parabola.
    """
    tried = {offset_s: error}
    ends = [error_with(offset_s + side * reach_s) for side in (-1.0, 1.0)]
    if ends[0] is not None and ends[1] is not None:
        before, after = ends[0], ends[1]
        tried |= {offset_s - reach_s: before, offset_s + reach_s: after}
        bend = before**2 - 2.0 * error**2 + after**2
        if bend > 0.0:
            lowest_s = offset_s + reach_s * float(np.clip(0.5 * (before**2 - after**2) / bend, -1.0, 1.0))
            least = error_with(lowest_s)
            tried |= {} if least is None else {lowest_s: least}
    best_s = min(tried, key=lambda at_s: tried[at_s])
    return (best_s, tried[best_s]) if tried[best_s] < _CLEARLY * error else (offset_s, error)
