"""Fixes that repeat the position before them while the antenna goes on.

A receiver that holds its last position in a tunnel and a driver that sends a position again with a new stamp say the same: where
the antenna was some time ago. Noise never repeats itself to the last digit, so that two equal positions are one measurement,
unless they are rounded so coarsely that the antenna stays within a cell meanwhile. An antenna that stands repeats its position
as well, and goes on from there: where the next position is no farther on, it is the path that slid.
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
_WENT_ON = 0.5  # of the path's way since: a position that comes after a hold is as far on, where the antenna moved
_FEWEST_DIGITS, _MOST_DIGITS = 1, 9
_ROUNDED, _SAME_DEG = 0.95, 1e-12  # share of the positions, as many as are not odd ones; and what is the same angle


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
            f"the receiver repeated one position for {self.duration:.0f} s, from {self.begin:.0f} s after its first fix on, "
            f"while the path went {self.metres:.0f} m away: these fixes are left out; a tunnel, a receiver or driver that "
            "hangs, or a path that moves while the antenna stands"
        )


def held(lat_lon_alt: Floats, p: Floats) -> NDArray[np.bool_]:
    """(N,) fixes at the position of the one before them, to the last digit, though the antenna has moved since the first of them.

    Args:
        lat_lon_alt: (N, 3) in order of time [°, °, m]; heights may change meanwhile, as those of a barometer do.
        p: (N, 3) where an odometry has the body at these times [m], in any frame.
    """
    if not len(p):
        return np.zeros(0, dtype=np.bool_)
    first = _first_of(lat_lon_alt)
    way = np.linalg.norm(p - p[first], axis=1)
    repeats = way > _LEAST_M + _CELLS * _cell_m(lat_lon_alt)
    begins = np.flatnonzero(first == np.arange(len(first)))
    following = np.append(begins[1:], -1)[np.searchsorted(begins, first)]  # the next other position; of the last one none
    went_on = np.linalg.norm(_metres(lat_lon_alt[following] - lat_lon_alt[first], lat_lon_alt), axis=1)
    stood = (following >= 0) & (went_on < _WENT_ON * np.linalg.norm(p[following] - p[first], axis=1))
    return np.asarray(repeats & ~stood)


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
    """Diagonal of the cells that positions are rounded to [m]."""
    # Both axes are written alike; along one that the antenna does not move, as on a street due north, anything fits.
    step = min(_step(lat_lon_alt[:, 0]), _step(lat_lon_alt[:, 1]))
    return float(np.linalg.norm(_metres(np.full((1, 2), step), lat_lon_alt)))


def _step(degrees: Floats) -> float:
    """What angles (N,) are rounded to [°]: decimals of degrees or of minutes, or numbers of four bytes; 0 where to none."""
    for digits in range(_FEWEST_DIGITS, _MOST_DIGITS + 1):
        for parts in (10.0**digits, 60.0 * 10.0 ** (digits - 2)):
            if np.mean(np.abs(degrees - np.round(degrees * parts) / parts) < _SAME_DEG) >= _ROUNDED:
                return 1.0 / parts
    short = degrees.astype(np.float32)
    return float(np.spacing(np.abs(short).max())) if np.mean(short == degrees) >= _ROUNDED else 0.0


def _metres(degrees: Floats, lat_lon_alt: Floats) -> Floats:
    """Differences (N, 2 or more) of latitude and longitude [°] as north and east (N, 2) [m], near these positions."""
    cosine = np.cos(np.radians(np.median(lat_lon_alt[:, 0])))
    return np.asarray(np.radians(degrees[:, :2]) * np.array([1.0, cosine]) * SEMI_MAJOR_M)
