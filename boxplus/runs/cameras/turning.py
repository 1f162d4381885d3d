"""Where in a recording a camera turns enough to be compared with the gyroscope."""

from __future__ import annotations

import numpy as np

from boxplus.sensors.inertial.imu import ImuSamples

_BIN_NS = 100_000_000  # over which rates are averaged: vibration is no turning
_LIVELY, _LEAST = 0.25, 0.05  # rad/s, root mean square: enough to look no further, and too little to be compared
_COVERED = 0.5  # of a stretch, by samples


class Turning:
    """How an IMU turns, tenth of a second by tenth of a second.

    Args:
        stretch_s: length of what is to be looked at [s].
    """

    def __init__(self, stretch_s: float) -> None:
        self._bins = max(round(stretch_s * 1e9) // _BIN_NS, 1)
        self._sums: dict[int, np.ndarray] = {}  # of each bin the sum of the rates, and how many

    def add(self, samples: ImuSamples) -> None:
        """The next samples."""
        finite = np.isfinite(samples.gyro).all(axis=1)
        if not finite.any():
            return
        bins = samples.time_ns[finite] // _BIN_NS
        numbers, first = np.unique(bins, return_index=True)
        rows = np.column_stack([samples.gyro[finite], np.ones(len(bins))])
        for number, total in zip(numbers.tolist(), np.add.reduceat(rows, first), strict=True):
            self._sums[number] = self._sums.get(number, 0.0) + total

    def until_ns(self) -> int | None:
        """The end of the first stretch that turns a lot, else of the one that turns most [ns]; None where nothing does.

        A constant rate is a bias, and what vibrates does not turn.
        """
        if not self._sums:
            return None
        numbers = np.array(sorted(self._sums))
        sums = np.array([self._sums[number] for number in numbers.tolist()])
        rates = sums[:, :3] / sums[:, 3:]
        first, square = (np.concatenate([np.zeros((1, 3)), np.cumsum(x, axis=0)]) for x in (rates, rates**2))
        ends = np.arange(1, len(numbers) + 1)
        begins = np.searchsorted(numbers, numbers - self._bins + 1)
        count = (ends - begins)[:, None]
        variance = (square[ends] - square[begins]) / count - ((first[ends] - first[begins]) / count) ** 2
        rms = np.sqrt(np.maximum(variance.sum(axis=1), 0.0))
        rms[count[:, 0] < _COVERED * min(self._bins, len(numbers))] = 0.0
        whole = numbers - numbers[0] + 1 >= self._bins
        whole[-1] = True  # all of a recording that is shorter
        if (rms[whole] > _LEAST).any():  # else the time before a gap may have turned
            rms[~whole] = 0.0
        lively = np.flatnonzero(rms > _LIVELY)
        chosen = int(lively[0]) if len(lively) else int(np.argmax(rms))
        return (int(numbers[chosen]) + 1) * _BIN_NS if rms[chosen] > _LEAST else None
