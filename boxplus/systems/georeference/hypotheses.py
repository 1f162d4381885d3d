"""What else the numbers of a receiver could mean: the mistakes that are made with them, tried against the odometry's path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.satellites.geodesy import EnuFrame
from boxplus.systems.georeference.start import Start, find_start

Floats = NDArray[np.float64]

_BETTER = 0.1  # by which the cost of one reading must be below that of another to be told from it
SWAPPED = "latitude and longitude are swapped"
OFFSETS_S = (*(0.25 * k for k in range(1, 9)), 17.0, 18.0, 19.0)
"""Offsets of clocks that are tried; GPS time is 18 s ahead of UTC since 2017."""
_FINER_S = 0.05  # a clock that is named is named to this
_CLEARER = 0.9  # of the cost, for a finer offset than one of those
_FITS = 0.5  # largest cost of a reading that explains the fixes


def _minutes(lla: Floats) -> Floats:
    """NMEA writes 4807.038 for 48° 7.038'."""
    degrees = np.trunc(lla[:, :2] / 100.0)
    return np.column_stack([degrees + (lla[:, :2] - 100.0 * degrees) / 60.0, lla[:, 2]])


READINGS: dict[str, Callable[[Floats], Floats]] = {
    SWAPPED: lambda lla: lla[:, [1, 0, 2]],
    "the latitude has the wrong sign": lambda lla: lla * [-1.0, 1.0, 1.0],
    "the longitude has the wrong sign": lambda lla: lla * [1.0, -1.0, 1.0],
    "latitude and longitude are radians": lambda lla: np.column_stack([np.degrees(lla[:, :2]), lla[:, 2]]),
    "these are degrees and minutes in one number, as in NMEA": _minutes,
}


@dataclass(frozen=True, slots=True)
class Reading:
    """A mistake that explains the fixes: its name, and how well."""

    name: str
    start: Start


def other_readings(lat_lon_alt: Floats, p_level: Floats, tolerance: Floats, given: Start | None) -> tuple[Reading | None, bool]:
    """The reading that fits clearly better than the numbers as they are, and whether they fit as well when swapped.

    Other mirror images fit every straight path; swapping changes lengths, too, and is worth a word where it does not show.

    Args:
        lat_lon_alt: (N, 3) as given. p_level, tolerance: as in `find_start`. given: what that found for them.
    """
    found = []
    for name, read in READINGS.items():
        lla = read(lat_lon_alt)
        if not ((np.abs(lla[:, 0]) <= 90.0) & (np.abs(lla[:, 1]) <= 180.0)).all():
            continue
        start = find_start(p_level, EnuFrame(*np.median(lla, axis=0).tolist()).to_enu(lla), tolerance)
        if start is not None and start.cost <= _FITS:
            found.append(Reading(name, start))
    found.sort(key=lambda reading: reading.start.cost)
    cost = 1.0 if given is None else given.cost
    better = [reading for reading in found if reading.start.cost < cost - _BETTER]
    swapped = any(reading.name == SWAPPED and reading.start.cost < cost + _BETTER for reading in found)
    return (better[0] if better else None), swapped


@dataclass(frozen=True, slots=True)
class Lag:
    """A time that, added to those of the fixes, makes them follow the odometry [s], and how well."""

    offset_s: float
    start: Start


def other_clock(time_ns: NDArray[np.int64], p_level: Floats, p_enu: Floats, tolerance: Floats, given: Start | None) -> Lag | None:
    """A clock that is up to two seconds off, or by the leap seconds between GPS time and UTC, where that fits clearly better.

    Args:
        time_ns: (N,) of the fixes; the others as in `find_start`.
    """
    seconds = (time_ns - time_ns[0]) * 1e-9

    def best_of(offsets: tuple[float, ...]) -> Lag | None:
        found: Lag | None = None
        for offset in offsets:
            inside = (seconds + offset >= 0.0) & (seconds + offset <= seconds[-1])
            if inside.sum() < 0.5 * len(seconds):
                continue
            moved = np.column_stack([np.interp(seconds[inside] + offset, seconds, p_level[:, k]) for k in range(3)])
            start = find_start(moved, p_enu[inside], tolerance[inside])
            if start is not None and (found is None or start.cost < found.start.cost):
                found = Lag(offset, start)
        return found

    best = best_of((*OFFSETS_S, *(-offset for offset in OFFSETS_S)))
    cost = 1.0 if given is None else given.cost
    if best is None or best.start.cost >= min(cost - _BETTER, _FITS):
        return None
    finer = best_of(tuple(best.offset_s + k * _FINER_S for k in range(-9, 10) if k))
    return finer if finer is not None and finer.start.cost < _CLEARER * best.start.cost else best
