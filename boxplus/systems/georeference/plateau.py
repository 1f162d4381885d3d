"""Fixes that lie off by the same for long: a second datum that the map does not rest on, or the only right one.

Multipath comes and goes within half a minute, or wanders: its errors change with the place, also where a wall keeps them on one
side. Those of another datum or base station stay, whatever way is driven; about a line, as the odometry drifts meanwhile, they
scatter by the noise of a fix. While the antenna stands, multipath stays as well, and says nothing. Such a stretch is gated where
the other fixes are more, and the map lies well in their datum; but that they are more is no proof that they are right, unless
they are nearly all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.systems.georeference.attachment import AttachedFixes
from boxplus.systems.georeference.fit import Fit

Floats = NDArray[np.float64]

_GAP = 2  # fixes that are used, by chance, within a stretch of others
_LASTING = 30.0  # s
_WAY = 20.0  # m
_STANDS = 0.1  # m/s over two seconds: an odometry that stands says less
_NOISE, _SHARE = 2.0, 0.2  # of a fix, or of the distance, by which the errors of one datum scatter at most
_NOISE_ALONG, _DRIFT = 1.25, 0.002  # of a fix, or of the way, by which they do so about a line
_RAYLEIGH = 1.1774  # median length of a normal vector of two
_FEW = 0.1  # of a recording


@dataclass(frozen=True, slots=True)
class Plateau:
    """A stretch of fixes off by the same: begin since the first fix and duration [s], and distance on the ground [m].

    Attributes:
        is_short: it is so small a part of the recording that the other fixes are to be believed.
    """

    begin: float
    duration: float
    metres: float
    is_short: bool


def plateau_of(attached: AttachedFixes, found: Fit) -> Plateau | None:
    """The longest stretch of gated fixes that another datum explains; None where there is none."""
    seconds = (attached.time_ns - attached.time_ns[0]) * 1e-9
    speed = _speeds(seconds, np.asarray(se3.compose(found.T_map[attached.map_of], attached.T_map_imu)[:, 4:]))
    noise = float(np.median(attached.sigma)) * found.noise_scale
    longest: Plateau | None = None
    for begin, end in _joined(found.gated):
        duration = float(seconds[end - 1] - seconds[begin])
        if longest is not None and duration <= longest.duration:
            continue
        goes = begin + 1 + np.flatnonzero(speed[begin + 1 : end] > _STANDS)
        took = seconds[goes] - seconds[goes - 1]
        way = float(speed[goes] @ took)
        if float(took.sum()) <= _LASTING or way < _WAY:
            continue
        errors = found.errors[goes, :2]
        middle = np.median(errors, axis=0)
        metres = float(np.linalg.norm(middle))
        line = np.column_stack([np.ones(len(goes)), seconds[goes] - seconds[begin]])
        along = line @ np.linalg.lstsq(line, errors)[0]
        is_one = _scatter(errors - middle) <= max(_NOISE * noise, _SHARE * metres)
        is_one = is_one and _scatter(errors - along) <= max(_NOISE_ALONG * noise, _DRIFT * way)
        if is_one and found.is_off(metres):
            longest = Plateau(float(seconds[begin]), duration, metres, duration < _FEW * float(seconds[-1]))
    return longest


def _speeds(seconds: Floats, p: Floats) -> Floats:
    """(N,) speeds [m/s] of positions (N, 3) [m], from a second before to a second after, or to the next where these are rare."""
    at = np.arange(len(seconds))
    a = np.minimum(np.searchsorted(seconds, seconds - 1.0), np.maximum(at - 1, 0))
    b = np.maximum(np.searchsorted(seconds, seconds + 1.0, side="right") - 1, np.minimum(at + 1, len(at) - 1))
    return np.asarray(np.linalg.norm(p[b] - p[a], axis=1) / np.maximum(seconds[b] - seconds[a], 1e-9))


def _scatter(errors: Floats) -> float:
    """Standard deviation of an axis of (N, 2) [m]; fixes that are there by chance do not count."""
    return float(np.median(np.linalg.norm(errors, axis=1))) / _RAYLEIGH


def _joined(stretches: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Stretches [begin, end) that a few fixes part, as one."""
    joined = list[tuple[int, int]]()
    for begin, end in stretches:
        if joined and begin - joined[-1][1] <= _GAP:
            joined[-1] = (joined[-1][0], end)
        else:
            joined.append((begin, end))
    return joined
