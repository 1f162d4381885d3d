"""Does the datum of the fixes jump? The map then lies bent between two datums, farther from either than its covariance says.

At the jump the errors of the fixes step, whatever the map makes of it before and after. So do those where multipath begins and
ends. But where it is the datum, and all fixes from there on may be shifted by the same, the step is gone.

Near to the begin or the end of a recording it may be multipath as well that began before, or goes on after it: one side of the
step is wrong all the same, and the map, which rests on both, is bent between the two. How far that is, is asked: few fixes bend
it by less than it claims to be known.

The fit bends the odometry before it lets fixes be off, as a fix counts for little beside those near to it in time: of a jump
that is small beside what the odometry may drift no means of a few fixes step. So the errors are also looked at from near
(`step`), fix by fix, where a level and a slope go along; and a step that is told so, and of which a second datum leaves no more
than half, is one. Of a usual receiver much of the step may stay even then; the look from near also tells bursts from datums.
Fixes known to centimetres may be gated here or there at nearly the same cost, so that how many are says little, and that fit may
end with a datum that is wrong itself: a step that is far beyond noise needs no word of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import SingularProblemError
from boxplus.systems.georeference.attachment import AttachedFixes
from boxplus.systems.georeference.fit import OFF_SIGMAS, Fit
from boxplus.systems.georeference.step import LEAST, Step, step_at, step_gains

Floats = NDArray[np.float64]

_WINDOW = 5  # fixes on either side of a step
_FEWEST = 2 * _WINDOW  # in a datum, to be one
_STANDS_OUT = 3.0  # times the usual difference between windows, which a map that is bent raises
_NOISY = 3.0  # times what noise makes of it
_GONE = 0.4  # of a step, what another datum leaves of it
_LESS, _FEWER = 0.8, 0.75  # or so much of it, where of the fixes that fit nothing no more than such a share is left
_HALF = 0.5  # of a step, or of the fixes that fit nothing, what another datum leaves where it is what they are of
_TRIED = 4  # steps that are seen, those that are no bursts and the largest first
_BESIDE = 2  # fixes, by which a step may be off
_LASTING = 30.0  # s: multipath lasts less, and is no datum
_SIDE_USED = 0.5  # of the fixes on the short side of a step, for the map to be bent by them


@dataclass(frozen=True, slots=True)
class Jump:
    """Where the datum jumps: time since the first fix [s], and distance on the ground [m], by the fit with two datums.

    Attributes:
        lasts: both sides of it last longer than multipath does.
        bend: by how many of its own standard deviations the map is off at least, whichever side is right.
    """

    seconds: float
    metres: float
    lasts: bool
    bend: float

    def contradicts(self, found: Fit) -> bool:
        """Whether the map is off by more than it claims: by the jump, or on a short side by what that bends it at least."""
        return found.is_off(self.metres) and (self.lasts or self.bend > OFF_SIGMAS)


def jump_of(attached: AttachedFixes, found: Fit, refit: Callable[[NDArray[np.bool_]], Fit]) -> Jump | None:
    """The largest step in the errors of the fixes that another datum from there on explains; None where none stands out.

    One between two stretches that last goes before one near to the begin or the end. There the fixes on the short side have to be
    among those that the map rests on: where they are not used, they do not bend it.

    Args:
        refit: the fit with a datum of their own for fixes (N,).
    """
    seconds = (attached.time_ns - attached.time_ns[0]) * 1e-9
    steps = _steps(found.errors)
    if len(steps) <= 2 * (_FEWEST - _WINDOW):
        return None
    at = np.arange(len(steps)) + _WINDOW  # of the first fix after it
    lasts = seconds[at + _WINDOW - 1] - seconds[at - _WINDOW]
    is_near = lasts <= max(2.0 * float(np.median(lasts)), _LASTING)  # in a longer gap the odometry drifts
    lasting = (seconds[at] >= _LASTING) & (seconds[-1] - seconds[at] >= _LASTING)
    enough = (at >= _FEWEST) & (at <= len(attached) - _FEWEST)
    of_odometry = np.convolve(attached.drift**2, np.full(_WINDOW, 1.0 / _WINDOW), "valid")
    noise = np.sqrt(float(np.median(attached.sigma)) ** 2 * 2.0 / _WINDOW + of_odometry[_WINDOW:] + of_odometry[:-_WINDOW])
    least = np.maximum(_STANDS_OUT * float(np.median(steps)), _NOISY * noise)
    sigma = attached.sigma * found.noise_scale
    gains = _gains(seconds, attached, found, sigma)
    left = np.where(is_near & enough & ((steps >= least) | (gains[at] >= LEAST)), gains[at], 0.0)
    candidates = list[tuple[int, Step]]()
    while left.any():
        largest = int(np.argmax(left))
        left[max(largest - _WINDOW, 0) : largest + _WINDOW + 1] = 0.0
        first, step = _sharpest(seconds, attached, found, int(at[largest]), sigma)
        if step.is_seen:
            candidates.append((first, step))
    short: Jump | None = None
    tried = {False: 0, True: 0}  # of steps that last, and of short ones: many of these must not hide one that lasts
    for first, step in sorted(candidates, key=lambda candidate: (candidate[1].is_burst, -candidate[1].gain)):
        is_short, at_end = not lasting[first - _WINDOW], 2 * first > len(attached)
        side = found.is_used[first:] if at_end else found.is_used[:first]
        if tried[is_short] == _TRIED or (is_short and (short is not None or float(side.mean()) < _SIDE_USED)):
            continue
        tried[is_short] += 1
        after = np.arange(len(attached)) >= first
        try:
            split = refit(after)
        except SingularProblemError:  # what two datums leave undetermined is none
            continue
        at_first = first - _WINDOW
        share = float(_steps(split.errors)[at_first] / steps[at_first])
        gated, before = (int(np.count_nonzero(~own.is_used)) for own in (split, found))
        freed = before - gated
        is_explained = freed >= 0 if share < _GONE else share < _LESS and freed >= _WINDOW and gated < _FEWER * before
        # A burst at the step hides what another datum leaves of it.
        is_gone = step.is_told and _sharpest(seconds, attached, split, first, sigma)[1].gain <= _HALF**2 * step.gain
        is_left = is_gone or (gated <= before and (step.is_beside or (share < _LESS and step.is_told)))
        is_based = _rests_on_both(found, seconds, first)
        is_left = is_left and is_based and step.alone <= _reach(found)
        is_sure = not is_short and step.is_sure and is_based
        metres, bend = float(np.linalg.norm(split.datum_step[:2])), _bend(found, split)
        # Fixes on both sides were gated against a map between the two: a burst gives none of the others back, and chance a
        # few.
        gives_back = freed >= _WINDOW and gated <= _HALF * before and bend > OFF_SIGMAS
        if gives_back or (not step.is_burst and (is_explained or is_left or is_sure)):
            # Of the map that lies bent between both the errors step by less: it goes along.
            told = step.alone
            if is_explained or gives_back:
                told = metres
            elif is_left:
                told = max(metres, step.alone)
            jump = Jump(float(seconds[first]), told, not is_short, bend)
            if jump.lasts:
                return jump
            short = jump
    return short


def _beside(values: NDArray[Any], seconds: Floats, at: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Of the values (N,) of fixes those near to the step at a fix, before it and after it."""
    near = np.abs(seconds - seconds[at]) <= _LASTING
    return values[:at][near[:at]], values[at:][near[at:]]


def _rests_on_both(found: Fit, seconds: Floats, at: int) -> bool:
    """Whether the map rests on the fixes on both sides of a step.

    One that rests on the fixes of one side lies in their datum; what is on the other is another question (`plateau`).
    """
    return all(len(side) > 0 and float(side.mean()) >= _SIDE_USED for side in _beside(found.is_used, seconds, at))


def _reach(found: Fit) -> float:
    """How far apart two datums are at most that a map lies between [m]: fixes of either are used, and so within reach of it."""
    return 2.0 * float(np.linalg.norm(found.errors[found.is_used, :2], axis=1).max(initial=0.0))


def _bend(found: Fit, split: Fit) -> float:
    """How far the map lies from where it would in either datum, in its standard deviations, where it is the farthest."""
    bent = found.p_enu_map - split.p_enu_map
    return min(
        float((np.linalg.norm((bent - shift)[:, :2], axis=1) / found.sigma).max()) for shift in (np.zeros(3), split.datum_step)
    )


def _gains(seconds: Floats, attached: AttachedFixes, found: Fit, sigma: Floats) -> Floats:
    """(N,) by how much a step at each fix lowers the cost, of all fixes or without those so far off that no map lies between.

    Beside a jump some fixes are that far off, and bursts elsewhere are; without them, a fix counts as the next one that is left.
    """
    gains = np.zeros(len(seconds))
    for kept in (np.ones(len(seconds), dtype=np.bool_), np.linalg.norm(found.errors[:, :2], axis=1) <= _reach(found)):
        own = step_gains(seconds[kept], found.errors[kept, :2], sigma[kept], attached.walked[kept])
        gains = np.maximum(gains, own[np.minimum(np.cumsum(kept) - kept, len(own) - 1)])
    return gains


def _sharpest(seconds: Floats, attached: AttachedFixes, found: Fit, at: int, sigma: Floats) -> tuple[int, Step]:
    """The step at a fix or one beside it, and at which: means of a few fixes do not tell.

    Bursts of multipath elsewhere, which the map does not rest on, say nothing of it, and a large one would be half of the step.
    But of a burst some fixes are used by chance, and what lies beyond these is a part of it: where all fixes together make a
    burst of it, it is one.
    """
    inside = range(max(at - _BESIDE, 1), min(at + _BESIDE + 1, len(seconds)))
    near = found.is_used.copy()
    for begin, end in found.gated:
        near[begin:end] = begin <= inside[-1] and end >= inside[0]
    of_all, of_near = (_largest(seconds, attached, found.errors, kept, inside, sigma) for kept in (np.ones_like(near), near))
    return of_all if of_all[1].is_burst else of_near


def _largest(
    seconds: Floats, attached: AttachedFixes, errors: Floats, kept: NDArray[np.bool_], inside: range, sigma: Floats
) -> tuple[int, Step]:
    row, t, e = np.cumsum(kept) - 1, seconds[kept], errors[kept, :2]
    stated, walked = sigma[kept], attached.walked[kept]
    found = ((k, step_at(t, e, int(row[k]), stated, walked)) for k in inside if row[k] > 0)
    return max(found, key=lambda step: step[1].gain)


def _steps(errors: Floats) -> Floats:
    """(N − 2 w + 1,) lengths [m] between the means of w successive errors on the ground (N, 3) and of the next w."""
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(errors[:, :2], axis=0)])
    means = (sums[_WINDOW:] - sums[:-_WINDOW]) / _WINDOW
    return np.asarray(np.linalg.norm(means[_WINDOW:] - means[:-_WINDOW], axis=1))
