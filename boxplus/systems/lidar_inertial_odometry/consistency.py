"""Whether gyroscope, LiDAR, mounting and point times agree; what does not is said in a sentence.

The filter corrects what it predicted wrongly, scan after scan, and hides a wrong unit or mounting that way. Two cheap sums show
it: corrections of the rotation that grow with the rotation itself, and points that no longer fit the map. Either one only raises
a suspicion; it is settled by registering the last scans without the IMU and comparing both rotations
(`sensors.lidar_rotation`), which no error of the filter can distort.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.filtering.nav_state import RL, R
from boxplus.manifolds import so3
from boxplus.sensors.imu import ImuSamples
from boxplus.sensors.lidar_rotation import RotationAlignment, estimate_rotation_extrinsic
from boxplus.sensors.sequencer import Frame
from boxplus.systems.lidar_inertial_odometry.start import joined_imu

_KEPT_SCANS = 40
_FEWEST_SCANS = 25
_SCANS_BETWEEN_CHECKS = 50
_KEEP = 0.96  # of both sums, from scan to scan
_LEAST_TURN = 20.0 * 0.005**2  # rad², of the faded sum: below it no ratio means anything
_SUSPICIOUS_SHARE = 0.02  # of the squared rotation, corrected: a mounting 8 degrees off, or a scale 14 % off
_DEGREES = (30.0, 110.0)  # gyroscope over LiDAR: 57.3 is deg/s taken for rad/s
_WRONG_ANGLE_DEG = 8.0
_KNOWN_DEG = 5.0
_LOST_STREAK = 3
_SHORT_SPAN, _LONG_SPAN = 0.05, 1.5  # of the time between scans


class Consistency:
    """Follows the scans of one run.

    Args:
        min_matched_share: with less than this share of the points on the map, three scans in a row, the estimate is lost.

    Attributes:
        contradiction: what the last comparison of gyroscope and LiDAR found wrong, a sentence; None while they agree.
    """

    def __init__(self, min_matched_share: float) -> None:
        self._min_matched_share = min_matched_share
        self._frames: deque[Frame] = deque(maxlen=_KEPT_SCANS)
        self._turned = 0.0
        self._corrected = 0.0
        self._unmatched = 0
        self._until_check = 0
        self._previous_start_ns: int | None = None
        self._told: set[str] = set()
        self.contradiction: str | None = None

    @property
    def lost(self) -> bool:
        """Whether the last scans no longer lie on the map."""
        return self._unmatched >= _LOST_STREAK

    def update(
        self,
        frame: Frame,
        x_before: NDArray[np.float64],
        x_prior: NDArray[np.float64],
        x: NDArray[np.float64],
        matched_share: float,
    ) -> list[str]:
        """Take one scan in; returns what is wrong, one sentence each.

        Args:
            frame: the scan and its IMU samples.
            x_before, x_prior, x: (36,) state at the end of the scan before, predicted, and after the update.
            matched_share: points that lie on the map over points filtered.
        """
        self._frames.append(frame)
        self._unmatched = self._unmatched + 1 if matched_share < self._min_matched_share else 0
        before = x_before[R : R + 9].reshape(3, 3)
        predicted = _turn(before.T @ x_prior[R : R + 9].reshape(3, 3))
        corrected = _turn(before.T @ x[R : R + 9].reshape(3, 3)) - predicted
        self._turned = _KEEP * self._turned + float(predicted @ predicted)
        self._corrected = _KEEP * self._corrected + float(corrected @ corrected)
        self._until_check = max(self._until_check - 1, 0)
        warnings = self._span(frame)
        suspicious = self._turned > _LEAST_TURN and self._corrected > _SUSPICIOUS_SHARE * self._turned
        if (suspicious or self._unmatched) and not self._until_check and len(self._frames) >= _FEWEST_SCANS:
            self._until_check = _SCANS_BETWEEN_CHECKS
            warnings += self._compare(x[RL : RL + 9].reshape(3, 3), mounting_too=suspicious)
        if self._unmatched == _LOST_STREAK:
            warnings.append(
                f"only {matched_share:.0%} of the points fit the map, and too few in {_LOST_STREAK} scans in a row: the "
                "estimate has left the map and is not to be trusted"
            )
        return warnings

    def _compare(self, R_imu_lidar: NDArray[np.float64], *, mounting_too: bool) -> list[str]:
        """Gyroscope against LiDAR over the last scans, without the filter."""
        try:
            found = estimate_rotation_extrinsic([frame.scan for frame in self._frames], joined_imu(self._frames))
        except InputError:
            return []
        text = judge_unit(found) or (judge_mounting(found, R_imu_lidar) if mounting_too else None)
        if text is not None or mounting_too:
            self.contradiction = text
        return [] if text is None else [text]

    def _span(self, frame: Frame) -> list[str]:
        """The time a scan takes against the time between scans."""
        scan, previous = frame.scan, self._previous_start_ns
        self._previous_start_ns = scan.start_ns
        span, period = (scan.end_ns - scan.start_ns) * 1e-9, 0.0 if previous is None else (scan.start_ns - previous) * 1e-9
        if not 0.0 < period < 1.0 or span == 0.0 or _SHORT_SPAN * period < span < _LONG_SPAN * period or "span" in self._told:
            return []
        self._told.add("span")
        return [
            f"the points of a scan span {span * 1e3:.3g} ms, but scans come every {period * 1e3:.3g} ms: "
            "check the unit of the point times (s, ms, µs or ns)"
        ]


def judge_unit(found: RotationAlignment) -> str | None:
    """What a comparison of both rotations says against the gyroscope's unit: a sentence, or None."""
    low, high = _DEGREES
    if low < found.gyro_scale < high:
        return (
            f"over {found.intervals} scans the gyroscope turned {found.gyro_scale:.0f} times as far as the LiDAR: it reports "
            "deg/s; convert it to rad/s (reading a recording: --gyro-unit deg/s)"
        )
    if 1.0 / high < found.gyro_scale < 1.0 / low:
        return (
            f"over {found.intervals} scans the LiDAR turned {1.0 / found.gyro_scale:.0f} times as far as the gyroscope: its "
            "rates were taken for deg/s and are rad/s (reading a recording: --gyro-unit rad/s)"
        )
    return None


def judge_mounting(found: RotationAlignment, R_imu_lidar: NDArray[np.float64]) -> str | None:
    """What it says against the given R_imu_lidar (3, 3): a sentence, or None. Axes known to 5 degrees count."""
    seen = found.std_deg < _KNOWN_DEG
    apart = found.axes.T @ so3.log(found.R_imu_lidar @ R_imu_lidar.T)
    angle = float(np.degrees(np.linalg.norm(apart[seen])))
    if angle < _WRONG_ANGLE_DEG:
        return None
    inverse = found.axes.T @ so3.log(found.R_imu_lidar @ R_imu_lidar)
    inverse_angle = float(np.degrees(np.linalg.norm(inverse[seen])))
    advice = "check T_imu_lidar"
    if inverse_angle < 0.3 * angle:
        advice = f"its inverse fits to {inverse_angle:.1f} deg: T_imu_lidar maps LiDAR coordinates to IMU coordinates"
    return f"gyroscope and LiDAR turn about axes {angle:.0f} deg apart under the given T_imu_lidar; {advice}"


def _turn(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) sine of the angle times the axis of a rotation (3, 3): the rotation vector, for the turns within one scan."""
    M = rotation
    return np.array([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]]) * 0.5


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
