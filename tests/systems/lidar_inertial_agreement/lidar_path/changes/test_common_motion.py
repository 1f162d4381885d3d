"""What changes from scan to scan shows how fast a platform drives where all else goes along with it, and nothing at rest."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import ImuModel, Scenario, Simulation, SpinningLidar
from boxplus.simulation.motions import manoeuvres, trajectories
from boxplus.simulation.worlds import sites
from boxplus.simulation.worlds.world import World, box
from boxplus.systems.lidar_inertial_agreement.agreement import gyro_guesses
from boxplus.systems.lidar_inertial_agreement.lidar_path.changes.changed_points import changed_share
from boxplus.systems.lidar_inertial_agreement.lidar_path.changes.common_motion import (
    CommonMotion,
    common_motion,
    explains_changes,
    speaks_against,
)
from boxplus.systems.lidar_inertial_agreement.lidar_path.changes.standing import shows_rest
from boxplus.systems.lidar_inertial_agreement.lidar_path.explained_scans import explained_scans
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import lidar_path
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, data, true_poses, true_twists

LIDAR = SpinningLidar(channels=32, azimuth_steps=512, vertical_fov_deg=(-25.0, 15.0))
UP = np.array([0.0, 0.0, 1.0])


@lru_cache(maxsize=4)
def highway(speed: float, seconds: float = 1.1, tilt: float = 0.0) -> Simulation:
    motion = manoeuvres.constant_velocity(seconds + 1.0, (-20.0, 0.5, 1.8), (speed, 0.0, 0.0), so3.exp(np.array([0.0, 0.0, 0.4])))
    mounting = np.eye(4)
    mounting[:3, :3] = so3.exp(np.array([0.0, tilt, 0.0]))
    return Simulation(Scenario("highway", sites.highway(500.0, seed=3), motion, LIDAR, T_imu_lidar=mounting), 3, seconds)


def among_traffic(seed: int) -> tuple[list[Scan], ImuSamples]:
    """At rest on a highway between two lanes of vehicles of one speed and direction."""
    random = np.random.default_rng(seed)
    speed, count = random.uniform(9.0, 22.0), int(random.integers(8, 18))
    x, length = np.sort(random.uniform(-70.0, 50.0, count)), random.uniform(4.0, 16.0, count)
    lane, height = random.choice([-3.6, 3.6], count), np.where(length > 8.0, 4.0, 1.5)
    road, rest = list(sites.highway(400.0, seed=seed).solids), trajectories.at_rest(4.0, (0.0, 0.0, 1.8))
    scans = []
    for k in range(11):
        vehicles = [
            box((x[i] + speed * k * 0.1, lane[i], 0.5 * height[i] + 0.3), (length[i], 2.4, height[i])) for i in range(count)
        ]
        simulation = Simulation(Scenario("traffic", World([*road, *vehicles]), rest, LIDAR, ImuModel(), np.eye(4)), seed, 2.0)
        scans.append(simulation.scan(k))
    return scans, ImuSamples.joined(event for event in simulation.events() if isinstance(event, ImuSamples))


@pytest.mark.slow
@pytest.mark.parametrize("speed", [12.0, 26.0])
def test_a_path_on_a_highway_follows_what_changes(speed: float) -> None:
    simulation = highway(speed)
    scans, imu = data(simulation)
    guesses = gyro_guesses(imu, np.eye(3))
    motion = common_motion(scans, guesses[0], UP)
    assert isinstance(motion, CommonMotion)
    twists = motion.twists()
    assert len(twists) == len(scans)
    path = lidar_path(scans, CONFIG, guesses, undistort=True, expected=twists, held=True, unbroken=True)
    assert not path.failed and len(path) == len(scans)
    _, p = true_poses(simulation, path.time_ns)
    seconds = (path.time_ns[-1] - path.time_ns[0]) * 1e-9
    error = path.p_path_lidar - (p - p[0]) @ true_poses(simulation, path.time_ns)[0][0]
    assert np.linalg.norm(error, axis=1).max() < 0.6 * seconds
    along = (p[-1] - p[0]) @ true_poses(simulation, path.time_ns)[0][0] / np.linalg.norm(p[-1] - p[0])
    assert np.linalg.norm(error - np.outer(error @ along, along), axis=1).max() < 0.08
    true = true_twists(simulation, scans)
    assert explains_changes(scans, guesses[0], true)
    assert not explains_changes(scans, guesses[0], [(rate, 0.5 * velocity) for rate, velocity in true])


@pytest.mark.slow
def test_nothing_that_changes_at_rest_is_a_motion() -> None:
    """Neither nothing nor a fifth of the points lost and a twentieth anywhere."""
    scans, imu = data(highway(0.0))
    turning = gyro_guesses(imu, np.eye(3))[0]
    assert common_motion(scans, turning, UP) is None
    random = np.random.default_rng(0)
    for scan in scans:
        scan.p_lidar[random.uniform(size=len(scan)) < 0.2] = scan.p_lidar[0]
        anywhere = random.uniform(size=len(scan)) < 0.05
        scan.p_lidar[anywhere] *= random.uniform(0.3, 0.9, (int(anywhere.sum()), 1)).astype(np.float32)
    assert common_motion(scans, turning, UP) is None


@pytest.mark.slow
def test_an_estimate_that_explains_what_changes_has_not_gone_astray() -> None:
    """On this highway the registrations alone rest, and explain the scans better than the truth does."""
    simulation = highway(26.0, 3.0)
    scans, imu = data(simulation)
    path = lidar_path(scans, CONFIG, gyro_guesses(imu, np.eye(3)))
    assert explained_scans(path, scans, true_twists(simulation, scans), CONFIG).astray is None


@pytest.mark.slow
def test_the_traffic_on_both_sides_of_a_platform_at_rest_is_no_motion_of_its_own() -> None:
    """Some of it goes by as the surroundings would, and says so; in other scenes nothing goes by, or more stays."""
    motions = []
    for seed in range(20, 44, 3):
        scans, imu = among_traffic(seed)
        motions.append(common_motion(scans, gyro_guesses(imu, np.eye(3))[0], UP))
    doubts = [motion.doubt for motion in motions if motion is not None]
    assert doubts and all(doubts)


@pytest.mark.slow
@pytest.mark.parametrize("parts", ["truck ahead", "convoy", "stakes"])
def test_what_keeps_pace_with_the_platform_does_not_rest_it(parts: str) -> None:
    """A truck ahead, vehicles of one speed around, stakes of its own load: they stand, and stay where they are."""
    places = {
        "truck ahead": [(18.0, 0.0, 12.0, 2.4, 3.6)],
        "convoy": [
            (16.0, 0.0, 4.5, 2.0, 1.5),
            (-15.0, 0.0, 4.5, 2.0, 1.5),
            (9.0, -3.2, 4.5, 2.0, 1.5),
            (-10.0, -3.2, 4.5, 2.0, 1.7),
        ],
        "stakes": [(x, y, 0.12, 0.12, 1.8) for x in (-6.0, -9.6, -13.2) for y in (-1.2, 1.2)],
    }[parts]
    own = World([box((x, y, 0.5 * z - 1.5), (length, width, z)) for x, y, length, width, z in places])
    along = Simulation(Scenario("own", own, trajectories.at_rest(4.0), LIDAR, ImuModel(), np.eye(4)), 3, 2.0)
    motion = manoeuvres.constant_velocity(2.1, (20.0, 0.3, 1.8), (22.0, 0.0, 0.0), np.eye(3))
    road = Simulation(Scenario("highway", sites.highway(500.0, seed=1), motion, LIDAR, T_imu_lidar=np.eye(4)), 1, 1.1)
    scans, imu = data(road)
    both = []
    for number, scan in enumerate(scans):
        p = along.scan(number)
        time_ns = np.clip(p.time_ns, scan.start_ns, scan.end_ns)
        both.append(Scan.from_arrays(np.concatenate([scan.p_lidar, p.p_lidar]), np.concatenate([scan.time_ns, time_ns])))
    motion_found = common_motion(both, gyro_guesses(imu, np.eye(3))[0], UP)
    assert motion_found is not None and not motion_found.doubt
    assert np.linalg.norm(motion_found.velocity - [22.0, 0.0, 0.0]) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("tilt", [0.35, -0.3])
def test_a_tilted_lidar_sees_what_changes_all_around(tilt: float) -> None:
    simulation = highway(18.0, tilt=tilt)
    scans, imu = data(simulation)
    R_imu_lidar = simulation.T_imu_lidar[:3, :3]
    motion = common_motion(scans, gyro_guesses(imu, R_imu_lidar)[0], R_imu_lidar.T @ UP)
    assert isinstance(motion, CommonMotion) and not motion.doubt
    true = R_imu_lidar.T @ so3.exp(np.array([0.0, 0.0, -0.4])) @ [18.0, 0.0, 0.0]
    assert np.linalg.norm(motion.velocity - true) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("speed", [26.0, 0.0])
def test_at_rest_nothing_changes_and_what_stands_stays(speed: float) -> None:
    motion = manoeuvres.constant_velocity(2.1, (0.0, 0.0, 1.8), (speed, 0.0, 0.0), np.eye(3))
    road = Simulation(Scenario("highway", sites.highway(400.0, seed=4), motion, LIDAR, T_imu_lidar=np.eye(4)), 4, 1.1)
    scans, imu = data(road)
    assert (changed_share(scans[0], scans[1], gyro_guesses(imu, np.eye(3))[0]) < 0.003) == (speed == 0.0)
    assert shows_rest(scans, np.array([1.0, 0.0, 0.0]), UP) == (speed == 0.0)


def street(speed: float) -> Simulation:
    motion = manoeuvres.constant_velocity(2.1, (0.0, 0.0, 1.8), (speed, 0.0, 0.0), np.eye(3))
    return Simulation(Scenario("street", sites.street(200.0, seed=2), motion, LIDAR, T_imu_lidar=np.eye(4)), 4, 1.1)


def along(path: LidarPath, speed: float) -> LidarPath:
    """The path with a motion added to it [m/s] that nothing shows."""
    seconds = (path.time_ns - path.time_ns[0])[:, None] * 1e-9
    return replace(path, p_path_lidar=path.p_path_lidar + seconds * [speed, 0.0, 0.0])


@pytest.mark.slow
def test_what_stands_and_stays_speaks_against_a_path_that_drives() -> None:
    """As registrations find it that follow what drives around a platform at rest; slow ones are theirs to tell."""
    scans, imu = data(street(0.0))
    turning = gyro_guesses(imu, np.eye(3))[0]
    rest = lidar_path(scans, CONFIG, [turning])
    assert " points stay and " in speaks_against(along(rest, 15.0), scans, turning, UP)
    for path, through in [(rest, scans), (along(rest, 5.0), scans), (along(rest, 15.0), [*scans, scans[-1]])]:
        assert speaks_against(path, through, turning, UP) == ""


@pytest.mark.slow
def test_nothing_speaks_against_a_path_that_drives_as_the_platform_does() -> None:
    simulation = street(15.0)
    scans, imu = data(simulation)
    turning = gyro_guesses(imu, np.eye(3))[0]
    path = lidar_path(scans, CONFIG, [turning], undistort=True, expected=true_twists(simulation, scans))
    assert speaks_against(path, scans, turning, UP) == ""


def test_too_few_scans_say_nothing() -> None:
    scans, imu = data(highway(12.0))
    assert common_motion(scans[:5], gyro_guesses(imu, np.eye(3))[0], UP) is None
