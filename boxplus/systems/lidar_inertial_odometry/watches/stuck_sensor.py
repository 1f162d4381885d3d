"""A gyroscope or accelerometer that has failed and repeats itself, while the platform moves.

To the filter such a sensor is the best there is, and a platform that seems not to turn drags its map along. Values that are
the same sample after sample are nothing by themselves: at rest, or straight on, a coarse sensor rounds its noise away. They
are where a gyroscope stopped within a sample, as nothing that turns does, or where the scans turn and it does not, and where
an accelerometer does not feel a platform that turns to and fro. That is said of an IMU with noise in the other sensor only:
without any it is simulated.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.inertial.imu import ImuSamples

_STUCK_S, _FEWEST = 0.5, 10  # over which, and how many samples, all three axes repeat themselves
_BEFORE = 4  # samples before, of a turn that lasted
_MOST_RAD_S2 = 100.0  # by which a turn may stop: 1 rad/s within a hundredth of a second
_WHILE_S, _TURNED_RAD = 2.0, np.deg2rad(4.0)  # which the scans turn, at 0.035 rad/s and more: no gyroscope's steps are so coarse
_PARTS, _TO_AND_FRO_RAD_S = 5, 0.1  # parts of the time, with mean rates beyond this either way
_GYRO, _ACCEL = slice(0, 3), slice(3, 6)
_GYRO_NOISE, _ACCEL_NOISE = 2e-4, 2e-3  # rad/s, m/s²: second differences that no smooth motion has; real IMUs ten times


class StuckSensor:
    """Follows the samples of one run."""

    def __init__(self) -> None:
        self._time_ns, self._values = np.zeros(0, dtype=np.int64), np.zeros((0, 6))
        self._turns: deque[tuple[int, NDArray[np.float64]]] = deque()  # since the gyroscope repeats itself, by the scans
        self._bias = np.zeros(3)  # of the gyroscope, when it began to: one that is stuck drags its bias along

    def update(self, imu: ImuSamples, turned: NDArray[np.float64], bias: NDArray[np.float64]) -> str | None:
        """Take one scan in; a sentence where one of the sensors is stuck.

        Args:
            imu: its samples.
            turned: (3,) rotation of the IMU over it, as the scan shows it [rad].
            bias: (3,) of the gyroscope, as it was known before the scan [rad/s].
        """
        newest = int(self._time_ns[-1]) if len(self._time_ns) else np.iinfo(np.int64).min
        known = int(np.searchsorted(imu.time_ns, newest, side="right"))  # scans share some
        new = len(imu) - known
        if not new:
            return None
        time_ns = np.concatenate([self._time_ns, imu.time_ns[known:]])
        values = np.concatenate([self._values, np.concatenate([imu.gyro[known:], imu.accel[known:]], axis=1)])
        # As long as what begins within this scan takes to show, and what was before it.
        enough_ns = round(_STUCK_S * 1e9) + time_ns[-1] - imu.time_ns[0]
        first = min(int(np.searchsorted(time_ns, time_ns[-1] - enough_ns)), len(time_ns) - _FEWEST - new) - _BEFORE
        self._time_ns, self._values = time_ns[max(first, 0) :], values[max(first, 0) :]
        begin = self._stuck_since(_GYRO, _ACCEL, _ACCEL_NOISE)
        if begin is None:
            self._turns.clear()
        elif self._stopped(begin):
            return self._sentence("gyroscope", "and went there from a turn within one of them")
        elif self._turns_alone(imu, turned, bias):
            return self._sentence("gyroscope", "although the scans turn")
        return self._sentence("accelerometer", "although the platform turns to and fro") if self._feels_nothing() else None

    def _stopped(self, begin: int) -> bool:
        """Whether the gyroscope, which repeats itself since the sample `begin`, stopped within a sample."""
        if begin < _BEFORE:
            return False
        steps = np.linalg.norm(self._values[begin - _BEFORE : begin, _GYRO] - self._values[begin, _GYRO], axis=1)
        # Samples that come in bursts may bear stamps that lie much closer than they were taken.
        seconds = max(float(self._time_ns[begin] - self._time_ns[begin - 1]) * 1e-9, self._seconds_a_sample())
        return bool(steps.min() > _MOST_RAD_S2 * seconds)

    def _turns_alone(self, imu: ImuSamples, turned: NDArray[np.float64], bias: NDArray[np.float64]) -> bool:
        """Whether the scans turn and turn while the gyroscope repeats itself."""
        if not self._turns:
            self._bias = bias.copy()
        end_ns = int(imu.time_ns[-1])
        claimed = (self._values[-1, _GYRO] - self._bias) * float(end_ns - imu.time_ns[0]) * 1e-9
        self._turns.append((end_ns, turned - claimed))
        while end_ns - self._turns[0][0] > _WHILE_S * 1e9:
            self._turns.popleft()
        ways = np.cumsum([turn for _, turn in self._turns], axis=0)
        return bool(np.linalg.norm(ways - ways[-1], axis=1).max() > _TURNED_RAD)

    def _seconds_a_sample(self) -> float:
        return float(self._time_ns[-1] - self._time_ns[0]) * 1e-9 / (len(self._time_ns) - 1)

    def _feels_nothing(self) -> bool:
        """Whether the accelerometer repeats itself while the gyroscope turns to and fro."""
        begin = self._stuck_since(_ACCEL, _GYRO, _GYRO_NOISE)
        if begin is None:
            return False
        means = np.array([part.mean(axis=0) for part in np.array_split(self._values[begin:, _GYRO], _PARTS)])
        return bool(np.minimum(means.max(axis=0), -means.min(axis=0)).max() > _TO_AND_FRO_RAD_S)

    def _stuck_since(self, axes: slice, other: slice, noise: float) -> int | None:
        """The sample since which a sensor repeats itself, if that is long enough and the other sensor has noise."""
        if len(self._values) < _FEWEST or (self._values[-1, axes] != self._values[-2, axes]).any():
            return None
        differs = np.flatnonzero((self._values[:, axes] != self._values[-1, axes]).any(axis=1))
        begin = int(differs[-1]) + 1 if len(differs) else 0
        seconds = float(self._time_ns[-1] - self._time_ns[begin]) * 1e-9
        if seconds < _STUCK_S or len(self._values) - begin < _FEWEST:
            return None
        return begin if np.abs(np.diff(self._values[begin:, other], 2, axis=0)).mean() > noise else None

    def _sentence(self, name: str, how: str) -> str:
        return (
            f"for half a second and more the {name} has given the same values sample after sample, {how}: it has failed, or its "
            "driver repeats what it had last"
        )
