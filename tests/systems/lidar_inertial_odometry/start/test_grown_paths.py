"""Paths that go on from try to try are those through all scans at once, and register what is new alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from boxplus.runs.storage.state_codec import read_state, write_state
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import Frame
from boxplus.simulation import Simulation, simulate
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import lidar_path
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import middle_of
from boxplus.systems.lidar_inertial_odometry.start.beginning import Beginning
from boxplus.systems.lidar_inertial_odometry.start.grown_paths import GrownPaths
from tests.systems.lidar_inertial_odometry.small_drives import LIDAR, config, frames


@pytest.fixture(scope="module")
def drive() -> Simulation:
    return simulate("walk", duration_s=2.0, lidar=LIDAR)


@pytest.fixture(scope="module")
def seen(drive: Simulation) -> list[Frame]:
    return frames(drive.events())


def _same(path: LidarPath, other: LidarPath) -> bool:
    return all(np.array_equal(getattr(path, name), getattr(other, name)) for name in LidarPath.__slots__)


def test_a_path_goes_on_as_if_all_scans_had_been_there_at_once(
    drive: Simulation, seen: list[Frame], registered: list[int]
) -> None:
    settings, grown = config(drive), GrownPaths()
    for count in (8, 11, 15):
        path = grown.through(Beginning(seen[:count], settings))
    assert registered == [frame.scan.start_ns for frame in seen[:15]]  # each once
    whole = Beginning(seen[:15], settings)
    assert _same(path, lidar_path(whole.scans, whole.registration, whole.guesses, unbroken=True))
    assert grown.is_whole_from(seen[0].scan) and not grown.is_whole_from(seen[1].scan)


def test_a_steady_path_goes_on_with_the_bias_it_began_with_and_begins_anew_with_another(
    drive: Simulation, seen: list[Frame], registered: list[int]
) -> None:
    settings, grown = config(drive), GrownPaths()
    velocity = np.array([0.4, 0.0, 0.0])
    first = grown.steady(Beginning(seen[:8], settings), np.full(3, 0.01), velocity)
    on = grown.steady(Beginning(seen[:12], settings), np.full(3, 0.012), velocity)
    assert len(registered) == 12 and np.array_equal(on.p_path_lidar[:8], first.p_path_lidar)
    again = grown.steady(Beginning(seen[:12], settings), np.full(3, 0.05), velocity)
    assert len(registered) == 24 and not np.array_equal(on.R_path_lidar, again.R_path_lidar)
    grown.steady(Beginning(seen[:12], settings), np.full(3, 0.05), velocity + 0.5)
    assert len(registered) == 36


def test_what_no_try_begins_with_any_more_is_forgotten(drive: Simulation, seen: list[Frame], registered: list[int]) -> None:
    settings, grown = config(drive), GrownPaths()
    for begin in (0, 4):
        grown.through(Beginning(seen[begin:10], settings))
    grown.forget_before(seen[4].scan)
    assert not grown.is_whole_from(seen[0].scan) and grown.is_whole_from(seen[4].scan)
    assert list(grown._begun) == [seen[4].scan.end_ns]
    registered.clear()
    grown.through(Beginning(seen[4:11], settings))
    assert registered == [seen[10].scan.start_ns]


def test_a_path_of_a_checkpoint_goes_on_as_if_it_had_not_been_interrupted(
    drive: Simulation, seen: list[Frame], tmp_path: Path
) -> None:
    settings, grown = config(drive), GrownPaths()
    bias, velocity = np.full(3, 0.01), np.array([0.4, 0.0, 0.0])

    def go_on(kept: GrownPaths, count: int, off: float) -> tuple[LidarPath, LidarPath]:
        now = Beginning(seen[:count], settings)
        return kept.through(now), kept.steady(now, bias + off, velocity)

    go_on(grown, 9, 0.0)
    write_state(tmp_path / "state.npz", {"grown": grown})
    read = read_state(tmp_path / "state.npz")["grown"]
    assert isinstance(read, GrownPaths) and read.is_whole_from(seen[0].scan)
    for path, other in zip(go_on(grown, 14, 0.003), go_on(read, 14, 0.003), strict=True):
        assert _same(path, other)


def test_two_scans_that_begin_together_begin_two_paths(drive: Simulation, seen: list[Frame]) -> None:
    """One early stamp is enough for that; scans are told apart by their ends."""
    early = seen[5].scan.time_ns.copy()
    early[0] = seen[4].scan.start_ns
    alike = [*seen[:5], replace(seen[5], scan=Scan.from_arrays(seen[5].scan.p_lidar, early)), *seen[6:]]
    assert alike[4].scan.start_ns == alike[5].scan.start_ns
    settings, grown = config(drive), GrownPaths()
    grown.through(Beginning(alike[4:12], settings))
    later = Beginning(alike[5:14], settings)
    assert grown.through(later).time_ns.tolist() == [middle_of(scan) for scan in later.scans]


def test_a_path_goes_on_no_further_than_it_is_whole(drive: Simulation, seen: list[Frame], registered: list[int]) -> None:
    settings, grown = config(drive), GrownPaths()
    gap = [*seen[:5], *seen[17:20]]  # more than a second apart, as after a gap of the LiDAR
    path = grown.through(Beginning(gap, settings))
    assert not grown.is_whole_from(seen[0].scan) and path.segment.tolist() == [0] * 5 + [1]
    grown.through(Beginning(gap, settings))
    assert len(registered) == 6


def test_a_gyroscope_that_begins_to_turn_wildly_begins_its_paths_anew(
    drive: Simulation, seen: list[Frame], tmp_path: Path
) -> None:
    """It may be in deg/s then: one more guess, which earlier scans are registered with as well, go on or not."""
    wild = [
        replace(f, imu=ImuSamples(f.imu.time_ns, np.rad2deg(f.imu.gyro) + (9.0 if k >= 4 else 0.0), f.imu.accel))
        for k, f in enumerate(seen)
    ]
    settings, grown = config(drive), GrownPaths()
    few, more = Beginning(wild[:7], settings), Beginning(wild[:13], settings)
    assert (len(few.guesses), len(more.guesses)) == (1, 2)
    grown.through(few)
    write_state(tmp_path / "state.npz", {"grown": grown})
    read = read_state(tmp_path / "state.npz")["grown"]
    whole = lidar_path(more.scans, more.registration, more.guesses, unbroken=True)
    assert _same(grown.through(more), whole) and _same(read.through(more), whole)
