"""Planes around a path, and which way is up there."""

from __future__ import annotations

import numpy as np

from boxplus.simulation import ImuModel, Scenario, Simulation, SpinningLidar, mounting
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.worlds import worlds
from boxplus.systems.lidar_inertial_agreement.planes.surroundings import surroundings_of
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, data, true_path

EXACT = ImuModel(accel_bias=(0.0, 0.0, 0.0), gyro_bias=(0.0, 0.0, 0.0))


def test_up_is_the_force_less_what_the_path_speeds_up_by() -> None:
    T = mounting(20.0, -10.0, 60.0, (0.0, 0.0, 0.0))
    motion = manoeuvres.constant_turn(3.0, (0.0, 0.0, 1.5), 2.0, 1.0)
    simulation = Simulation(
        Scenario("turn", worlds.room(seed=1), motion, SpinningLidar(channels=24, azimuth_steps=120), EXACT, T), 1, 2.6
    )
    scans, imu = data(simulation)
    path = true_path(simulation, scans)
    around = surroundings_of(path, scans, imu, T[:3, :3], CONFIG)
    assert around is not None
    assert np.rad2deg(np.arccos(around.up[2])) < 1.0 < np.rad2deg(np.arccos(around.force[2] / np.linalg.norm(around.force)))
    assert np.abs(around.directions[0][0]).max() > np.cos(0.02)
    assert around.points.shape == around.normals.shape and len(around.points) > 200


def test_a_path_of_a_second_says_nothing() -> None:
    motion = manoeuvres.constant_velocity(2.0, (0.0, 0.0, 1.5), (0.5, 0.0, 0.0), np.eye(3))
    simulation = Simulation(
        Scenario("short", worlds.room(seed=1), motion, SpinningLidar(channels=12, azimuth_steps=90), EXACT), 1, 1.0
    )
    scans, imu = data(simulation)
    assert surroundings_of(true_path(simulation, scans), scans, imu, np.eye(3), CONFIG) is None
