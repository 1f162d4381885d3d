"""A gyroscope or accelerometer that has failed and repeats itself, while the platform moves.

To the filter such a sensor is the best there is, and a platform that seems not to turn drags its map along. Values that are
the same sample after sample are nothing by themselves: at rest a coarse sensor rounds its noise away. They are where the other
sensor moves, or where the last ones before were far from them, as nothing stops within a sample. That is said of an IMU with
noise in the other sensor only: without any it is simulated, and a straight way is a straight way.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.imu import ImuSamples

_STUCK_S, _FEWEST = 0.5, 20  # over which, and how many samples, all three axes repeat themselves
_KEPT_S = 0.7
_BEFORE, _PARTS = 4, 5  # samples before; parts over whose means vibration is gone
_SENSORS = (("gyroscope", slice(0, 3)), ("accelerometer", slice(3, 6)))
_MOVING = {"gyroscope": 0.1, "accelerometer": 0.2}  # rad/s, m/s²: by which means over a tenth of a second differ at no rest
_STEP = {"gyroscope": 0.1, "accelerometer": 1.0}
_NOISE = {"gyroscope": 2e-4, "accelerometer": 2e-3}  # second differences that no smooth motion has; real IMUs ten times


class StuckSensor:
    """Follows the samples of one run."""

    def __init__(self) -> None:
        self._time_ns, self._values = np.zeros(0, dtype=np.int64), np.zeros((0, 6))

    def update(self, imu: ImuSamples) -> str | None:
        """Take the samples of one scan in; a sentence where one of the sensors is stuck."""
        new = imu.time_ns > (self._time_ns[-1] if len(self._time_ns) else np.iinfo(np.int64).min)  # scans share some
        if not new.any():
            return None
        time_ns = np.concatenate([self._time_ns, imu.time_ns[new]])
        kept = time_ns >= time_ns[-1] - round(_KEPT_S * 1e9)
        self._time_ns = time_ns[kept]
        self._values = np.concatenate([self._values, np.hstack([imu.gyro, imu.accel])[new]])[kept]
        for (name, axes), (other, other_axes) in (_SENSORS, _SENSORS[::-1]):
            differs = np.flatnonzero((self._values[:, axes] != self._values[-1, axes]).any(axis=1))
            begin = int(differs[-1]) + 1 if len(differs) else 0
            seconds = float(self._time_ns[-1] - self._time_ns[begin]) * 1e-9
            if seconds < _STUCK_S or len(self._values) - begin < _FEWEST:
                continue
            others = self._values[begin:, other_axes]
            if np.abs(np.diff(others, 2, axis=0)).mean() < _NOISE[other]:
                continue
            before, stuck = self._values[max(begin - _BEFORE, 0) : begin, axes], self._values[-1, axes]
            stepped = len(before) > 0 and float(np.linalg.norm(before.mean(axis=0) - stuck)) > _STEP[name]
            if stepped or _varies(others) > _MOVING[other]:
                return (
                    f"for {seconds:.1f} s the {name} has given the same values sample after sample although the platform moves: "
                    "it has failed, or its driver repeats what it had last"
                )
        return None


def _varies(values: NDArray[np.float64]) -> float:
    """The largest standard deviation of an axis (N, 3), of means over parts of the time."""
    means = np.array([part.mean(axis=0) for part in np.array_split(values, _PARTS)])
    return float(means.std(axis=0).max())
