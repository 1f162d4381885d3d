"""Pauses of both sensors, and that what is contradicted soon after one is said to come of it."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import Frame
from boxplus.systems.lidar_inertial_odometry.watches.pause import Pause, is_pause

S = 1_000_000_000


def frame(begin_s: float, start_s: float, imu_gap_s: float) -> Frame:
    start, end = round(start_s * S), round((start_s + 0.1) * S)
    scan = Scan(np.ones((1, 3), np.float32), np.array([end]), None, start, end)
    imu = ImuSamples(np.array([start, end]), np.zeros((2, 3)), np.zeros((2, 3)))
    return Frame(scan, imu, round(begin_s * S), True, imu_gap_s)


@pytest.mark.parametrize(
    ("begin_s", "imu_gap_s", "expected"),
    [
        (0.0, 1.0, True),
        (0.9, 1.0, False),  # scans went on
        (0.0, 0.01, False),  # the IMU went on
    ],
)
def test_it_is_one_where_both_stop(begin_s: float, imu_gap_s: float, expected: bool) -> None:
    assert is_pause(frame(begin_s, 1.0, imu_gap_s)) is expected


@pytest.mark.parametrize(("told_s", "says"), [(2.0, True), (12.0, False)])
def test_a_contradiction_soon_after_a_pause_of_both(told_s: float, says: bool) -> None:
    pause = Pause()
    pause.begin(frame(0.0, 1.0, 1.0))
    pause.update(round(1.2 * S), False)
    assert pause.preface == ""
    pause.update(round((told_s + 0.1) * S), True)
    assert bool(pause.preface) is says
    if says:
        assert pause.preface.startswith("1.1 s after a pause of 1.0 s in which neither sensor told")
        pause.update(30 * S, True)  # the same contradiction, later
        assert pause.preface


def test_for_a_second_after_it_the_speed_comes_right() -> None:
    pause = Pause()
    assert not pause.settles(2 * S)
    pause.begin(frame(0.0, 1.0, 1.0))
    assert pause.settles(round(1.9 * S)) and not pause.settles(round(2.1 * S))
