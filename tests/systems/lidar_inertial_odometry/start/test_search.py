"""The search for a start: what a refused one costs, which scans make room, and that none is lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import Frame
from boxplus.simulation import Simulation, simulate
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from boxplus.systems.lidar_inertial_odometry.start.search import StartSearch
from boxplus.systems.lidar_inertial_odometry.start.start import Start
from tests.systems.lidar_inertial_odometry.small_drives import LIDAR, config, frames


def _searched(search: StartSearch, seen: list[Frame]) -> tuple[Start | None, list[int]]:
    """The start, if there is one, and how many scans waited at every try."""
    tries = []
    for frame in seen:
        search.frames.append(frame)
        if search.due:
            tries.append(len(search.frames))
            if (found := search.find()) is not None:
                return found, tries
    return None, tries


@pytest.fixture(scope="module")
def turning_backwards() -> tuple[list[Frame], LioConfig]:
    """On the spot at 90 deg/s, by a gyroscope that turns the other way: refused whatever comes."""
    simulation = simulate("spin", duration_s=8.0, lidar=LIDAR)
    seen = [replace(f, imu=ImuSamples(f.imu.time_ns, -f.imu.gyro, f.imu.accel)) for f in frames(simulation.events())]
    return seen[30:], config(simulation)


@pytest.mark.slow
def test_a_start_that_is_refused_registers_a_scan_two_or_three_times(
    turning_backwards: tuple[list[Frame], LioConfig], registered: list[int]
) -> None:
    seen, settings = turning_backwards
    search = StartSearch(settings)
    found, tries = _searched(search, seen)
    assert found is None and "in opposite senses" in str(search.problem)
    assert len(tries) >= 6 and max(tries) <= 50 and max(np.diff(tries)) <= 20
    assert len(registered) / len(seen) < 3.0
    assert search.forgotten + len(search.frames) == len(seen)
    assert len(search._grown._begun) <= 5  # of what waits
    search.give_up()
    assert search.forgotten == len(seen) and not search.frames


@pytest.mark.slow
def test_a_path_that_has_lost_hold_is_left_at_once_for_the_one_that_goes_on(
    turning_backwards: tuple[list[Frame], LioConfig],
) -> None:
    seen, settings = turning_backwards
    search = StartSearch(settings)
    # The ninth scan shows all of it thirty metres higher, and so do those after it.
    elsewhere = [
        replace(f, scan=Scan.from_arrays(f.scan.p_lidar + np.float32([0, 0, 30 * (k >= 8)]), f.scan.time_ns))
        for k, f in enumerate(seen[:20])
    ]
    found, tries = _searched(search, elsewhere)
    assert found is None and tries == [11, 15, 20]  # the newest of fifteen begin before it, those of twenty do not
    assert search.forgotten == 9 and "in opposite senses" in str(search.problem)


def test_the_start_begins_with_the_first_of_the_scans_that_wait() -> None:
    simulation = simulate("at_rest", duration_s=3.0, lidar=LIDAR)
    seen = frames(simulation.events())
    astray = [
        replace(f, scan=Scan.from_arrays(f.scan.p_lidar + np.float32(100.0 * k), f.scan.time_ns))
        for k, f in enumerate(seen[:10], 1)
    ]
    search = StartSearch(config(simulation))
    found, _ = _searched(search, astray + seen[10:])
    assert found is not None and found.kind == "static"
    assert search.frames[0].scan.end_ns == found.time_ns and search.forgotten >= 10
    assert search.forgotten + len(search.frames) + 3 == 30  # and those that came after it


def test_after_a_gap_of_the_lidar_a_start_is_found_as_soon_as_its_newest_scans_show_it() -> None:
    simulation = simulate("at_rest", duration_s=6.0, lidar=LIDAR)
    seen = frames(e for e in simulation.events() if not isinstance(e, Scan) or not 0.9 < _since(simulation, e) < 3.9)
    found, tries = _searched(StartSearch(config(simulation)), seen)
    assert found is not None and found.time_ns == seen[_begin(seen, found)].scan.end_ns
    assert _begin(seen, found) >= 9 and sum(tries[-1:]) <= 25


@pytest.mark.slow
def test_every_scan_of_a_run_without_a_start_is_counted(turning_backwards: tuple[list[Frame], LioConfig]) -> None:
    seen, settings = turning_backwards
    odometry = LidarInertialOdometry(settings)
    assert odometry.push_imu(ImuSamples.joined(frame.imu for frame in seen[:16])) == []
    assert [estimate for frame in seen[:16] for estimate in odometry.push_scan(frame.scan)] == []
    assert odometry.flush() == [] and odometry.flush() == []
    assert odometry.counters["scan before a start could be found"] == 16
    assert odometry.start_problem is not None and odometry.start_problem.count("in opposite senses") == 1


def _since(simulation: Simulation, scan: Scan) -> float:
    return (scan.start_ns - simulation.start_ns) * 1e-9


def _begin(seen: list[Frame], found: Start) -> int:
    return [frame.scan.end_ns for frame in seen].index(found.time_ns)
