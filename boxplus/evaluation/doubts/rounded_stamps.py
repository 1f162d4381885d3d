"""Were stamps rounded? Each pose is then compared with another moment's, and errs along its way by up to half a step of them.

That is what tells them from stamps that a clock gives at whole seconds, as GNSS does: errors that each a shift in time explains,
as wide as rounding makes such shifts, are those of stamps; errors of an estimate lie in all directions. On a straight road they
do not; but they change slowly there, while rounding shifts every pose by itself, or, of poses at even times, from step to step
by the same and back where one step is longer or shorter than the others. Stamps in steps that are all alike are a clock's.
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
_MOST, _BOUNDED = 0.65, 0.97  # of the unit, that rounding and noise shift a pose by; share of the poses of which that holds
_ALONE, _SAWTOOTH = 0.4, 0.7  # correlation of shifts with those before, and with those of even times, that rounding makes
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
        steps = np.unique(np.diff(own), return_counts=True)[1]
        share = _of_rounding(error, v, own, (aligned, truth)[one].times, unit) if len(steps) > 1 else None
        if share is not None:
            yield (
                f"{told}, and {share:.0%} of the squared error lies along the way as rounding to that puts it, {apart}: poses "
                "are compared with those of other moments, and the numbers are those of the stamps; write these with more digits"
            )
        elif one == 0 and steps.max() <= _EVEN * steps.sum():  # even steps are those of a clock
            yield (
                f"{told}: if they were rounded to that, it makes an error of about {makes:.3g} m, {apart}, and clocks up to "
                f"{0.5e-9 * unit:g} s apart"
            )


def _velocities(poses: Trajectory, time_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """(M, 3) of the poses nearest to these times [m/s]."""
    t = (poses.times - poses.times[0]) * 1e-9
    v = np.gradient(poses.p, t, axis=0)
    return np.column_stack([np.interp((time_ns - poses.times[0]) * 1e-9, t, axis) for axis in v.T])


def _of_rounding(
    error: NDArray[np.float64], v: NDArray[np.float64], own: NDArray[np.int64], time_ns: NDArray[np.int64], unit: int
) -> float | None:
    """Share of squared errors (M, 3) at times (M,) along the way; None unless stamps `own` rounded to `unit` make such ones."""
    speed = np.linalg.norm(v, axis=1)
    able = speed > _SLOW * float(np.median(speed))
    if np.count_nonzero(able) < _LEAST:
        return None
    shift = (error[able] * v[able]).sum(axis=1) / speed[able] ** 2
    left = error[able] - shift[:, None] * v[able]
    share = float(1.0 - (left**2).sum() / max((error[able] ** 2).sum(), 1e-300))
    if not share > _ALONG:
        return None
    shift = (shift - np.median(shift)) / (unit * 1e-9)
    if not (_NARROW < shift.std() < _WIDE and np.mean(np.abs(shift) < _MOST) > _BOUNDED):
        return None
    if abs(float(np.corrcoef(shift[1:], shift[:-1])[0, 1])) < _ALONE:
        return share
    row = np.searchsorted(own, time_ns[able]).clip(0, len(own) - 1)
    even = own[0] + (own[-1] - own[0]) / (len(own) - 1) * row
    made = own[row] - even
    return share if made.std() > 0.0 and abs(float(np.corrcoef(made, shift)[0, 1])) > _SAWTOOTH else None
