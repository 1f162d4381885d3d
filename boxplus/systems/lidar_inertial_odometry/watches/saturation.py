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
_NAMES = ("gyroscope x", "gyroscope y", "gyroscope z", "accelerometer x", "accelerometer y", "accelerometer z")


class Saturation:
    """Finds IMU samples that sit at the limit of the sensor: the largest value of an axis, again and again, amid motion.

    Three samples alone that are equal and larger than all before may be the top of a motion, rounded: there the value changes
    least. A limit shows itself by a long plateau, or by another one at the same value.
    """

    def __init__(self) -> None:
        self._peak, self._plateaus = np.zeros(6), np.zeros(6, dtype=np.int64)
        self._low: deque[NDArray[np.float64]] = deque(maxlen=_MEMORY)
        self._last, self._last_ns = np.zeros((_LONG - 1, 6)), np.iinfo(np.int64).min

    def update(self, imu: ImuSamples) -> list[str]:
        """Take the samples of one scan in; returns the axes that are saturated, one sentence each."""
        new = imu.time_ns > self._last_ns  # scans share the samples at their border
        if not new.any():
            return []
        values = np.abs(np.hstack([imu.gyro, imu.accel]))[new]
        self._low.append(values.min(axis=0))
        joined = np.vstack([self._last, values])
        self._last, self._last_ns = joined[-(_LONG - 1) :], int(imu.time_ns[-1])
        highest = values.max(axis=0)
        if (highest < self._peak * (1.0 - _SAME)).all():  # no plateau ends among these samples
            return []
        self._plateaus[highest > self._peak * (1.0 + _SAME)] = 0
        np.maximum(self._peak, highest, out=self._peak)
        at_peak = joined >= self._peak * (1.0 - _SAME)
        plateau = _in_a_row(at_peak, _PLATEAU)[-len(values) - 1 :]
        self._plateaus += np.count_nonzero(plateau[1:] & ~plateau[:-1], axis=0)
        limit = (self._plateaus >= _ENOUGH) | _in_a_row(at_peak, _LONG).any(axis=0)
        clipped = plateau[1:].any(axis=0) & limit & (self._peak - np.min(self._low, axis=0) > _LEAST_SPREAD)
        return [
            f"{_NAMES[axis]} saturated at {self._peak[axis]:.2f} {'rad/s' if axis < 3 else 'm/s²'}: motion beyond it is not "
            "measured, covariance widened"
            for axis in np.flatnonzero(clipped)
        ]


def _in_a_row(true: NDArray[np.bool_], count: int) -> NDArray[np.bool_]:
    """(N - count + 1, 6): whether the sample and the `count` - 1 before it are true, from the first with that many before it."""
    windows = np.lib.stride_tricks.sliding_window_view(true, count, axis=0)
    found: NDArray[np.bool_] = np.logical_and.reduce(windows, axis=-1)
    return found
