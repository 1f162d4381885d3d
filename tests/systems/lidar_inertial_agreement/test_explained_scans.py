"""A path that rides with the pattern of its points is told from one that explains them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.sensors.scan import Scan
from boxplus.simulation import ImuModel, Scenario, Simulation, SpinningLidar
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.worlds import worlds
from boxplus.systems.lidar_inertial_agreement.agreement import gyro_guesses
from boxplus.systems.lidar_inertial_agreement.backwards import lidar_path_backwards, surer_path
from boxplus.systems.lidar_inertial_agreement.explained_scans import explains_scans
from boxplus.systems.lidar_inertial_agreement.lidar_motion import LidarPath, Twist, lidar_path
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, data, handheld

COLUMNS = SpinningLidar(channels=64, azimuth_steps=62, vertical_fov_deg=(-45.0, 45.0))
"""Its columns lie six degrees apart: at ten metres a metre, along a column a sixth of that."""


@lru_cache(maxsize=1)
def crossing() -> tuple[Simulation, list[Scan]]:
    """A platform that crosses a hall with 3 m/s, for three seconds."""
    motion = manoeuvres.constant_velocity(3.5, (-5.0, 1.0, 1.5), (3.0, 0.0, 0.0), np.eye(3))
    simulation = Simulation(Scenario("columns", worlds.hall(seed=1), motion, COLUMNS, ImuModel()), 1, 3.0)
    return simulation, data(simulation)[0]


def true_path(simulation: Simulation, scans: list[Scan]) -> LidarPath:
    time_ns = np.array([(scan.start_ns + scan.end_ns) // 2 for scan in scans])
    R, p = true_poses(simulation, time_ns)
    K = len(scans)
    flags, zeros = np.zeros(K, dtype=bool), np.zeros(K, dtype=np.int64)
    return LidarPath(time_ns, R, p, np.tile(1e6 * np.eye(6), (K, 1, 1)), zeros, flags, np.zeros(K), np.zeros(K), 0)


def true_poses(simulation: Simulation, time_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    motion, T = simulation.ground_truth(time_ns), simulation.T_imu_lidar
    R = motion.R_world_imu @ T[:3, :3]
    return R, motion.p_world_imu + motion.R_world_imu @ T[:3, 3]


def true_twists(simulation: Simulation, scans: list[Scan], factor: float = 1.0) -> list[Twist]:
    found = []
    for scan in scans:
        R, p = true_poses(simulation, np.array([scan.start_ns, scan.end_ns]))
        seconds = (scan.end_ns - scan.start_ns) * 1e-9
        found.append((factor * so3.log(R[0].T @ R[1]) / seconds, factor * R[1].T @ (p[1] - p[0]) / seconds))
    return found


def frozen(path: LidarPath) -> LidarPath:
    """A path that has not left its first pose."""
    K = len(path)
    R, p = np.tile(path.R_path_lidar[:1], (K, 1, 1)), np.tile(path.p_path_lidar[:1], (K, 1))
    return LidarPath(path.time_ns, R, p, path.information, path.segment, path.weak, path.misfit, path.cost, path.failed)


def test_a_path_that_stays_while_the_platform_moves_explains_less() -> None:
    simulation, scans = crossing()
    path, expected = true_path(simulation, scans), true_twists(simulation, scans)
    assert explains_scans(path, scans, expected, CONFIG)
    assert not explains_scans(frozen(path), scans, expected, CONFIG)


@pytest.mark.parametrize("factor", [0.0, 0.5, 1.3])
def test_an_estimator_that_is_wrong_does_not_discredit_a_path_that_is_right(factor: float) -> None:
    simulation, scans = crossing()
    assert explains_scans(true_path(simulation, scans), scans, true_twists(simulation, scans, factor), CONFIG)


def test_of_a_path_forwards_and_one_backwards_the_better_one_is_taken() -> None:
    simulation = handheld(0)
    scans = data(simulation)[0][:25]
    truth, back = true_path(simulation, scans), lidar_path_backwards(scans, CONFIG)
    chosen = surer_path(frozen(truth), scans, CONFIG, ())
    assert chosen is not None
    np.testing.assert_allclose(chosen.p_path_lidar, back.p_path_lidar)
    assert surer_path(truth, scans, CONFIG, ()) is truth


def test_where_two_paths_differ_and_scans_do_not_decide_neither_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = handheld(0)
    scans = data(simulation)[0][:25]
    monkeypatch.setattr("boxplus.systems.lidar_inertial_agreement.backwards.other_explains_better", lambda *_: False)
    assert surer_path(frozen(true_path(simulation, scans)), scans, CONFIG, ()) is None


@pytest.mark.parametrize("seed", [0, 1])
def test_backwards_is_the_same_motion(seed: int) -> None:
    simulation = handheld(seed)
    scans, imu = data(simulation)
    scans = scans[:25]
    guesses = gyro_guesses(imu, simulation.T_imu_lidar[:3, :3])
    forwards, backwards = lidar_path(scans, CONFIG, guesses), lidar_path_backwards(scans, CONFIG, guesses)
    np.testing.assert_array_equal(backwards.time_ns, forwards.time_ns)
    np.testing.assert_allclose(backwards.R_path_lidar[0], np.eye(3), atol=1e-12)
    angle = np.linalg.norm(so3.log(np.swapaxes(forwards.R_path_lidar, 1, 2) @ backwards.R_path_lidar), axis=1)
    assert angle.max() < 0.02
    assert np.abs(forwards.p_path_lidar - backwards.p_path_lidar).max() < 0.2  # of 2.5 m, where columns lie far apart
    assert not backwards.information[0].any() and np.linalg.eigvalsh(backwards.information[1:]).min() > -1e-6
