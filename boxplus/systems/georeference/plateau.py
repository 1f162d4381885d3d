"""Fixes that lie off by the same for long: a second datum that the map does not rest on, or the only right one.

Multipath comes and goes within half a minute, or wanders: its errors change with the place. Those of another datum or base
station stay, whatever way is driven. Such a stretch is gated where the other fixes are more, and the map lies well in their
datum; but that they are more is no proof that they are right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from boxplus.systems.georeference.attachment import AttachedFixes
from boxplus.systems.georeference.fit import Fit

_GAP = 2  # fixes that are used, by chance, within a stretch of others
_LASTING = 30.0  # s
_WAY = 20.0  # m: as long as the antenna stands, its multipath stays
_NOISE, _SHARE = 2.0, 0.2  # of a fix, or of the distance, by which the errors of one datum scatter at most: the odometry drifts
_RAYLEIGH = 1.1774  # median length of a normal vector of two


@dataclass(frozen=True, slots=True)
class Plateau:
    """A stretch of fixes off by the same: begin since the first fix and duration [s], and distance on the ground [m]."""

    begin: float
    duration: float
    metres: float


def plateau_of(attached: AttachedFixes, found: Fit) -> Plateau | None:
    """The longest stretch of gated fixes that another datum explains; None where there is none."""
    seconds = (attached.time_ns - attached.time_ns[0]) * 1e-9
    noise = float(np.median(attached.sigma)) * found.noise_scale
    longest: Plateau | None = None
    for begin, end in _joined(found.gated):
        duration = float(seconds[end - 1] - seconds[begin])
        speed = np.linalg.norm(attached.v_map[begin:end], axis=1)
        way = float(speed[1:] @ np.diff(seconds[begin:end]))
        if duration <= max(_LASTING, 0.0 if longest is None else longest.duration) or way < _WAY:
            continue
        errors = found.errors[begin:end, :2]
        middle = np.median(errors, axis=0)
        metres = float(np.linalg.norm(middle))
        scatter = float(np.median(np.linalg.norm(errors - middle, axis=1))) / _RAYLEIGH
        if scatter <= max(_NOISE * noise, _SHARE * metres) and found.is_off(metres):
            longest = Plateau(float(seconds[begin]), duration, metres)
    return longest


def _joined(stretches: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Stretches [begin, end) that a few fixes part, as one."""
    joined = list[tuple[int, int]]()
    for begin, end in stretches:
        if joined and begin - joined[-1][1] <= _GAP:
            joined[-1] = (joined[-1][0], end)
        else:
            joined.append((begin, end))
    return joined
