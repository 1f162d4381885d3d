"""What is contradicted soon after a pause of both sensors is said to come of it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import Frame
from boxplus.simulation import Simulation, simulate
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from boxplus.systems.lidar_inertial_odometry.watches.pause import Pause
from tests.systems.lidar_inertial_odometry.small_drives import config, run

S = 1_000_000_000


def frame(begin_s: float, start_s: float, imu_gap_s: float) -> Frame:
    start, end = round(start_s * S), round((start_s + 0.1) * S)
    scan = Scan(np.ones((1, 3), np.float32), np.array([end]), None, start, end)
    imu = ImuSamples(np.array([start, end]), np.zeros((2, 3)), np.zeros((2, 3)))
    return Frame(scan, imu, round(begin_s * S), True, imu_gap_s)


@pytest.mark.parametrize(
    ("begin_s", "imu_gap_s", "told_s", "says"),
    [
        (0.0, 1.0, 2.0, True),
        (0.0, 1.0, 12.0, False),  # long after it
        (0.9, 1.0, 2.0, False),  # scans went on
        (0.0, 0.01, 2.0, False),  # the IMU went on
    ],
)
def test_a_contradiction_soon_after_a_pause_of_both(begin_s: float, imu_gap_s: float, told_s: float, says: bool) -> None:
    pause = Pause()
    pause.update(frame(begin_s, 1.0, imu_gap_s), False)
    pause.update(frame(1.1, 1.1, 0.005), False)
    assert pause.preface == ""
    pause.update(frame(told_s, told_s, 0.005), True)
    assert bool(pause.preface) is says
    if says:
        assert pause.preface.startswith("1.1 s after a pause of 1.0 s in which neither sensor told")
        pause.update(frame(30.0, 30.0, 0.005), True)  # the same contradiction, later
        assert pause.preface


def with_pause(simulation: Simulation, begin_s: float, duration_s: float, until_s: float) -> Iterator[Scan | ImuSamples]:
    begin, end, last = (simulation.start_ns + round(s * S) for s in (begin_s, begin_s + duration_s, until_s))
    for event in simulation.events():
        if isinstance(event, Scan):
            if event.start_ns > last:
                return
            if event.end_ns <= begin or event.start_ns >= end:
                yield event
        elif (kept := (event.time_ns < begin) | (event.time_ns > end)).any():
            yield ImuSamples(event.time_ns[kept], event.gyro[kept], event.accel[kept])


@pytest.mark.slow
@pytest.mark.parametrize("duration_s", [1.0, 3.0])
def test_a_walk_that_pauses_names_the_pause_first(duration_s: float) -> None:
    simulation = simulate("walk")
    odometry = LidarInertialOdometry(config(simulation))
    run(odometry, with_pause(simulation, 24.5, duration_s, 24.5 + duration_s + 5.0))
    assert odometry.contradiction is not None
    assert f"s after a pause of {duration_s:.0f}." in odometry.contradiction.split("in which neither sensor told")[0]
