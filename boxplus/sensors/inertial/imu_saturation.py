"""IMU samples that sit at the limit of the sensor."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.inertial.imu import ImuSamples

_MEMORY = 20  # blocks
_BLOCK_NS = 100_000_000  # of samples that are looked at as a whole
_LEAST_SPREAD = np.array([0.5, 0.5, 0.5, 1.5, 1.5, 1.5])  # rad/s, m/s²: at rest quantised values repeat as well
_SAME = 1e-6  # of the largest value
_PLATEAU = 3  # samples in a row
_LONG = 6  # of them: 4 at most at the top of a smooth motion, real and quantised four times as coarsely
_ENOUGH = 2  # plateaus: what is as large as nothing before may round to the same three times, but not there again
_MOST_STEPS = 2.5  # of the sensor, by which the rounded top of a motion is reached
_NAMES = ("gyroscope x", "gyroscope y", "gyroscope z", "accelerometer x", "accelerometer y", "accelerometer z")


class Limit(NamedTuple):
    """Of an axis, either way along it.

    Attributes:
        way: 0 to 5 along the axes of gyroscope and accelerometer, 6 to 11 against them.
        value: that is not exceeded [rad/s, m/s²].
    """

    way: int
    value: float

    @property
    def text(self) -> str:
        """Such as "gyroscope x saturated at 4.36 rad/s"."""
        return f"{_NAMES[self.way % 6]} saturated at {self.value:.2f} {'rad/s' if self.of_gyro else 'm/s²'}"

    @property
    def of_gyro(self) -> bool:
        """Whether it is one of angular velocity."""
        return self.way % 6 < 3

    def reached(self, imu: ImuSamples) -> NDArray[np.bool_]:
        """(N,) which samples sit there, or beyond."""
        along = np.hstack([imu.gyro, imu.accel])[:, self.way % 6]
        return np.asarray((along if self.way < 6 else -along) >= self.value * (1.0 - _SAME))


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
        self._limit = np.zeros(ways, np.bool_)  # reached within the present block
        self._last: NDArray[np.float64] | None = None
        self._last_ns = np.iinfo(np.int64).min

    def update(self, imu: ImuSamples) -> list[Limit]:
        """Take a block of samples in, those of one scan or image; returns the limits that they reach."""
        new = imu.time_ns > self._last_ns  # blocks share the samples at their border
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
        return [Limit(way, float(self._peak[way])) for way in np.flatnonzero(clipped).tolist()]

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


def limits_of(imu: ImuSamples) -> list[Limit]:
    """The limits that samples in order of time reach.

    Example:
        >>> time_ns = 5_000_000 * np.arange(600)
        >>> gyro = np.clip(np.sin(3e-9 * time_ns), -0.6, 0.6)[:, None] * [0.0, 0.0, 1.0]
        >>> limits_of(ImuSamples(time_ns, gyro, np.zeros((600, 3))))[0].text
        'gyroscope z saturated at 0.60 rad/s'
    """
    if not len(imu):
        return []
    saturation = Saturation()
    last: dict[int, Limit] = {}
    block = (imu.time_ns - imu.time_ns[0]) // _BLOCK_NS
    for part in np.split(np.arange(len(imu)), np.flatnonzero(np.diff(block)) + 1):
        last.update({limit.way: limit for limit in saturation.update(imu.where(part))})
    values = np.hstack([imu.gyro, imu.accel, -imu.gyro, -imu.accel])
    return [limit for limit in last.values() if values[:, limit.way].max() <= limit.value * (1.0 + _SAME)]
