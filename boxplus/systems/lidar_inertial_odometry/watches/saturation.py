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
    a change that is cut off.
    """

    def __init__(self) -> None:
        self._peak, self._step = np.zeros(6), np.full(6, np.inf)
        self._plateaus, self._run, self._cut_off = np.zeros(6, np.int64), np.zeros(6, np.int64), np.zeros(6, np.bool_)
        self._low: deque[NDArray[np.float64]] = deque(maxlen=_MEMORY)
        self._limit = np.zeros(6, np.bool_)  # reached within the present scan
        self._last: NDArray[np.float64] | None = None
        self._last_ns = np.iinfo(np.int64).min

    def update(self, imu: ImuSamples) -> list[str]:
        """Take the samples of one scan in; returns the axes that are saturated, one sentence each."""
        new = imu.time_ns > self._last_ns  # scans share the samples at their border
        if not new.any():
            return []
        values = np.abs(np.hstack([imu.gyro, imu.accel]))[new]
        self._low.append(values.min(axis=0))
        changes = np.abs(np.diff(np.vstack([values[0] if self._last is None else self._last, values]), axis=0))
        self._last, self._last_ns = values[-1], int(imu.time_ns[-1])
        highest = values.max(axis=0)
        differs = changes > _SAME * np.maximum(highest, self._peak)
        self._step = np.minimum(self._step, np.where(differs, changes, np.inf).min(axis=0))
        if (highest < self._peak * (1.0 - _SAME)).all():  # no axis is at its peak
            self._run[:] = 0
            return []
        self._limit[:] = False
        for value, change in zip(values, changes, strict=True):
            self._follow(value, change)
        clipped = self._limit & (self._peak - np.min(self._low, axis=0) > _LEAST_SPREAD)
        return [
            f"{_NAMES[axis]} saturated at {self._peak[axis]:.2f} {'rad/s' if axis < 3 else 'm/s²'}: motion beyond it is not "
            "measured, covariance widened"
            for axis in np.flatnonzero(clipped)
        ]

    def _follow(self, value: NDArray[np.float64], change: NDArray[np.float64]) -> None:
        """Take one sample in (6,), that differs by `change` (6,) from the one before."""
        higher = value > self._peak * (1.0 + _SAME)
        self._plateaus[higher], self._run[higher], self._limit[higher] = 0, 0, False
        at_peak = value >= self._peak * (1.0 - _SAME)
        np.maximum(self._peak, value, out=self._peak)
        begins = at_peak & (self._run == 0)
        self._cut_off[begins] = change[begins] > _MOST_STEPS * self._step[begins]
        self._run = np.where(at_peak, self._run + 1, 0)
        self._plateaus += self._cut_off & (self._run == _PLATEAU)
        long_or_again = (self._plateaus >= _ENOUGH) | (self._run >= _LONG)
        self._limit |= self._cut_off & long_or_again & (self._run >= _PLATEAU)
