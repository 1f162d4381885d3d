"""IMU samples that sit at the limit of the sensor."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.imu import ImuSamples


class Saturation:
    """Finds IMU samples that sit at the limit of the sensor: the largest value of an axis, again and again, amid motion."""

    _MEMORY = 20  # scans
    _LEAST_SPREAD = np.array([0.5, 0.5, 0.5, 1.5, 1.5, 1.5])  # rad/s, m/s²: at rest quantised values repeat as well
    _NAMES = ("gyroscope x", "gyroscope y", "gyroscope z", "accelerometer x", "accelerometer y", "accelerometer z")

    def __init__(self) -> None:
        self._peak = np.zeros(6)
        self._low: deque[NDArray[np.float64]] = deque(maxlen=self._MEMORY)

    def update(self, imu: ImuSamples) -> list[str]:
        """Take the samples of one scan in; returns the axes that are saturated, one sentence each."""
        values = np.abs(np.hstack([imu.gyro, imu.accel]))
        self._low.append(values.min(axis=0))
        highest = values.max(axis=0)
        np.maximum(self._peak, highest, out=self._peak)
        if not (highest >= self._peak).any():
            return []
        at_peak = values >= self._peak * (1.0 - 1e-6)
        runs = at_peak[2:] & at_peak[1:-1] & at_peak[:-2]
        clipped = runs.any(axis=0) & (self._peak - np.min(self._low, axis=0) > self._LEAST_SPREAD)
        return [
            f"{self._NAMES[axis]} saturated at {self._peak[axis]:.2f} {'rad/s' if axis < 3 else 'm/s²'}: motion beyond it is not "
            "measured, covariance widened"
            for axis in np.flatnonzero(clipped)
        ]
