"""An IMU of ten samples a second, as that of some recorded drives, beside scans that come as often."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.simulation import ImuModel, Scenario, Simulation, SpinningLidar
from boxplus.simulation.motions import trajectories
from boxplus.simulation.worlds import sites, worlds
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from tests.systems.lidar_inertial_odometry.small_drives import config, run

SPARSE = ImuModel(rate_hz=10.0, gyro_noise_density=3e-4, accel_noise_density=5e-3)


def estimates_of(simulation: Simulation) -> list[Estimate]:
    """All of them, of a run that nothing contradicts."""
    odometry = LidarInertialOdometry(config(simulation))
    estimates = run(odometry, simulation.events())
    assert odometry.contradiction is None
    return estimates


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_the_length_of_a_drive_is_right_to_a_part_in_a_thousand(seed: int) -> None:
    """64 rings on a street, at 11 m/s from the first sample on: nothing is read over distances that the scans do not show."""
    lidar = SpinningLidar(channels=64, azimuth_steps=900, vertical_fov_deg=(-24.8, 2.0))
    drive = trajectories.drive(np.array([[-140.0, 0.0], [0.0, 1.0], [140.0, -1.0]]), 11.0, 1.8, 0.0, seed).starting_at(4.0)
    simulation = Simulation(Scenario("street", sites.street(320.0, seed=seed), drive, lidar, SPARSE), seed, 12.0)
    estimates = estimates_of(simulation)
    p = np.array([estimate.state.p_world_imu for estimate in estimates])
    true = simulation.ground_truth(np.array([estimate.time_ns for estimate in estimates])).p_world_imu
    own_m, true_m = (np.linalg.norm(np.diff(way, axis=0), axis=1).sum() for way in (p, true))
    assert true_m > 110.0 and abs(own_m / true_m - 1.0) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3, 5])
def test_the_gait_of_a_walk_that_it_does_not_resolve_contradicts_nothing(seed: int) -> None:
    """It steps twice a second: a gyroscope sampled ten times shows 0.83 of what the LiDAR turns, and knows that only so well."""
    walk = trajectories.walk(((-2.5, 0.5), (1.0, 0.5), (1.0, -2.5), (-2.0, -2.0)))
    lidar = SpinningLidar(channels=32, azimuth_steps=512, vertical_fov_deg=(-24.8, 8.0))
    simulation = Simulation(Scenario("walk", worlds.room(seed=seed), walk, lidar, SPARSE), seed, min(walk.duration_s - 0.5, 12.0))
    assert len(estimates_of(simulation)) > 60
