"""A first run over the beginning makes more of a mounting that nobody has given, and never less."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.formats.trajectory import read_trajectory
from boxplus.manifolds import so3
from boxplus.recordings.recording import Recording
from boxplus.runs.lidar_inertial.extrinsic import choose_extrinsic
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.runs.lidar_inertial.rehearsal import rehearse
from boxplus.simulation import Simulation, SpinningLidar, make_scenario, simulate
from boxplus.simulation.live_recording import as_recording
from boxplus.systems.lidar_inertial_odometry.config import LioConfig

LIDAR = SpinningLidar(azimuth_steps=300)


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


def test_the_mounting_at_its_end_is_better_and_as_good_as_it_claims(flight: Simulation) -> None:
    config = _guess(flight.T_imu_lidar, 1.0, 0.1, seed=3)
    found = rehearse(as_recording(flight), config)
    assert found is not None and config.T_imu_lidar is not None
    before = np.array(config.T_imu_lidar)[:3, 3] - flight.T_imu_lidar[:3, 3]
    after = found.T_imu_lidar[:3, 3] - flight.T_imu_lidar[:3, 3]
    assert np.linalg.norm(after) < 0.3 * np.linalg.norm(before)
    assert (np.abs(after) < 3.0 * found.std_m).all()
    turn = np.degrees(np.linalg.norm(so3.log(found.T_imu_lidar[:3, :3].T @ flight.T_imu_lidar[:3, :3])))
    assert turn < 3.0 * found.std_deg.max() < 1.0
    assert found.seconds > 5.0


def test_what_finds_no_start_says_nothing(flight: Simulation) -> None:
    scans = list(as_recording(flight))[:4]
    assert rehearse(scans, LioConfig()) is None


def test_a_run_that_the_sensors_contradict_says_nothing(flight: Simulation) -> None:
    T = flight.T_imu_lidar.copy()
    T[:3, :3] = T[:3, :3] @ so3.exp(np.array([0.0, 1.0, 0.0]))
    config = LioConfig(T_imu_lidar=tuple(map(tuple, T.tolist())), extrinsic_estimation="gated")
    assert rehearse(as_recording(flight), config) is None


def test_a_run_without_a_mounting_begins_with_what_the_first_one_found(flight: Simulation, tmp_path) -> None:
    recording: Recording = as_recording(flight)
    recording.info.T_imu_lidar = None
    extrinsic = choose_extrinsic(recording, LioConfig())
    assert "in a first run over" in extrinsic.text
    assert extrinsic.sigma is not None and extrinsic.sigma[1] < 0.05
    decided = choose_extrinsic(recording, LioConfig(extrinsic_estimation="off"))
    assert "in a first run over" not in decided.text
    assert decided.sigma is not None and decided.sigma[1] >= extrinsic.sigma[1]

    def worst(folder: str, begun_with: object) -> float:
        run_odometry(recording, tmp_path / folder, extrinsic=begun_with)
        path = read_trajectory(tmp_path / folder / "trajectory.csv")
        true = flight.ground_truth(path.time_ns)
        return float(np.linalg.norm((path.p - path.p[0]) - (true.p_world_imu - true.p_world_imu[0]), axis=1).max())

    assert worst("twice", extrinsic) < worst("once", replace(decided, refine=True))
