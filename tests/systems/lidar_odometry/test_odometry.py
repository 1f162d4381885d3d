"""Odometry of a LiDAR alone on the simulator, against exact ground truth; what it refuses and what it says when it fails."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.runs.storage.state_codec import read_state, write_state
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import Simulation, SpinningLidar, simulate
from boxplus.systems.lidar_inertial_odometry.config import LidarOdometryConfig, LioConfig
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.lidar_inertial_odometry.watches import long_baseline
from boxplus.systems.lidar_odometry.odometry import LidarOdometry

SPARSE = SpinningLidar(azimuth_steps=600)


def _scans(simulation: Simulation) -> list[Scan]:
    return [event for event in simulation.events() if isinstance(event, Scan)]


def _run(odometry: LidarOdometry, scans: Sequence[Scan]) -> list[Estimate]:
    return [estimate for scan in scans for estimate in odometry.push_scan(scan)] + odometry.flush()


def _errors(simulation: Simulation, estimates: Sequence[Estimate]) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,) [m] and angles (n,) [rad] from the truth, the first pose taken over."""
    truth = simulation.ground_truth(np.array([estimate.time_ns for estimate in estimates]))
    T = simulation.T_imu_lidar
    R = truth.R_world_imu @ T[:3, :3]
    p = truth.p_world_imu + truth.R_world_imu @ T[:3, 3]
    R_found = np.array([estimate.state.R_world_imu for estimate in estimates])
    p_found = np.array([estimate.state.p_world_imu for estimate in estimates])
    to_world = R_found[0] @ R[0].T
    distance = np.linalg.norm(p_found - p_found[0] - (p - p[0]) @ to_world.T, axis=1)
    angle = np.linalg.norm(so3.log(np.swapaxes(to_world @ R, 1, 2) @ R_found), axis=1)
    return distance, angle


@pytest.mark.slow
@pytest.mark.parametrize(("begin_s", "most_m", "most_deg"), [(0.0, 0.03, 0.5), (4.0, 0.05, 1.0)])
def test_a_walk_is_followed_to_centimetres(begin_s: float, most_m: float, most_deg: float) -> None:
    """From rest, and from the middle of a step, where what the first scan was undistorted with places the world."""
    simulation = simulate("walk", duration_s=8.0, lidar=SPARSE)
    scans = [scan for scan in _scans(simulation) if scan.start_ns >= simulation.start_ns + begin_s * 1e9]
    odometry = LidarOdometry()
    estimates = _run(odometry, scans)
    assert len(estimates) == len(scans)
    distance, angle = _errors(simulation, estimates)
    assert distance.max() < most_m
    assert np.degrees(angle.max()) < most_deg
    assert {estimate.status for estimate in estimates} == {"ok"}
    assert odometry.contradiction is None
    sigma = np.array([np.sqrt(np.trace(estimate.pose_covariance[3:, 3:])) for estimate in estimates])
    assert (distance[1:] < 5.0 * sigma[1:]).all()


def test_a_gap_begins_anew_and_is_said() -> None:
    simulation = simulate("walk", duration_s=8.0, lidar=SPARSE)
    scans = _scans(simulation)
    odometry = LidarOdometry()
    estimates = _run(odometry, scans[:30] + scans[50:])
    assert odometry.counters["scan jumping ahead in time"] == 10  # until the jump has proved to be the time
    assert odometry.contradiction is not None and "no scan for 3.1 s, longer than 1 s" in odometry.contradiction
    begun = estimates[30]
    assert begun.status == "lost" and any("do not belong together" in text for text in begun.warnings)
    assert np.sqrt(begun.pose_covariance.diagonal()).min() > 1.0
    np.testing.assert_allclose(begun.state.p_world_imu, estimates[29].state.p_world_imu)


def test_a_corridor_is_said_to_be_open() -> None:
    simulation = simulate("corridor", duration_s=8.0, lidar=SPARSE)
    odometry = LidarOdometry()
    estimates = _run(odometry, _scans(simulation))
    assert sum(estimate.status != "ok" for estimate in estimates) > 0.5 * len(estimates)
    assert odometry.contradiction is not None and "left a direction open" in odometry.contradiction


def test_goes_on_from_a_snapshot_with_the_same_bits(tmp_path: Path) -> None:
    scans = _scans(simulate("walk", duration_s=4.0, lidar=SPARSE))
    whole, halted = LidarOdometry(), LidarOdometry()
    expected = _run(whole, scans)
    _run_before = [estimate for scan in scans[:25] for estimate in halted.push_scan(scan)]
    write_state(tmp_path / "state", halted.snapshot())
    resumed = LidarOdometry()
    resumed.restore(read_state(tmp_path / "state"))
    rest = _run(resumed, scans[25:])
    assert len(_run_before) + len(rest) == len(expected)
    for estimate, other in zip(rest, expected[len(_run_before) :], strict=True):
        assert np.array_equal(estimate.state.pack(), other.state.pack())
        assert np.array_equal(estimate.pose_covariance, other.pose_covariance)


def test_the_result_does_not_depend_on_the_threads() -> None:
    scans = _scans(simulate("walk", duration_s=2.0, lidar=SPARSE))
    one, two = (_run(LidarOdometry(LidarOdometryConfig(threads=threads)), scans) for threads in (1, 2))
    assert all(np.array_equal(a.state.pack(), b.state.pack()) for a, b in zip(one, two, strict=True))


def test_settings_of_an_imu_are_refused() -> None:
    with pytest.raises(InputError, match="settings of a LiDAR alone – got gyro_noise, max_imu_gap – leave them out"):
        LidarOdometry(LioConfig(gyro_noise=0.001, max_imu_gap=0.3))
    alone = LidarOdometry(LioConfig(max_points=1000, threads=2)).config
    assert alone == LidarOdometryConfig(max_points=1000, threads=2) and type(alone) is LidarOdometryConfig


def _of_noise(begin_ns: int, count: int) -> list[Scan]:
    random = np.random.default_rng(0)
    return [
        Scan(
            random.normal(0, 10, (2000, 3)).astype(np.float32),
            np.linspace(0, 99_000_000, 2000).astype(np.int64) + start_ns,
            None,
            start_ns,
            start_ns + 99_000_000,
        )
        for start_ns in (begin_ns + k * 100_000_000 for k in range(count))
    ]


def test_scans_that_find_no_start_after_a_gap_are_none_before_the_path() -> None:
    """A run said of them that path and map begin so late, 0.0 s after the first scan."""
    simulation = simulate("walk", duration_s=3.0, lidar=SPARSE)
    scans, odometry = _scans(simulation), LidarOdometry()
    estimates = _run(odometry, [*scans, *_of_noise(simulation.end_ns + 2_000_000_000, 12)])
    assert len(estimates) == len(scans) and odometry.contradiction is not None
    after = {"scan jumping ahead in time": 10, "scan after a gap, before another start could be found": 2}
    assert odometry.counters == after


def test_scans_that_cannot_be_used_are_counted() -> None:
    odometry, noise = LidarOdometry(), _of_noise(0, 12)
    assert _run(odometry, [noise[0], *noise]) == []
    assert odometry.start is None and odometry.start_problem is not None
    assert odometry.counters["scan with a repeated time"] == 1
    assert odometry.counters["scan before a start could be found"] == 12


def test_scans_apart_that_do_not_fit_are_told_and_cover_the_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    """With 16 rings from rest a street tilted by a degree within a second, each scan `ok`: scans apart show it."""
    off, known = np.array([0.0, 0.02, 0.0, 0.1, 0.0, 0.0]), np.diag(np.repeat([1e-3, 0.01], 3) ** 2)
    scans = _scans(simulate("walk", duration_s=3.6, lidar=SPARSE))
    plain = _run(LidarOdometry(), scans)
    monkeypatch.setattr(long_baseline, "register_to", lambda *_: (off, known))
    estimates = _run(LidarOdometry(), scans)
    texts = [text for estimate in estimates for text in estimate.warnings]
    assert texts and all("by 10.0 cm and 1.15 deg" in text and "T_imu_lidar" not in text for text in texts)
    assert not any(estimate.warnings for estimate in plain)
    widened = estimates[-1].pose_covariance - plain[-1].pose_covariance
    assert widened[3, 3] > len(texts) * 0.9 * off[3] ** 2
    assert widened[1, 1] > len(texts) * 0.9 * off[1] ** 2
