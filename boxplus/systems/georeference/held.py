"""Fixes that repeat the position before them while the antenna goes on.

A receiver that holds its last position in a tunnel and a driver that sends a position again with a new stamp say the same: where
the antenna was some time ago. Noise never repeats itself to the last digit, so that two equal positions are one measurement,
unless they are rounded so coarsely that the antenna stays within a cell meanwhile.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.satellites.geodesy import SEMI_MAJOR_M

Floats = NDArray[np.float64]

HELD = "repeating the position before while the path goes on"
"""Why such a fix is left out."""
_LEAST_M = 0.2  # of way: an antenna that stands may well have one position, and an odometry that stands drifts
_LASTING_S = 5.0
_CELLS = 2.0  # of what positions are rounded to, diagonally; noise may keep a position in its cell a little longer


@dataclass(frozen=True, slots=True)
class Hold:
    """A stretch in which one position was repeated: its begin since the first fix [s], how long it lasts [s], the way [m]."""

    begin: float
    duration: float
    metres: float

    @property
    def lasts(self) -> bool:
        """So long that a stretch of the way has no position; a driver that sends every position several times leaves none."""
        return self.duration > _LASTING_S

    @property
    def text(self) -> str:
        """A sentence."""
        return (
            f"the receiver repeated one position for {self.duration:.0f} s from {self.begin:.0f} s on, while the path went "
            f"{self.metres:.0f} m away: these fixes are left out; a tunnel, a receiver or driver that hangs, or a path that "
            "moves while the antenna stands"
        )


def held(lat_lon_alt: Floats, p: Floats) -> NDArray[np.bool_]:
    """(N,) fixes at the position of the one before them, to the last digit, though the antenna has moved since the first of them.

    Args:
        lat_lon_alt: (N, 3) in order of time [°, °, m]; heights may change meanwhile, as those of a barometer do.
        p: (N, 3) where an odometry has the body at these times [m], in any frame.
    """
    if not len(p):
        return np.zeros(0, dtype=np.bool_)
    way = np.linalg.norm(p - p[_first_of(lat_lon_alt)], axis=1)
    return np.asarray(way > _LEAST_M + _CELLS * _cell_m(lat_lon_alt))


def longest_hold(time_ns: NDArray[np.int64], lat_lon_alt: Floats, p: Floats, is_held: NDArray[np.bool_]) -> Hold | None:
    """The longest stretch of fixes that are `held`, all as there; None where there are none."""
    if not is_held.any():
        return None
    first = _first_of(lat_lon_alt)
    seconds = (time_ns - time_ns[0]) * 1e-9
    lasted = np.where(is_held, seconds - seconds[first], 0.0)
    last = int(np.argmax(lasted))
    return Hold(float(seconds[first[last]]), float(lasted[last]), float(np.linalg.norm(p[last] - p[first[last]])))


def _first_of(lat_lon_alt: Floats) -> NDArray[np.intp]:
    """(N,) row of the first of the fixes in a row that are at the position of this one."""
    changes = np.concatenate([[True], (np.diff(lat_lon_alt[:, :2], axis=0) != 0.0).any(axis=1)])
    return np.maximum.accumulate(np.where(changes, np.arange(len(changes)), 0))


def _cell_m(lat_lon_alt: Floats) -> float:
    """Diagonal of the cells that positions are rounded to, by the smallest steps between them [m]."""
    cosine = np.array([1.0, float(np.cos(np.radians(np.median(lat_lon_alt[:, 0]))))])
    steps = [np.diff(np.unique(lat_lon_alt[:, axis])) for axis in range(2)]
    smallest = np.array([step.min() if len(step) else 0.0 for step in steps])
    return float(np.linalg.norm(np.radians(smallest) * cosine) * SEMI_MAJOR_M)
