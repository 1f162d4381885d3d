"""What changes from scan to scan shows how fast a platform drives where all else goes along with it, and nothing at rest."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.simulation import Scenario, Simulation, SpinningLidar
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.worlds import sites
from boxplus.systems.lidar_inertial_agreement.agreement import gyro_guesses
from boxplus.systems.lidar_inertial_agreement.lidar_path.common_motion import (
    ChangedPoints,
    CommonMotion,
    common_motion,
    explains_changes,
)
from boxplus.systems.lidar_inertial_agreement.lidar_path.explained_scans import explained_scans
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import lidar_path
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, data, true_poses, true_twists

LIDAR = SpinningLidar(channels=32, azimuth_steps=512, vertical_fov_deg=(-25.0, 15.0))
UP = np.array([0.0, 0.0, 1.0])


@lru_cache(maxsize=4)
def highway(speed: float, seconds: float = 1.1) -> Simulation:
    motion = manoeuvres.constant_velocity(seconds + 1.0, (-20.0, 0.5, 1.8), (speed, 0.0, 0.0), so3.exp(np.array([0.0, 0.0, 0.4])))
    return Simulation(Scenario("highway", sites.highway(500.0, seed=3), motion, LIDAR, T_imu_lidar=np.eye(4)), 3, seconds)


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


def test_too_few_scans_say_nothing() -> None:
    scans, imu = data(highway(12.0))
    assert common_motion(scans[:5], gyro_guesses(imu, np.eye(3))[0], UP) is None


def test_the_shift_that_is_missing_is_found() -> None:
    random = np.random.default_rng(1)
    p = random.uniform(-20.0, 20.0, (200, 3))
    since = random.uniform(-0.05, 0.05, 200)
    velocity = np.array([15.0, 2.0, 0.0])
    # Standing points, as seen from where the LiDAR is when it sees them.
    pair = ChangedPoints(p - since[:, None] * velocity, p - (since + 0.1)[:, None] * velocity, since, since + 0.1, 0.1)
    again, missing = pair.shifts(velocity)
    assert again.all()
    np.testing.assert_allclose(missing, 0.0, atol=1e-3)  # the map keeps single precision
    again, missing = pair.shifts(velocity - [0.5, 0.0, 0.0])
    np.testing.assert_allclose(np.median(missing, axis=0), [0.5, 0.0, 0.0], atol=1e-3)
    none = ChangedPoints(p[:0], p, since[:0], since, 0.1)
    assert not none.shifts(velocity)[0].any() and none.shifts(velocity)[1].shape == (0, 3)
