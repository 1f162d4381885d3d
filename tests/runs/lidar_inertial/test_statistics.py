"""A run that does not claim to know where it ended says so, and no other one does."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.filtering.nav_state import TANGENT, NavState
from boxplus.manifolds import so3
from boxplus.runs.lidar_inertial.config import MapConfig, RunConfig
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.runs.lidar_inertial.statistics import RunStatistics
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import Fault, Scenario, Simulation, SpinningLidar, simulate
from boxplus.simulation.faults import Event, nan_burst
from boxplus.simulation.live_recording import as_recording
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.worlds import sites
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate, Status
from tests.systems.lidar_inertial_odometry.small_drives import room_walk


def estimate(scan: int, p: np.ndarray, P: np.ndarray, status: Status = "ok") -> Estimate:
    x = NavState.identity().pack()
    x[9:12] = p
    state, nothing = NavState.unpack(x), np.zeros((0, 3), dtype=np.float32)
    return Estimate(
        time_ns=scan * 100_000_000,
        state=state,
        covariance=np.zeros((TANGENT, TANGENT)),
        pose_covariance=P,
        status=status,
        weak_directions=(),
        lidar_share=np.ones(6),
        points_raw=0,
        points_filtered=0,
        points_used=0,
        rejected={},
        residual_rms=0.0,
        iterations=1,
        converged=True,
        warnings=(),
        timing_s={},
        p_lidar=nothing,
        intensity=None,
    )


def straight(
    way_m: float, sigma_m: float, axis: np.ndarray, statuses: tuple[Status, ...] = ("ok",) * 5, *, sigma_deg: float = 0.0
) -> RunStatistics:
    """A way of some length, its last position known to `sigma_m` along a direction (3,), a hundred times better across it.

    The rotation likewise, to `sigma_deg`.
    """
    statistics = RunStatistics()
    turn = so3.exp(np.cross([0.0, 0.0, 1.0], axis / np.linalg.norm(axis)))
    P = np.zeros((6, 6))
    for part, sigma in ((slice(0, 3), np.deg2rad(sigma_deg)), (slice(3, 6), sigma_m)):
        P[part, part] = turn @ np.diag(np.array([0.01, 0.01, 1.0]) * sigma) ** 2 @ turn.T
    for scan, status in enumerate(statuses):
        last = scan == len(statuses) - 1
        statistics.add(estimate(scan, np.array([way_m * scan / (len(statuses) - 1), 0.0, 0.0]), P if last else 100.0 * P, status))
    return statistics


@given(st.floats(0.0, 500.0), st.floats(0.0, 20.0), st.integers(0, 1000))
def test_a_warning_where_and_only_where_the_last_position_is_vague(way_m: float, sigma_m: float, seed: int) -> None:
    axis = np.random.default_rng(seed).normal(size=3)
    limit = max(0.05, 0.02 * way_m)
    if not 0.999 < sigma_m / limit < 1.001:
        assert bool(straight(way_m, sigma_m, axis).vague_warnings(None)) == (sigma_m > limit)


@given(st.floats(0.0, 500.0), st.floats(0.0, 200.0), st.integers(0, 1000))
def test_a_position_that_is_unknown_to_a_metre_and_to_a_fifth_of_the_way_is_told(way_m: float, sigma_m: float, seed: int) -> None:
    axis = np.random.default_rng(seed).normal(size=3)
    limit = max(1.0, 0.2 * way_m)
    if not 0.999 < sigma_m / limit < 1.001:
        statistics = straight(way_m, sigma_m, axis)
        assert (statistics.unknown_position(None) is not None) == (sigma_m > limit)


@given(st.floats(0.0, 90.0), st.integers(0, 1000))
def test_a_warning_where_and_only_where_the_last_rotation_is_vague(sigma_deg: float, seed: int) -> None:
    """A stairwell seen by sixteen rings: 2.5 deg off at 2.9 deg of its own (1 sigma), and nothing said."""
    axis = np.random.default_rng(seed).normal(size=3)
    statistics = straight(20.0, 0.01, axis, sigma_deg=sigma_deg)
    assert statistics.unknown_position(None) is None
    if abs(sigma_deg - 2.0) > 0.01:
        told = [warning.text for warning in statistics.vague_warnings(None)]
        assert len(told) == (sigma_deg > 2.0)
        for text in told:
            said = re.search(r"knows its last rotation to (\d+\.\d) deg \(1 sigma\) only, after", text)
            assert said is not None and abs(float(said[1]) - sigma_deg) < 0.05 + 1e-6  # to the digit, either way at a half


def test_position_and_rotation_are_told_in_one_sentence() -> None:
    (warning,) = straight(8.0, 0.31, np.ones(3), sigma_deg=3.0).vague_warnings(None)
    assert "knows its last position to 31 cm and its last rotation to 3.0 deg (1 sigma) only, after a way" in warning.text


def test_what_may_be_behind_it_is_said() -> None:
    vague = straight(8.0, 0.31, np.ones(3), ("ok", "ok", "weak", "weak", "ok"))
    (warning,) = vague.vague_warnings((1.75, 0.3))
    assert warning.text == (
        "by its own covariance the run knows its last position to 31 cm (1 sigma) only, after a way of 8.0 m: T_imu_lidar was "
        "known to 1.8 deg and 30 cm at first (better: --T-imu-lidar), and 2 of 5 scans left directions open"
    )
    (warning,) = straight(8.0, 12.0, np.ones(3)).vague_warnings(None)
    assert "to 12.0 m (1 sigma) only" in warning.text
    assert warning.text.endswith("its start, its IMU and what it saw tell no more")


@pytest.mark.parametrize("unstarted", [0, 8, 65])
def test_scans_without_a_pose_are_told(unstarted: int) -> None:
    """Of a recording whose first seconds showed no start, the run ended "finished: 15 scans (15 ok)" and said no more."""
    statistics = straight(0.7, 0.01, np.ones(3), ("ok",) * 15)
    origin = statistics.first_time_ns
    assert origin is not None
    statistics.add_event(Scan.from_arrays(np.ones((2, 3)), np.array([-10, 0]) + origin - unstarted * 100_000_000))
    statistics.scans_read = 15 + unstarted
    told = statistics.late_start_warnings(unstarted, "not at rest, and one wall says little; waiting for more data")
    assert len(told) == (1 if unstarted == 65 else 0)
    if told:
        assert statistics.late_start_warnings(1, None)[0].text.startswith("1 of the 80 scans that were read has no pose: ")
        assert told[0].text.startswith("65 of the 80 scans that were read have no pose: no start was found sooner, ")
        assert "begin 6.5 s after the first scan" in told[0].text
        assert told[0].text.endswith("where walls are near. Just before: not at rest, and one wall says little")


def _one_beyond(events: Iterable[Event]) -> Iterator[Event]:
    """The hundredth sample turns by 500 rad/s."""
    read = 0
    for event in events:
        if isinstance(event, ImuSamples):
            gyro = event.gyro.copy()
            if read <= 100 < read + len(event):
                gyro[100 - read] = 500.0
            read += len(event)
            event = ImuSamples(event.time_ns, gyro, event.accel)
        yield event


def test_samples_that_are_no_measurements_are_told(tmp_path: Path) -> None:
    """A run ended without a word of them, but for a table of the report."""
    fault = nan_burst(1.0, 0.3).then(Fault("beyond", "a rate beyond any sensor", _one_beyond))
    simulation = room_walk(2.5)
    sound, spoilt = (
        run_odometry(as_recording(simulation, spoiling), tmp_path / name, RunConfig(map=MapConfig(save=False)))
        for spoiling, name in ((None, "sound"), (fault, "spoilt"))
    )
    assert sound.warnings == []
    told, read = [warning.text for warning in spoilt.warnings], spoilt.imu_samples_read
    assert len(told) == 2
    assert told[0].startswith(f"30 of {read} IMU samples are no numbers (NaN or infinite) and were left out: ")
    assert told[1].startswith(f"1 of {read} IMU samples are beyond what any sensor measures and were left out: ")


def test_scans_that_come_again_are_told() -> None:
    statistics = straight(0.7, 0.01, np.ones(3), ("ok",) * 15)
    statistics.scans_read = 17
    assert statistics.repeated_warnings(0) == []
    (warning,) = statistics.repeated_warnings(2)
    assert warning.text.startswith(
        "2 of the 17 scans that were read have all points of the one before, with new stamps, and were left out"
    )


@pytest.mark.slow
@pytest.mark.parametrize("given", [True, False])
def test_a_lever_arm_that_nobody_gave_is_told(tmp_path: Path, given: bool) -> None:
    """A turn about one axis shows it only in part, and moves the path by as much."""
    recording = as_recording(simulate("spin", duration_s=6.0, lidar=SpinningLidar(azimuth_steps=300)))
    if not given:
        recording.info.T_imu_lidar = None
    summary = run_odometry(recording, tmp_path / "out")
    told = [warning.text for warning in summary.warnings if "by its own covariance" in warning.text]
    assert len(told) == (0 if given else 1)
    assert all("T_imu_lidar was known to" in text for text in told)


@pytest.mark.slow
@pytest.mark.parametrize("world", ["tunnel", "street"])
def test_a_drive_along_a_smooth_tunnel_is_not_to_be_trusted(tmp_path: Path, world: str) -> None:
    """At a constant speed the IMU is as quiet as at rest, and along bare walls the LiDAR sees no difference."""
    motion = manoeuvres.constant_velocity(6.0, (-24.0, 0.2, 1.8), (8.0, 0.0, 0.0), np.eye(3))
    site = sites.tunnel(300.0) if world == "tunnel" else sites.street(width=10.0, seed=1)
    simulation = Simulation(Scenario(world, site, motion, SpinningLidar(azimuth_steps=600), T_imu_lidar=np.eye(4)), 3, 6.0)
    summary = run_odometry(as_recording(simulation), tmp_path / "out", RunConfig(map=MapConfig(save=False)))
    if world == "tunnel":
        assert summary.unknown_position is not None and summary.contradiction == summary.unknown_position
        assert "by its own covariance the run knows its last position to" in summary.describe_state()
    else:
        assert summary.unknown_position is None and summary.contradiction is None
        assert summary.path_length_m > 30.0
