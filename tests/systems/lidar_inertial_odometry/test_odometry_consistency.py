"""The pose covariance of the whole odometry against its errors: average NEES over seeded runs on the simulator.

The built-in walk, with another city, motion and noise for every seed: at rest for two seconds, then off through the streets.
Everything is the odometry's own: start, matching, the map. The settings are the defaults but for the IMU's noise, which is what
the simulator draws it from.
"""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.evaluation.nees import nees, nees_band
from boxplus.manifolds import so3
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import ImuModel, simulate
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from tests.systems.lidar_inertial_odometry.simulated_runs import SPARSE

RUNS, DURATION_S = 30, 3.5
INSTANTS = (-6, -1)  # half a second before the end, and the end


def _errors(seed: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Error of the pose against the first one, x_true ⊟ x, and its covariance, at the instants."""
    imu = ImuModel()
    simulation = simulate("walk", seed, duration_s=DURATION_S, lidar=SPARSE, imu=imu)
    config = LioConfig(
        T_imu_lidar=simulation.T_imu_lidar.tolist(),
        gyro_noise=imu.gyro_noise_density,
        accel_noise=imu.accel_noise_density,
        gyro_bias_walk=imu.gyro_bias_walk,
        accel_bias_walk=imu.accel_bias_walk,
    )
    odometry = LidarInertialOdometry(config)
    estimates: list[Estimate] = []
    for event in simulation.events():
        estimates += odometry.push_scan(event) if isinstance(event, Scan) else odometry.push_imu(event)
    estimates += odometry.flush()
    first, asked = estimates[0], [estimates[instant] for instant in INSTANTS]
    truth = simulation.ground_truth(np.array([estimate.time_ns for estimate in (first, *asked)]))
    # The true poses in the world of the estimate, which begins at its first pose.
    turn = first.state.R_world_imu @ truth.R_world_imu[0].T
    R_true = turn @ truth.R_world_imu
    p_true = (truth.p_world_imu - truth.p_world_imu[0]) @ turn.T + first.state.p_world_imu
    errors = [
        np.concatenate([so3.log(e.state.R_world_imu.T @ R_true[i + 1]), p_true[i + 1] - e.state.p_world_imu])
        for i, e in enumerate(asked)
    ]
    return errors, [estimate.pose_covariance for estimate in asked]


@pytest.mark.slow
def test_average_nees_of_the_pose_is_cautious_and_not_careless() -> None:
    """6 is exact. Streets seen by a dense LiDAR are the smooth end of what the odometry allows for: there it is cautious, by half
    in the standard deviation; coarse LiDARs in halls need all of it.
    """
    errors, covariances = (np.array(values) for values in zip(*(_errors(seed) for seed in range(RUNS)), strict=True))
    low, high = nees_band(6, RUNS)
    for instant in range(len(INSTANTS)):
        average = nees(errors[:, instant], covariances[:, instant]).mean()
        assert low / 4.0 <= average <= high, f"average NEES {average:.2f} outside {low / 4.0:.2f} … {high:.2f}"
