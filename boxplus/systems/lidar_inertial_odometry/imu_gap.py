"""Across a gap of the IMU the LiDAR says how the platform moves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import BW, TANGENT, boxminus_into
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.sequencer import Frame


def begins_blind(frame: Frame, max_gap_s: float) -> bool:
    """Whether the scan before ended within a gap of the IMU that this scan, or its beginning, lies in as well."""
    if frame.largest_gap_s <= max_gap_s:
        return False
    after = frame.imu.time_ns[frame.imu.time_ns > frame.begin_ns]
    before = frame.imu.time_ns[frame.imu.time_ns <= frame.begin_ns]
    return bool(len(before) and ((after[0] if len(after) else frame.scan.end_ns) - before[-1]) * 1e-9 > max_gap_s)


def guessed_until(frame: Frame, guessed_ns: int) -> int:
    """Until when the velocity is guessed after a pause [ns]: where the IMU is back later than the LiDAR, for two scans more.

    Within its gap the velocity is known to a metre a second, which distorts the first scan after it by a decimetre.
    """
    scan = frame.scan
    return scan.end_ns + 3 * (scan.end_ns - scan.start_ns) // 2 if frame.begin_ns <= guessed_ns else guessed_ns


def mean_motion(x_before: NDArray[np.float64], x: NDArray[np.float64], seconds: float) -> NDArray[np.float64]:
    """(2, 3) turn rate in the IMU frame [rad/s] and velocity in the world [m/s] that lead from one state (36,) to another."""
    moved = np.empty(TANGENT)
    boxminus_into(x, x_before, moved)
    rates: NDArray[np.float64] = moved[:6].reshape(2, 3) / seconds
    return rates


def with_turn_rate(frame: Frame, rate: NDArray[np.float64], x: NDArray[np.float64]) -> ImuSamples:
    """The samples of a frame that begins blind; the one that is held across the gap shows `rate` (3,) [rad/s]."""
    imu = frame.imu
    gyro = imu.gyro.copy()
    gyro[imu.time_ns <= frame.begin_ns] = rate + x[BW : BW + 3]
    return ImuSamples(imu.time_ns, gyro, imu.accel)


def imu_words(frame: Frame, max_gap_s: float) -> list[str]:
    """What is said of a scan that the IMU does not cover: warnings of its estimate."""
    words = []
    if not frame.covered:
        words.append("no IMU sample at or after the end of the scan: the last one was held")
    if frame.largest_gap_s > max_gap_s:
        words.append(
            f"IMU gap of {frame.largest_gap_s:.2f} s, longer than {max_gap_s:g} s: motion taken from the LiDAR alone, covariance "
            "widened"
        )
    return words
