"""IMU samples that sit at the limit of the sensor."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.imu import ImuSamples

_MEMORY = 20  # scans
_LEAST_SPREAD = np.array([0.5, 0.5, 0.5, 1.5, 1.5, 1.5])  # rad/s, m/s²: at rest quantised values repeat as well
_SAME = 1e-6  # of the largest value
_PLATEAU = 3  # samples in a row
_LONG = 6  # of them: 4 at most at the top of a smooth motion, real and quantised four times as coarsely
_ENOUGH = 2  # plateaus: what is as large as nothing before may round to the same three times, but not there again
_MOST_STEPS = 2.5  # of the sensor, by which the rounded top of a motion is reached
_NAMES = ("gyroscope x", "gyroscope y", "gyroscope z", "accelerometer x", "accelerometer y", "accelerometer z")


class Saturation:
    """Finds IMU samples that sit at the limit of the sensor: the largest value of an axis, again and again, amid motion.

    Three samples alone that are equal and larger than all before may be the top of a motion, rounded: there the value changes
    least. A limit shows itself by a long plateau, or by another one at the same value. But the values of a steady turn, of a
    sensor whose steps are coarser than its noise, make long plateaus as well: they are reached by a step or two, and a limit by
    a change that is cut off. The step is the least change of any axis: one that swings widely alone may change by many at a time.

    Either way along an axis has a limit of its own: that of a number of 16 bits is a step farther below zero than above, and a
    bias that a driver takes off moves both.
    """

    def __init__(self) -> None:
        ways = 12  # along the six axes, and against them
        self._peak, self._step = np.zeros(ways), np.full(2, np.inf)  # of gyroscope and accelerometer
        self._plateaus, self._run, self._cut_off = np.zeros(ways, np.int64), np.zeros(ways, np.int64), np.zeros(ways, np.bool_)
        self._low: deque[NDArray[np.float64]] = deque(maxlen=_MEMORY)
        self._limit = np.zeros(ways, np.bool_)  # reached within the present scan
        self._last: NDArray[np.float64] | None = None
        self._last_ns = np.iinfo(np.int64).min

    def update(self, imu: ImuSamples) -> list[str]:
        """Take the samples of one scan in; returns the axes that are saturated, one sentence each."""
        new = imu.time_ns > self._last_ns  # scans share the samples at their border
        if not new.any():
            return []
        along = np.hstack([imu.gyro, imu.accel])[new]
        self._low.append(np.abs(along).min(axis=0))
        changes = np.abs(np.diff(np.vstack([along[0] if self._last is None else self._last, along]), axis=0))
        self._last, self._last_ns = along[-1], int(imu.time_ns[-1])
        values = np.hstack([along, -along])
        highest = values.max(axis=0)
        largest = np.maximum(highest, self._peak).reshape(2, 6).max(axis=0)
        least = np.where(changes > _SAME * largest, changes, np.inf).min(axis=0)
        self._step = np.minimum(self._step, least.reshape(2, 3).min(axis=1))
        if (highest < self._peak * (1.0 - _SAME)).all():  # no axis is at its peak
            self._run[:] = 0
            return []
        self._limit[:] = False
        cuts = np.tile(changes > _MOST_STEPS * np.repeat(self._step, 3), 2)
        for value, is_cut in zip(values, cuts, strict=True):
            self._follow(value, is_cut)
        clipped = self._limit & (self._peak - np.tile(np.min(self._low, axis=0), 2) > np.tile(_LEAST_SPREAD, 2))
        told = (
            f"{_NAMES[way % 6]} saturated at {self._peak[way]:.2f} {'rad/s' if way % 6 < 3 else 'm/s²'}: motion beyond it is not "
            "measured, covariance widened"
            for way in np.flatnonzero(clipped).tolist()
        )
        return list(dict.fromkeys(told))

    def _follow(self, value: NDArray[np.float64], is_cut: NDArray[np.bool_]) -> None:
        """Take one sample in (12,): its axes, and against them; `is_cut` where it changed by more than a step or two."""
        higher = value > self._peak * (1.0 + _SAME)
        self._plateaus[higher], self._run[higher], self._limit[higher], self._cut_off[higher] = 0, 0, False, False
        at_peak = value >= self._peak * (1.0 - _SAME)
        np.maximum(self._peak, value, out=self._peak)
        begins = at_peak & (self._run == 0)
        self._cut_off[begins] |= is_cut[begins]  # what cut one change off is a limit, however it is reached later
        self._run = np.where(at_peak, self._run + 1, 0)
        self._plateaus += self._cut_off & (self._run == _PLATEAU)
        long_or_again = (self._plateaus >= _ENOUGH) | (self._run >= _LONG)
        self._limit |= self._cut_off & long_or_again & (self._run >= _PLATEAU)
