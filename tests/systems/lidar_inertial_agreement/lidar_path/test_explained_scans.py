"""A path that rides with the pattern of its points is told from one that explains them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import ImuModel, RosetteLidar, Scenario, Simulation, SpinningLidar
from boxplus.simulation.motions import manoeuvres, trajectories
from boxplus.simulation.worlds import sites, worlds
from boxplus.simulation.worlds.world import World
from boxplus.systems.lidar_inertial_agreement.agreement import compare_sensors, gyro_guesses
from boxplus.systems.lidar_inertial_agreement.lidar_path.backwards import lidar_path_backwards, surer_path
from boxplus.systems.lidar_inertial_agreement.lidar_path.explained_scans import expected_path, explained_scans
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import lidar_path
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import with_cells_for_all
from boxplus.systems.lidar_inertial_agreement.rotation import compare_rotations
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, data, handheld, true_path, true_twists

COLUMNS = SpinningLidar(channels=64, azimuth_steps=62, vertical_fov_deg=(-45.0, 45.0))
"""Its columns lie six degrees apart: at ten metres a metre, along a column a sixth of that."""
RINGS = SpinningLidar(channels=32, azimuth_steps=600, vertical_fov_deg=(-25.0, 15.0))


@lru_cache(maxsize=1)
def crossing() -> tuple[Simulation, list[Scan]]:
    """A platform that crosses a hall with 3 m/s, for three seconds."""
    motion = manoeuvres.constant_velocity(3.5, (-5.0, 1.0, 1.5), (3.0, 0.0, 0.0), np.eye(3))
    simulation = Simulation(Scenario("columns", worlds.hall(seed=1), motion, COLUMNS, ImuModel()), 1, 3.0)
    return simulation, data(simulation)[0]


def frozen(path: LidarPath) -> LidarPath:
    """A path that has not left its first pose."""
    K = len(path)
    R, p = np.tile(path.R_path_lidar[:1], (K, 1, 1)), np.tile(path.p_path_lidar[:1], (K, 1))
    return LidarPath(path.time_ns, R, p, path.information, path.segment, path.weak, path.misfit, path.cost, path.failed)


def test_an_expected_path_is_where_the_estimator_believes_that_the_lidar_was() -> None:
    simulation, scans = crossing()
    path = true_path(simulation, scans)
    found = expected_path(frozen(path), scans, true_twists(simulation, scans))
    moved = found.p_path_lidar - found.p_path_lidar[0]
    R = path.R_path_lidar[0]
    np.testing.assert_allclose(moved, (path.p_path_lidar - path.p_path_lidar[0]) @ R, atol=1e-6)
    np.testing.assert_allclose(found.R_path_lidar, R.T @ path.R_path_lidar, atol=1e-9)
    assert np.array_equal(found.time_ns, path.time_ns)
    none = path.part(np.zeros(len(path), dtype=bool))
    assert len(expected_path(none, scans, true_twists(simulation, scans))) == 0


def test_a_path_that_stays_while_the_platform_moves_explains_less() -> None:
    simulation, scans = crossing()
    path, expected = true_path(simulation, scans), true_twists(simulation, scans)
    explained = explained_scans(path, scans, expected, CONFIG)
    assert explained.by_path
    assert explained.astray is None
    explained = explained_scans(frozen(path), scans, expected, CONFIG)
    assert not explained.by_path
    assert explained.astray is None


@pytest.mark.parametrize("factor", [0.0, 0.5, 1.5])
def test_an_estimator_that_is_wrong_is_called_astray_and_does_not_discredit_the_path(factor: float) -> None:
    simulation, scans = crossing()
    explained = explained_scans(true_path(simulation, scans), scans, true_twists(simulation, scans, factor), CONFIG)
    assert explained.by_path
    assert explained.astray is not None
    assert f"moved by {3.0 * 2.8:.1f} m" in explained.astray.text
    assert f"the estimate moved by {factor * 3.0 * 2.8:.1f} m" in explained.astray.text


@lru_cache(maxsize=2)
def driving(place: str) -> tuple[Simulation, list[Scan]]:
    """Along a street at 15 m/s, or through a wood at a walk."""
    world, speed = {"street": (sites.street(seed=1), 15.0), "wood": (sites.forest(seed=2), 1.5)}[place]
    motion = manoeuvres.constant_velocity(3.5, (-20.0, 0.0, 1.8), (speed, 0.0, 0.0), np.eye(3))
    simulation = Simulation(Scenario(place, world, motion, RINGS, ImuModel()), 1, 3.0)
    return simulation, data(simulation)[0]


@pytest.mark.parametrize("place", ["street", "wood"])
@pytest.mark.parametrize("factor", [2.0, -1.0, 3.0])
def test_a_path_at_rest_under_which_much_has_changed_calls_no_estimate_astray(place: str, factor: float) -> None:
    """Two fifths of the points are off under it, and more still under the estimate."""
    simulation, scans = driving(place)
    wrong = true_twists(simulation, scans, factor)
    assert explained_scans(frozen(true_path(simulation, scans)), scans, wrong, CONFIG).astray is None


@pytest.mark.parametrize("place", ["street", "wood"])
@pytest.mark.parametrize("factor", [0.0, 0.5, 1.5])
def test_a_path_in_motion_does_however_much_comes_newly_into_view(place: str, factor: float) -> None:
    """A third of the points are off under the true path; at 0 the estimate rests."""
    simulation, scans = driving(place)
    wrong = true_twists(simulation, scans, factor)
    assert explained_scans(true_path(simulation, scans), scans, wrong, CONFIG).astray is not None


@pytest.mark.slow
@pytest.mark.parametrize(
    "place", [sites.street(seed=1), sites.forest(seed=3), worlds.hall(seed=3)], ids=["street", "wood", "hall"]
)
def test_rain_at_rest_excuses_no_estimate_that_runs_away(place: World) -> None:
    random, rest = np.random.default_rng(0), trajectories.at_rest(4.5, (0.0, 0.0, 1.8))
    simulation = Simulation(Scenario("rain", place, rest, RINGS, ImuModel()), 1, 4.0)
    scans = data(simulation)[0]
    path = true_path(simulation, scans)
    for scan in scans:
        hit = random.uniform(size=len(scan)) < 0.3
        scan.p_lidar[hit] *= random.uniform(0.1, 0.9, (int(hit.sum()), 1)).astype(np.float32)
    away = [(np.zeros(3), np.array([8.0, 0.0, 0.0])) for _ in scans]
    assert explained_scans(path, scans, away, CONFIG).astray is not None


def test_where_the_scene_does_not_show_the_path_no_estimate_is_astray() -> None:
    simulation, scans = crossing()
    path = replace(true_path(simulation, scans), weak=np.ones(len(scans), dtype=bool))
    assert explained_scans(path, scans, true_twists(simulation, scans, 0.5), CONFIG).astray is None


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_narrow_view_that_turns_away_does_not_speak_for_a_path_that_stays(seed: int) -> None:
    """The last scans see what the first ones could not: laid upon these as if nothing had turned, more of them find surfaces."""
    turn = manoeuvres.constant_turn(3.5, (1.0, 0.0, 1.5), 0.5, np.radians(40.0))
    simulation = Simulation(Scenario("turn", worlds.room(seed=seed), turn, RosetteLidar(), ImuModel()), seed, 3.0)
    scans = data(simulation)[0]
    path, expected = true_path(simulation, scans), true_twists(simulation, scans)
    explained = explained_scans(frozen(path), scans, expected, CONFIG)
    assert explained.astray is None


def test_of_a_path_forwards_and_one_backwards_the_better_one_is_taken() -> None:
    simulation = handheld(0)
    scans = data(simulation)[0][:25]
    truth, back = true_path(simulation, scans), lidar_path_backwards(scans, CONFIG)
    chosen = surer_path(frozen(truth), scans, CONFIG, ())
    assert chosen is not None
    np.testing.assert_allclose(chosen.p_path_lidar, back.p_path_lidar)
    assert surer_path(truth, scans, CONFIG, ()) is truth


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3])
def test_sways_after_a_rest_show_the_gyroscopes_scale(seed: int) -> None:
    """The pattern of the rest, and turns that change within a scan, make a first path turn too little or too much."""
    lidar = SpinningLidar(channels=128, azimuth_steps=256, vertical_fov_deg=(-45.0, 45.0))
    walk = trajectories.walk([(-16.0, -7.0), (16.0, -7.0)], 1.2, 1.5, 2.5, seed)
    simulation = Simulation(Scenario("sway", worlds.hall(seed=seed), walk, lidar, ImuModel()), seed, 6.0)
    scans, imu = data(simulation)
    guesses = gyro_guesses(imu, simulation.T_imu_lidar[:3, :3])
    first = compare_rotations(lidar_path(scans, with_cells_for_all(scans, CONFIG), guesses), imu)
    rotation = compare_sensors(scans, imu, CONFIG, T_declared=simulation.T_imu_lidar).rotation
    assert first is not None and rotation is not None
    assert abs(first.scale - 1.0) > 0.06
    assert abs(rotation.scale - 1.0) < 0.02


def test_where_two_paths_differ_and_scans_do_not_decide_neither_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = handheld(0)
    scans = data(simulation)[0][:25]
    monkeypatch.setattr("boxplus.systems.lidar_inertial_agreement.lidar_path.backwards.other_explains_better", lambda *_: False)
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
