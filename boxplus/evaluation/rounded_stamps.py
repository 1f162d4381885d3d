"""Were stamps rounded? Each pose is then compared with another moment's, and errs along its way by up to half a step of them.

That is what tells them from stamps that a clock gives at whole seconds, as GNSS does: errors that each a shift in time explains,
as wide as rounding makes such shifts, are those of stamps; errors of an estimate lie in all directions.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from boxplus.evaluation.statistics import rms
from boxplus.formats.trajectory import Trajectory

_UNITS_NS = (1_000_000_000, 100_000_000, 10_000_000)
_OF_ROUNDING, _EVEN = 0.3, 0.8  # of the whole error, that rounded stamps explain; share of equal steps that are no rounding's
_LEAST = 30  # poses
_ALONG, _NARROW, _WIDE = 0.8, 0.15, 0.45  # share of the error that shifts in time explain; their deviation, of the unit
_SLOW = 0.2  # of the usual speed, below which an error says nothing of time


def rounding_doubts(
    aligned: Trajectory, truth: Trajectory, files: tuple[Trajectory, Trajectory], moved: tuple[Trajectory, Trajectory]
) -> Iterator[str]:
    """A sentence on the stamps of the estimate, or of the ground truth.

    Args:
        aligned, truth: (M) matched poses in the frame of the ground truth.
        files: estimate and ground truth as they were read. moved: all their poses in one frame and on one clock.
    """
    if truth.time_ns is None or len(truth) < _LEAST:
        return
    error = aligned.p - truth.p
    whole = rms(np.linalg.norm(error, axis=1))
    for one, name in enumerate(("estimate", "ground truth")):
        own, other = files[one].time_ns, files[1 - one].time_ns
        unit = None if own is None else next((unit for unit in _UNITS_NS if not (own % unit).any()), None)
        if unit is None or own is None or other is None or not (other % unit).any():  # of one clock, where both are such
            continue
        v = _velocities(moved[1 - one], truth.time_ns)
        speed = np.linalg.norm(v, axis=1)
        makes = rms(speed) * unit * 1e-9 / np.sqrt(12.0)
        if not makes > _OF_ROUNDING * whole:
            continue
        told = f"all stamps of the {name} are multiples of {unit * 1e-9:g} s"
        apart = f"by up to {0.5e-9 * unit:g} s × {float(np.median(speed)):.3g} m/s"
        share, scatter = _shifts(error, v, speed)
        if share > _ALONG and _NARROW < scatter / (unit * 1e-9) < _WIDE:
            yield (
                f"{told}, and {share:.0%} of the squared error lies along the way as rounding to that puts it, {apart}: poses "
                "are compared with those of other moments, and the numbers are those of the stamps; write these with more digits"
            )
        else:
            steps = np.unique(np.diff(own), return_counts=True)[1]
            if one == 0 and steps.max() <= _EVEN * steps.sum():  # even steps are those of a clock
                yield (
                    f"{told}: if they were rounded to that, it makes an error of about {makes:.3g} m, {apart}, and clocks up to "
                    f"{0.5e-9 * unit:g} s apart"
                )


def _velocities(poses: Trajectory, time_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """(M, 3) of the poses nearest to these times [m/s]."""
    t = (poses.times - poses.times[0]) * 1e-9
    v = np.gradient(poses.p, t, axis=0)
    return np.column_stack([np.interp((time_ns - poses.times[0]) * 1e-9, t, axis) for axis in v.T])


def _shifts(error: NDArray[np.float64], v: NDArray[np.float64], speed: NDArray[np.float64]) -> tuple[float, float]:
    """Share of the squared error that a shift in time of every pose explains, and the deviation of these shifts [s]."""
    able = speed > _SLOW * float(np.median(speed))
    if np.count_nonzero(able) < _LEAST:
        return 0.0, 0.0
    shift = (error[able] * v[able]).sum(axis=1) / speed[able] ** 2
    left = error[able] - shift[:, None] * v[able]
    return float(1.0 - (left**2).sum() / max((error[able] ** 2).sum(), 1e-300)), float(shift.std())
