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
    """A gated stretch that multipath does not explain, which ends as suddenly as it began."""
    errors, n = found.errors[:, :2], len(attached)
    for a, b in runs_of(~found.is_used):
        if b - a < _EDGE or a < _EDGE or b > n - _EDGE:
            continue
        inside = errors[a : a + _EDGE].mean(axis=0), errors[b - _EDGE : b].mean(axis=0)
        outside = errors[a - _EDGE : a].mean(axis=0), errors[b : b + _EDGE].mean(axis=0)
        begin, end = (float(np.linalg.norm(i - o)) for i, o in zip(inside, outside, strict=True))
        if min(begin, end) < _FADES * max(begin, end):
            at = a if begin > end else b
            return float((attached.time_ns[at] - attached.time_ns[0]) * 1e-9), max(begin, end)
    return None


def doubts_of(
    attached: AttachedFixes,
    found: Fit,
    has_lever: bool,
    stretches: list[tuple[float, float, float]],
    config: GeoreferenceConfig,
) -> list[str]:
    """Sentences about what to doubt."""
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
            f"correct the stamps, or set gnss.time_offset_s={config.time_offset_s - found.delay:.2f}"
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
    if jump is not None:
        warnings.append(
            f"fixes jump by {jump[1]:.1f} m against the odometry at {jump[0]:.0f} s and are used on both sides: another datum "
            "or base station from there on, or multipath too small to be told; the map lies between the two"
        )
    if found.noise_scale > _NOISY:
        warnings.append(f"fixes scatter {found.noise_scale:.1f} times as much as they claim; they are believed that much less")
    if found.tension > _BENT:
        warnings.append(
            f"fixes bend the odometry {math.sqrt(found.tension):.1f} times as much as its covariance allows: it drifts more than "
            "claimed, or the fixes have another scale or datum"
        )
    return warnings
