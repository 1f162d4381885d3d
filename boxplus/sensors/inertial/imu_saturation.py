"""IMU samples that sit at the limit of the sensor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.sensors.inertial.imu import ImuSamples

_WAYS = 12  # along the six axes, and against them
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
        self._peak, self._step = np.zeros(_WAYS), np.full(2, np.inf)  # of gyroscope and accelerometer
        self._plateaus, self._run = np.zeros(_WAYS, np.int64), np.zeros(_WAYS, np.int64)
        self._cut_off, self._limit = np.zeros(_WAYS, np.bool_), np.zeros(_WAYS, np.bool_)  # reached within the present block
        self._low, self._blocks = np.full((_MEMORY, 6), np.inf), 0
        self._last, self._last_ns = np.full(6, np.nan), np.iinfo(np.int64).min

    def update(self, imu: ImuSamples) -> list[Limit]:
        """Take a block of samples in, those of one scan or image; returns the limits that they reach."""
        if not len(imu) or imu.time_ns[-1] <= self._last_ns:
            return []
        first = int(np.searchsorted(imu.time_ns, self._last_ns, side="right"))  # blocks share the samples at their border
        self._last_ns = int(imu.time_ns[-1])
        low = self._low[self._blocks % _MEMORY]
        self._blocks += 1
        state = self._peak, self._step, self._plateaus, self._run, self._cut_off, self._limit
        if not _follow(imu.gyro, imu.accel, first, self._last, low, *state):
            return []
        clipped = self._limit & (self._peak - np.tile(self._low.min(axis=0), 2) > np.tile(_LEAST_SPREAD, 2))
        return [Limit(way, float(self._peak[way])) for way in np.flatnonzero(clipped).tolist()]


@kernel(inline=True)
def _along(gyro: NDArray[np.float64], accel: NDArray[np.float64], sample: int, axis: int) -> float:
    return float(gyro[sample, axis] if axis < 3 else accel[sample, axis - 3])


@kernel
def _follow(
    gyro: NDArray[np.float64],
    accel: NDArray[np.float64],
    first: int,
    last: NDArray[np.float64],
    low: NDArray[np.float64],
    peak: NDArray[np.float64],
    step: NDArray[np.float64],
    plateaus: NDArray[np.int64],
    run: NDArray[np.int64],
    cut_off: NDArray[np.bool_],
    limit: NDArray[np.bool_],
) -> bool:
    """Take the samples from `first` on in; False where no axis is at its peak, and no limit is reached.

    Args:
        last: (6,) the sample before, NaN where there is none; low: (6,) receives the least size of each axis.
        peak, plateaus, run, cut_off, limit: (12,) along the axes of gyroscope and accelerometer, and against them; step: (2,).
    """
    highest, changed = np.full(_WAYS, -np.inf), last.copy()
    low[:] = np.inf
    for sample in range(first, len(gyro)):
        for axis in range(6):
            value = _along(gyro, accel, sample, axis)
            low[axis] = min(low[axis], abs(value))
            highest[axis], highest[axis + 6] = max(highest[axis], value), max(highest[axis + 6], -value)
    at_a_peak = False
    for axis in range(6):
        largest = max(max(highest[axis], highest[axis + 6]), max(peak[axis], peak[axis + 6]))
        for sample in range(first, len(gyro)):
            value = _along(gyro, accel, sample, axis)
            change = abs(value - changed[axis])
            changed[axis] = value
            if change > _SAME * largest:
                step[axis // 3] = min(step[axis // 3], change)
        for way in (axis, axis + 6):
            at_a_peak |= highest[way] >= peak[way] * (1.0 - _SAME)
    if not at_a_peak:
        run[:] = 0
        last[:] = changed
        return False
    limit[:] = False
    for sample in range(first, len(gyro)):
        for axis in range(6):
            value = _along(gyro, accel, sample, axis)
            is_cut = abs(value - last[axis]) > _MOST_STEPS * step[axis // 3]
            last[axis] = value
            for way in (axis, axis + 6):
                size = value if way < 6 else -value
                if size > peak[way] * (1.0 + _SAME):
                    plateaus[way], run[way], limit[way], cut_off[way] = 0, 0, False, False
                at_peak = size >= peak[way] * (1.0 - _SAME)
                peak[way] = max(peak[way], size)
                if at_peak and run[way] == 0:
                    cut_off[way] |= is_cut  # what cut one change off is a limit, however it is reached later
                run[way] = run[way] + 1 if at_peak else 0
                plateaus[way] += cut_off[way] and run[way] == _PLATEAU
                long_or_again = plateaus[way] >= _ENOUGH or run[way] >= _LONG
                limit[way] |= cut_off[way] and long_or_again and run[way] >= _PLATEAU
    return True


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
