"""A hand-held LiDAR in a room, its run, and that run refined."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.manifolds import quaternion
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import Simulation, SpinningLidar, make_scenario
from boxplus.simulation.motions import manoeuvres
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from boxplus.systems.refinement.collecting import OdometryRows, collect
from boxplus.systems.refinement.config import RefinementConfig
from boxplus.systems.refinement.refinement import refine
from tests.systems.refinement.cases import Case

LIDAR = SpinningLidar(channels=16, azimuth_steps=300, vertical_fov_deg=(-25.0, 25.0))


@pytest.fixture(scope="session")
def case() -> Case:
    scenario = make_scenario("spin", seed=4)
    trajectory = manoeuvres.handheld(9.0, (-2.5, -1.8, 1.1), (2.5, 1.8, 2.4), 0.8, 0.8, 1.5, seed=5)
    simulation = Simulation(replace(scenario, trajectory=trajectory, lidar=LIDAR), seed=4, duration_s=8.0)
    config = LioConfig(T_imu_lidar=tuple(map(tuple, simulation.T_imu_lidar.tolist())))  # type: ignore[call-arg]
    odometry = LidarInertialOdometry(config)
    events = list(simulation)
    estimates = [
        e for event in events for e in (odometry.push_scan(event) if isinstance(event, Scan) else odometry.push_imu(event))
    ]
    estimates += odometry.flush()
    times = np.array([e.time_ns for e in estimates])
    rows = OdometryRows.of(estimates)
    motion = simulation.ground_truth(times)
    T_true = np.hstack([quaternion.from_matrix(motion.R_world_imu), motion.p_world_imu])
    refinement = RefinementConfig()  # type: ignore[call-arg]
    run = collect(events, rows, config, refinement)
    return Case(events, rows, config, simulation, T_true, run, refine(run, refinement))
