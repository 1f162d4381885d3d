"""A first run over the beginning makes more of a mounting that nobody has given, and never less."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from boxplus.formats.trajectory import read_trajectory
from boxplus.manifolds import so3
from boxplus.recordings.recording import Recording
from boxplus.runs.lidar_inertial.extrinsic import choose_extrinsic
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.runs.lidar_inertial.rehearsal import rehearse
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import Simulation, SpinningLidar, make_scenario, simulate
from boxplus.simulation.live_recording import as_recording
from boxplus.systems.lidar_inertial_odometry.config import LioConfig

LIDAR = SpinningLidar(azimuth_steps=300)


def _never() -> bool:
    return False


def _guess(T: np.ndarray, rotation_deg: float, translation_m: float, seed: int) -> LioConfig:
    """A mounting that is off by as much as is said."""
    random = np.random.default_rng(seed)
    off = T.copy()
    off[:3, :3] = T[:3, :3] @ so3.exp(np.radians(rotation_deg) * random.normal(size=3))
    off[:3, 3] += translation_m * random.normal(size=3)
    return LioConfig(
        T_imu_lidar=tuple(map(tuple, off.tolist())),
        extrinsic_estimation="gated",
        extrinsic_rotation_sigma_deg=rotation_deg,
        extrinsic_translation_sigma=translation_m,
    )


@pytest.fixture(scope="module", params=[0, 1])
def flight(request: pytest.FixtureRequest) -> Simulation:
    return simulate(make_scenario("stress_fast", seed=request.param), duration_s=12.0, lidar=LIDAR)


@pytest.mark.slow
def test_the_mounting_at_its_end_is_better_and_as_good_as_it_claims(flight: Simulation) -> None:
    config = _guess(flight.T_imu_lidar, 1.0, 0.1, seed=3)
    found = rehearse(as_recording(flight), config, _never)
    assert not isinstance(found, str) and config.T_imu_lidar is not None
    before = np.array(config.T_imu_lidar)[:3, 3] - flight.T_imu_lidar[:3, 3]
    after = found.T_imu_lidar[:3, 3] - flight.T_imu_lidar[:3, 3]
    assert np.linalg.norm(after) < 0.3 * np.linalg.norm(before)
    assert (np.abs(after) < 3.0 * found.std_m).all()
    turn = np.degrees(np.linalg.norm(so3.log(found.T_imu_lidar[:3, :3].T @ flight.T_imu_lidar[:3, :3])))
    assert turn < 3.0 * found.std_deg.max() < 1.0
    assert found.seconds > 5.0


def test_what_finds_no_start_says_so(flight: Simulation) -> None:
    scans = list(as_recording(flight))[:4]
    assert rehearse(scans, LioConfig(), _never) == "it found no start"


@pytest.mark.slow
def test_a_run_that_the_sensors_contradict_says_so(flight: Simulation) -> None:
    T = flight.T_imu_lidar.copy()
    T[:3, :3] = T[:3, :3] @ so3.exp(np.array([0.0, 1.0, 0.0]))
    config = LioConfig(T_imu_lidar=tuple(map(tuple, T.tolist())), extrinsic_estimation="gated")
    found = rehearse(as_recording(flight), config, _never)
    assert isinstance(found, str)
    assert "lost" in found or "not to be trusted" in found


def test_it_can_be_stopped_and_leaves_an_error_to_the_run(flight: Simulation) -> None:
    asked: list[int] = []

    def at_the_fifth() -> bool:
        asked.append(1)
        return len(asked) == 5

    assert rehearse(as_recording(flight), LioConfig(), at_the_fifth) == "it was interrupted"
    assert len(asked) == 5
    scan = next(event for event in as_recording(flight) if isinstance(event, Scan))
    damaged = replace(scan, time_ns=scan.time_ns + 10**12)
    found = rehearse([damaged], LioConfig(), _never)
    assert isinstance(found, str) and found.startswith("it ended with an error")


def test_it_reads_a_minute_of_events_even_where_nothing_starts() -> None:
    read: list[int] = []

    def samples() -> Iterator[ImuSamples]:
        for second in range(3600):
            read.append(second)
            yield ImuSamples(np.array([second * 10**9]), np.zeros((1, 3)), np.zeros((1, 3)))

    assert rehearse(samples(), LioConfig(), _never) == "it found no start"
    assert len(read) < 70


@pytest.mark.slow
def test_a_run_without_a_mounting_begins_with_what_the_first_one_found(flight: Simulation, tmp_path: Path) -> None:
    recording: Recording = as_recording(flight)
    recording.info.T_imu_lidar = None
    extrinsic = choose_extrinsic(recording, LioConfig())
    assert "in a first run over" in extrinsic.how and extrinsic.text.startswith(f"{extrinsic.how}: ")
    assert extrinsic.sigma is not None and extrinsic.sigma[1] < 0.05
    stopped = choose_extrinsic(recording, LioConfig(), should_stop=lambda: True)
    assert stopped.text.endswith("a first run over the beginning made no more of it: it was interrupted")
    assert stopped.text in stopped.warning
    decided = choose_extrinsic(recording, LioConfig(extrinsic_estimation="off"))
    assert "in a first run over" not in decided.text
    assert decided.sigma is not None and decided.sigma[1] >= extrinsic.sigma[1]

    def worst(folder: str, begun_with: object) -> float:
        run_odometry(recording, tmp_path / folder, extrinsic=begun_with)
        path = read_trajectory(tmp_path / folder / "trajectory.csv")
        true = flight.ground_truth(path.time_ns)
        return float(np.linalg.norm((path.p - path.p[0]) - (true.p_world_imu - true.p_world_imu[0]), axis=1).max())

    assert worst("twice", extrinsic) < worst("once", replace(decided, refine=True))
