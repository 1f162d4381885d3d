"""Where in a recording a camera turns enough to be compared with the gyroscope."""

from __future__ import annotations

import numpy as np

from boxplus.sensors.imu import ImuSamples

_BIN_NS = 1_000_000_000
_LIVELY, _LEAST = 0.25, 0.05  # rad/s, root mean square: enough to look no further, and too little to be compared


class Turning:
    """How far an IMU turns in every second of a recording.

    Args:
        stretch_s: length of what is to be looked at [s].
    """

    def __init__(self, stretch_s: float) -> None:
        self._bins = max(round(stretch_s * 1e9) // _BIN_NS, 1)
        self._sums: dict[int, tuple[float, int]] = {}

    def add(self, samples: ImuSamples) -> None:
        """The next samples."""
        squares = np.sum(np.nan_to_num(samples.gyro, nan=0.0, posinf=0.0, neginf=0.0) ** 2, axis=1)
        for second in np.unique(samples.time_ns // _BIN_NS).tolist():
            chosen = samples.time_ns // _BIN_NS == second
            total, count = self._sums.get(second, (0.0, 0))
            self._sums[second] = total + float(squares[chosen].sum()), count + int(chosen.sum())

    def until_ns(self) -> int | None:
        """The end of the first stretch that turns a lot, else of the one that turns most [ns]; None where nothing does."""
        if not self._sums:
            return None
        seconds = sorted(self._sums)
        best_ns, best = None, _LEAST
        for end in range(min(self._bins, len(seconds)), len(seconds) + 1):
            chosen = [self._sums[second] for second in seconds[max(end - self._bins, 0) : end]]
            rms = float(np.sqrt(sum(total for total, _ in chosen) / max(sum(count for _, count in chosen), 1)))
            if rms > best:
                best_ns, best = (seconds[end - 1] + 1) * _BIN_NS, rms
            if best > _LIVELY:
                break
        return best_ns
