"""The ground that a platform drives along: a mounting that makes it steeper than any road, and slopes that are none of its."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.simulation import ImuModel, Scenario, Simulation, SpinningLidar, mounting
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.worlds import sites
from boxplus.simulation.worlds.world import World, box, rectangle
from boxplus.systems.lidar_inertial_agreement.agreement import compare_sensors
from boxplus.systems.lidar_inertial_agreement.hypotheses import contradictions
from boxplus.systems.lidar_inertial_agreement.planes.ground_lean import GroundLean, drives, ground_lean
from boxplus.systems.lidar_inertial_agreement.planes.surroundings import Surroundings, surroundings_of
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, data, true_path, true_twists

LIDAR = SpinningLidar(channels=24, azimuth_steps=180, vertical_fov_deg=(-30.0, 10.0))
UP = np.array([0.0, 0.0, 1.0])


def driving(world: World, speed: float, height: float = 1.8, y: float = 0.0) -> Simulation:
    """Straight on at a constant speed and attitude, for 2.6 s."""
    T = mounting(3.0, -2.0, 30.0, (0.1, 0.0, 0.2))
    motion = manoeuvres.constant_velocity(3.0, (-1.5 * speed, y, height), (speed, 0.0, 0.0), np.eye(3))
    return Simulation(Scenario("driving", world, motion, LIDAR, ImuModel(), T), 1, 2.6)


def around(simulation: Simulation, R_off: NDArray[np.float64] | None = None) -> Surroundings:
    scans, imu = data(simulation)
    R = simulation.T_imu_lidar[:3, :3] if R_off is None else R_off @ simulation.T_imu_lidar[:3, :3]
    found = surroundings_of(true_path(simulation, scans), scans, imu, R, CONFIG)
    assert found is not None
    return found


def bank(degrees: float, *, foot: bool) -> World:
    """A slope along x, 30 m wide, that begins at y = −15 m; with level ground at its foot, or nothing there."""
    slope = so3.exp(np.array([np.deg2rad(degrees), 0.0, 0.0]))
    rise = np.tan(np.deg2rad(degrees))
    solids = [rectangle((0.0, 0.0, 15.0 * rise), (300.0, 30.0 / np.cos(np.deg2rad(degrees))), slope)]
    for x in range(-60, 60, 7):
        solids.append(box((x, 3.0, 18.0 * rise), (0.5, 0.5, 2.0)))
    if foot:
        solids.append(rectangle((0.0, -55.0, 0.0), (300.0, 80.0)))
    return World(solids)


@pytest.mark.parametrize(("degrees", "named"), [(0.0, False), (12.0, False), (25.0, True), (45.0, True)])
def test_a_road_may_climb_but_no_more_than_roads_do(degrees: float, named: bool) -> None:
    """By a constant speed on a straight road neither turns nor accelerations show a mounting that nods."""
    simulation = driving(sites.highway(300.0, seed=3), 15.0)
    scans, imu = data(simulation)
    T = simulation.T_imu_lidar.copy()
    T[:3, :3] = so3.exp(np.array([0.0, np.deg2rad(degrees), 0.0])) @ T[:3, :3]
    agreement = compare_sensors(scans, imu, CONFIG, T_declared=T, expected=true_twists(simulation, scans))
    assert agreement.ground is not None
    assert np.rad2deg(agreement.ground.lean) == pytest.approx(degrees, abs=1.0)
    assert agreement.ground.height == pytest.approx(2.0, abs=0.1) and agreement.ground.speed == pytest.approx(15.0, abs=0.3)
    found = contradictions(agreement, T)
    assert [finding.cause for finding in found] == (["extrinsic"] if named else [])
    assert not named or f"leans by {degrees:.0f} deg" in found[0].text


@pytest.mark.parametrize("speed", [2.0, 3.5])
def test_what_is_slow_or_goes_not_far_may_be_on_any_slope(speed: float) -> None:
    found = around(driving(sites.highway(300.0, seed=3), speed))
    assert not drives(found.path)
    assert ground_lean(found) is None


def test_level_ground_beside_a_slope_clears_the_mounting() -> None:
    simulation = driving(bank(30.0, foot=True), 6.0, height=3.0 * np.tan(np.deg2rad(30.0)) + 2.5, y=-12.0)
    found = around(simulation)
    leans = [np.rad2deg(np.arccos(abs(axis[2]))) for axis, _ in found.directions]
    assert min(leans) < 2.0 and any(abs(lean - 30.0) < 2.0 for lean in leans)
    assert ground_lean(found) is None


def test_a_slope_cannot_be_told_from_a_mounting_without_anything_level() -> None:
    found = ground_lean(around(driving(bank(30.0, foot=False), 6.0, height=15.0 * np.tan(np.deg2rad(30.0)) + 2.5)))
    assert found is not None and np.rad2deg(found.lean) == pytest.approx(30.0, abs=1.0)


@pytest.mark.parametrize("beside", [1.0, 3.0])
def test_a_bank_beside_water_is_not_what_a_boat_goes_on(beside: float) -> None:
    assert ground_lean(around(driving(bank(40.0, foot=False), 6.0, height=2.5, y=-15.0 - beside))) is None


def test_an_upright_plane_denies_a_lean_that_would_tilt_it() -> None:
    found = around(driving(sites.highway(300.0, seed=3), 15.0), so3.exp(np.array([0.0, np.deg2rad(30.0), 0.0])))
    assert found.directions[0][1] > 0.4
    (ground, share), up = found.directions[0], found.up
    level = np.cross(up, ground)
    beside, before = level / np.linalg.norm(level), np.cross(up, level) / np.linalg.norm(level)
    for other, denied in ((beside, False), (before, True), (up, True)):
        answer = ground_lean(replace(found, directions=[(ground, share), (other, 0.2)]))
        assert (answer is None) == denied


def test_the_lean_is_the_lesser_of_both_with_and_without_the_acceleration() -> None:
    """A car that brakes leans by the accelerometer alone, and one whose path is too long leans by the path."""
    found = around(driving(sites.highway(300.0, seed=3), 15.0))
    leaning = so3.exp(np.array([0.0, np.deg2rad(30.0), 0.0])) @ UP
    for up, force, degrees in ((UP, 9.8 * leaning, 0.0), (leaning, 9.8 * UP, 0.0), (leaning, 9.8 * leaning, 30.0)):
        answer = ground_lean(replace(found, up=up, force=force, directions=found.directions[:1]))
        assert answer is not None and np.rad2deg(answer.lean) == pytest.approx(degrees, abs=0.5)


def test_what_changes_its_height_does_not_drive() -> None:
    found = around(driving(sites.highway(300.0, seed=3), 15.0))
    rising = np.linspace(0.0, 1.0, len(found.path))[:, None] * UP
    assert isinstance(ground_lean(found), GroundLean)
    assert ground_lean(replace(found, path=replace(found.path, p_path_lidar=found.path.p_path_lidar + rising))) is None
