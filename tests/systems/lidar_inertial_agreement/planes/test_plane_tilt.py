"""Gravity against planes: they show a mounting that no motion shows, and nothing is claimed where they may be tilted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import Fault, ImuModel, Scenario, Simulation, SpinningLidar, faults, mounting
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.worlds import sites, worlds
from boxplus.simulation.worlds.world import World
from boxplus.systems.lidar_inertial_agreement.agreement import compare_sensors
from boxplus.systems.lidar_inertial_agreement.hypotheses import contradictions
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import lidar_path
from boxplus.systems.lidar_inertial_agreement.planes.plane_tilt import PlaneTilt, plane_tilt
from boxplus.systems.lidar_inertial_agreement.planes.surroundings import surroundings_of
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, data

LIDAR = SpinningLidar(channels=24, azimuth_steps=120)


def straight(
    world: World, seed: int, speed: float = 0.5, T: NDArray[np.float64] | None = None, imu: ImuModel | None = None
) -> Simulation:
    """Straight on at a constant velocity and attitude: neither gyroscope nor accelerometer shows the mounting."""
    random = np.random.default_rng(seed)
    if T is None:
        T = mounting(random.uniform(-15.0, 15.0), random.uniform(-15.0, 15.0), random.uniform(-180.0, 180.0), (0.1, 0.0, 0.1))
    attitude = manoeuvres.level(random.uniform(-np.pi, np.pi), *random.uniform(-0.1, 0.1, 2))
    motion = manoeuvres.constant_velocity(3.0, np.array([-1.0, 0.2, 1.5]), (speed, 0.0, 0.0), attitude)
    return Simulation(Scenario("straight", world, motion, LIDAR, imu or ImuModel(), T), seed, 2.6)


def tilt_of(simulation: Simulation, T: NDArray[np.float64], fault: Fault | None = None) -> PlaneTilt | None:
    scans, imu = data(simulation, fault)
    around = surroundings_of(lidar_path(scans, CONFIG), scans, imu, T[:3, :3], CONFIG)
    return None if around is None else plane_tilt(around)


def leaning(simulation: Simulation, axis: tuple[float, float, float], degrees: float) -> NDArray[np.float64]:
    """The mounting under which the world seems turned about one of its own axes."""
    R = simulation.ground_truth(np.array([simulation.start_ns])).R_world_imu[0]
    T = simulation.T_imu_lidar.copy()
    T[:3, :3] = R.T @ so3.exp(np.deg2rad(degrees) * np.array(axis)) @ R @ T[:3, :3]
    return T


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("degrees", [0.0, 7.0, 15.0])
def test_a_room_shows_how_far_a_mounting_is_tilted(seed: int, degrees: float) -> None:
    simulation = straight(worlds.room(seed=seed), seed)
    found = tilt_of(simulation, leaning(simulation, (np.cos(seed), np.sin(seed), 0.0), degrees))
    assert found is not None and found.directions == 3
    assert abs(np.rad2deg(found.tilt) - degrees) < 1.0 and np.rad2deg(found.std) < 1.0


def test_a_wrong_mounting_is_named_although_no_motion_shows_it() -> None:
    simulation = straight(worlds.room(seed=4), 4)
    wrong = leaning(simulation, (0.6, 0.8, 0.0), 9.0)
    for T, causes in ((simulation.T_imu_lidar, []), (wrong, ["extrinsic"])):
        found = contradictions(compare_sensors(*data(simulation), CONFIG, T_declared=T), T)
        assert [finding.cause for finding in found] == causes
    assert "9 deg from upright" in found[0].text and "check T_imu_lidar" in found[0].text


def test_a_corridor_may_climb_but_does_not_lean() -> None:
    simulation = straight(worlds.corridor(200.0, 2.6, 2.8), 5)
    climbing, leaning_over = (tilt_of(simulation, leaning(simulation, axis, 12.0)) for axis in ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0)))
    assert climbing is not None and leaning_over is not None
    assert climbing.directions == leaning_over.directions == 2
    assert np.rad2deg(climbing.tilt) < 1.5 and abs(np.rad2deg(leaning_over.tilt) - 12.0) < 1.5


def test_mirrored_points_are_upright_with_their_mirror() -> None:
    simulation = straight(worlds.room(seed=6), 6, T=mounting(10.0, 6.0, 30.0, (0.1, 0.0, 0.1)))
    found = tilt_of(simulation, simulation.T_imu_lidar, faults.mirror_points(1))
    assert found is not None
    assert np.rad2deg(found.tilt) > 8.0 and np.rad2deg(found.mirrored[1]) < 1.0
    T = simulation.T_imu_lidar
    (finding,) = contradictions(compare_sensors(*data(simulation, faults.mirror_points(1)), CONFIG, T_declared=T), T)
    assert "with y of the points mirrored they are upright" in finding.text


@pytest.mark.parametrize("seed", [2, 9])
def test_a_mirror_is_told_where_a_tilt_alone_might_be_a_bias(seed: int) -> None:
    """The y axis of the points lies 1.7 deg out of level: mirrored, what stands around is tilted by twice that."""
    room = worlds.room(seed=seed)
    straightened = straight(room, seed, T=np.eye(4))
    R_world_imu = straightened.ground_truth(np.array([straightened.start_ns])).R_world_imu[0]
    T = mounting(0.0, 0.0, 0.0, (0.1, 0.0, 0.1))
    T[:3, :3] = R_world_imu.T @ so3.exp(np.array([0.0, 0.0, 0.7])) @ so3.exp(np.deg2rad([1.7, 0.9, 0.0]))
    simulation = straight(room, seed, T=T, imu=ImuModel(accel_bias=(0.0, 0.0, 0.0)))  # a bias is a tilt as well
    (finding,) = contradictions(compare_sensors(*data(simulation, faults.mirror_points(1)), CONFIG, T_declared=T), T)
    assert "with y of the points mirrored they are upright" in finding.text
    assert float(finding.text.split(" deg from upright")[0].split()[-1]) <= 4.0
    biased = leaning(simulation, (0.6, 0.8, 0.0), 3.4)
    assert contradictions(compare_sensors(*data(simulation), CONFIG, T_declared=biased), biased) == []


def test_a_forest_says_nothing() -> None:
    simulation = straight(sites.forest(seed=1), 7)
    assert tilt_of(simulation, leaning(simulation, (1.0, 0.0, 0.0), 15.0)) is None


def test_a_path_that_went_astray_contradicts_nothing() -> None:
    simulation = straight(worlds.room(seed=8), 8)
    scans, imu = data(simulation)
    path = lidar_path(scans, CONFIG)
    seconds = (path.time_ns - path.time_ns[0]) * 1e-9
    slowed = path.p_path_lidar + np.outer(np.where(seconds < 1.0, 3.0 * seconds, 3.0), [1.0, 0.0, 0.0])
    around = surroundings_of(replace(path, p_path_lidar=slowed), scans, imu, simulation.T_imu_lidar[:3, :3], CONFIG)
    assert around is not None
    found = plane_tilt(around)
    assert found is None or found.tilt < 3.0 * found.std


@pytest.mark.slow
@pytest.mark.parametrize(("roll_deg", "named"), [(0.0, False), (10.0, True), (25.0, True)])
def test_planes_speak_where_a_path_drifts_and_nothing_else_can(roll_deg: float, named: bool) -> None:
    """At a steady speed under a wrong mounting the path lay centimetres off the estimate, and nothing was compared with it."""
    motion = manoeuvres.constant_velocity(6.0, (-6.0, 0.0, 1.5), (2.0, 0.0, 0.0), manoeuvres.level(0.2))
    T = mounting(2.0, -3.0, 25.0, (0.1, 0.0, 0.2))
    scenario = Scenario("hall", worlds.hall(seed=3), motion, SpinningLidar(azimuth_steps=450), T_imu_lidar=T)
    given = T @ mounting(roll_deg, 0.0, 0.0, (0.0, 0.0, 0.0))
    odometry = LidarInertialOdometry(LioConfig(T_imu_lidar=tuple(map(tuple, given.tolist()))))
    for event in Simulation(scenario, seed=3, duration_s=6.0).events():
        if isinstance(event, Scan):
            odometry.push_scan(event)
        elif isinstance(event, ImuSamples):
            odometry.push_imu(event)
    odometry.flush()
    assert (odometry.contradiction is not None and "from upright" in odometry.contradiction) == named
