"""What speaks against a georeference that was found: fixes that fit nothing, clocks, lever arm, an odometry that is bent."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from boxplus.systems.georeference.attachment import AttachedFixes
from boxplus.systems.georeference.config import GeoreferenceConfig
from boxplus.systems.georeference.fit import Fit

_MANY_GATED = 0.15
_LONG = 0.1  # of all fixes, a stretch of gated ones that is more than multipath
_WINDOW = 5  # fixes on either side of a jump
_EDGE = 3  # fixes at either end of a stretch
_FADES = 0.5  # of the step at one end of a gated stretch, that at the other where it only fades
_HARDLY = 5.0  # standard deviations of the result, the steps at both ends of a stretch that fades in and out
_OF_BURSTS = 0.6  # of the step at its sudden end, the largest one within a stretch; multipath bursts that meet have larger ones
_STANDS_OUT = 4.0  # times the usual difference between them
_LASTING = 30.0  # [s]
_SIGMAS = 3.0
_LEAST_DELAY = 0.03
_NOISY = 1.5
_BENT = 4.0  # mean square of the odometry's errors, where 1 is what its covariance allows


def runs_of(gated: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Stretches [begin, end) of successive gated fixes."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], gated, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def gated_stretches(attached: AttachedFixes, found: Fit) -> list[tuple[float, float, float]]:
    """(begin since the first fix [s], duration [s], median distance [m]) of stretches of fixes that are not used."""
    seconds = (attached.time_ns - attached.time_ns[0]) * 1e-9
    distance = np.linalg.norm(found.errors, axis=1)
    return [
        (float(seconds[a]), float(seconds[b - 1] - seconds[a]), float(np.median(distance[a:b])))
        for a, b in runs_of(~found.is_used)
    ]


def of_gated(attached: AttachedFixes, found: Fit) -> Counter[str]:
    """Gated fixes by what they look like."""
    counts: Counter[str] = Counter()
    for a, b in runs_of(~found.is_used):
        counts["off for a stretch (multipath)" if b - a > 2 else "off alone"] += b - a
    return counts


def jump_of(attached: AttachedFixes, found: Fit) -> tuple[float, float] | None:
    """(since the first fix [s], metres on the ground) of the largest step in the errors of fixes that are used, if it stands out.

    Means over a few fixes before and after every instant, over which the odometry does not drift; their usual difference is what
    noise makes of it. Or the beginning (the end) of a stretch of gated fixes whose other end is none: the map was bent to them.
    """
    fading = _fading_of(attached, found)
    if fading is not None:
        return fading
    used = np.flatnonzero(found.is_used)
    if len(used) < 4 * _WINDOW:
        return None
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(found.errors[used, :2], axis=0)])
    means = (sums[_WINDOW:] - sums[:-_WINDOW]) / _WINDOW
    steps = np.linalg.norm(means[_WINDOW:] - means[:-_WINDOW], axis=1)
    seconds = (attached.time_ns[used] - attached.time_ns[0]) * 1e-9
    ends = np.arange(len(steps)) + _WINDOW
    lasts = seconds[ends + _WINDOW - 1] - seconds[ends - _WINDOW]
    is_near = lasts <= max(2.0 * float(np.median(lasts)), _LASTING)  # in a longer gap the odometry drifts
    if not is_near.any():
        return None
    largest = int(np.argmax(np.where(is_near, steps, 0.0)))
    noise = float(np.median(attached.sigma)) * math.sqrt(2.0 / _WINDOW)
    if steps[largest] < max(_STANDS_OUT * float(np.median(steps[is_near])), _SIGMAS * noise):
        return None
    return float(seconds[ends[largest]]), float(steps[largest])


def _fading_of(attached: AttachedFixes, found: Fit) -> tuple[float, float] | None:
    """A gated stretch that multipath does not explain, which ends as suddenly as it began and jumps nowhere in between.

    The map turns from one datum to the other on the way, and is off on both sides of the jump: such a stretch fades in and out.
    """
    errors, n, sigma = found.errors[:, :2], len(attached), float(np.median(found.sigma))
    for a, b in runs_of(~found.is_used):
        if b - a < _EDGE or a < _EDGE or b > n - _EDGE:
            continue
        inside = errors[a : a + _EDGE].mean(axis=0), errors[b - _EDGE : b].mean(axis=0)
        outside = errors[a - _EDGE : a].mean(axis=0), errors[b : b + _EDGE].mean(axis=0)
        begin, end = (float(np.linalg.norm(i - o)) for i, o in zip(inside, outside, strict=True))
        middle, step = _largest_step(errors, a, b)
        if max(begin, end) < min(_FADES * step, _HARDLY * sigma):
            return float((attached.time_ns[middle] - attached.time_ns[0]) * 1e-9), step
        if min(begin, end) < _FADES * max(begin, end) and step < _OF_BURSTS * max(begin, end):
            at = a if begin > end else b
            return float((attached.time_ns[at] - attached.time_ns[0]) * 1e-9), max(begin, end)
    return None


def _largest_step(errors: NDArray[np.float64], a: int, b: int) -> tuple[int, float]:
    """Where within fixes [a, b) a few lie farthest from the few before them, and how far [m]; nowhere in a short stretch."""
    if b - a < 2 * _EDGE:
        return a, 0.0
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(errors[a:b], axis=0)])
    means = (sums[_EDGE:] - sums[:-_EDGE]) / _EDGE
    steps = np.linalg.norm(means[_EDGE:] - means[:-_EDGE], axis=1)
    return a + _EDGE + int(np.argmax(steps)), float(steps.max())


def contradiction_of(attached: AttachedFixes, found: Fit) -> str | None:
    """Why the result is not to be trusted: it lies between two datums, farther from either than its covariance says."""
    jump = jump_of(attached, found)
    return None if jump is None or not _is_beyond(jump, found) else _of_jump(jump)


def _is_beyond(jump: tuple[float, float], found: Fit) -> bool:
    return jump[1] > _SIGMAS * float(np.median(found.sigma))


def _of_jump(jump: tuple[float, float]) -> str:
    return (
        f"fixes jump by {jump[1]:.1f} m against the odometry at {jump[0]:.0f} s: another datum or base station from there on, or "
        "multipath too small to be told; the map lies between the two"
    )


def doubts_of(
    attached: AttachedFixes,
    found: Fit,
    has_lever: bool,
    stretches: list[tuple[float, float, float]],
    config: GeoreferenceConfig,
) -> list[str]:
    """Sentences about what to doubt, beside what contradicts itself."""
    warnings = []
    if not has_lever:
        lever = ", ".join(f"{x:.2f}" for x in found.lever)
        warnings.append(
            f"the lever arm of the antenna is not known: estimated as {lever} m in the IMU frame, to "
            f"{float(np.max(found.lever_sigma[:2])):.2f} m on the ground; give --gnss-lever-arm"
        )
    if abs(found.delay) > max(_SIGMAS * found.delay_sigma, _LEAST_DELAY):
        late = "late" if found.delay > 0 else "early"
        warnings.append(
            f"fixes seem to be stamped {abs(found.delay):.2f} s {late} (± {found.delay_sigma:.2f} s), which was allowed for; "
            f"correct the stamps, or set gnss.time_offset_s={config.time_offset_s - found.delay:.2f}{_or_lever(attached, found)}"
        )
    share = 1.0 - float(found.is_used.mean())
    if share > _MANY_GATED:
        warnings.append(f"{100 * share:.0f} % of the fixes contradict the others and are not used")
    total = (attached.time_ns[-1] - attached.time_ns[0]) * 1e-9
    for begin, duration, metres in stretches:
        if duration > max(_LONG * total, _LASTING):
            warnings.append(
                f"fixes lie {metres:.1f} m off for {duration:.0f} s from {begin:.0f} s on, longer than multipath lasts: "
                "another datum or base station, or the odometry is wrong there"
            )
    jump = jump_of(attached, found)
    if jump is not None and not _is_beyond(jump, found):
        warnings.append(_of_jump(jump))
    if found.noise_scale > _NOISY:
        warnings.append(
            f"fixes scatter {found.noise_scale:.1f} times as much as they claim, or the odometry does between two local maps; "
            "they are believed that much less"
        )
    if found.tension > _BENT:
        warnings.append(
            f"fixes bend the odometry {math.sqrt(found.tension):.1f} times as much as its covariance allows: it drifts more than "
            "claimed, or the fixes have another scale or datum"
        )
    return warnings


def _or_lever(attached: AttachedFixes, found: Fit) -> str:
    """At a steady speed a delay and an antenna farther back are one."""
    speed = float(np.median(np.linalg.norm(attached.v_map, axis=1)))
    where = "back" if found.delay > 0 else "ahead"
    return f"; an antenna {abs(found.delay) * speed:.1f} m farther {where} than the lever arm says would look the same"
