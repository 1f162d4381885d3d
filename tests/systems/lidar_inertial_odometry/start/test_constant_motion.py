"""A platform that moves steadily from the first sample on: nothing in its IMU tells, and the odometry knows all the same."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.simulation import Scenario, Simulation
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.motions.spline import Trajectory
from boxplus.simulation.worlds import worlds
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from tests.systems.lidar_inertial_odometry.small_drives import LIDAR, config, deviations, position_errors, run

ROOM = (24.0, 20.0, 5.0)


def straight(speed: float, x: float) -> Trajectory:
    return manoeuvres.constant_velocity(4.0, (x, -2.0, 1.5), (speed, 0.0, 0.0), np.eye(3))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motion", "speed", "seconds"),
    [
        (straight(1.2, -5.0), 1.2, 3.5),
        (straight(2.0, -5.0), 2.0, 3.5),
        (straight(3.0, -6.0), 3.0, 3.5),
        (straight(8.0, -11.0), 8.0, 2.6),
        (manoeuvres.constant_turn(4.0, (0.0, 0.0, 1.5), 3.0, 0.5), 1.5, 3.5),
    ],
    ids=["1.2 m/s", "2 m/s", "3 m/s", "8 m/s", "circle"],
)
def test_a_steady_motion_is_never_taken_for_rest(motion: Trajectory, speed: float, seconds: float) -> None:
    """It starts as moving, and where it says that it is lies within its covariance."""
    simulation = Simulation(Scenario("steady", worlds.room(ROOM), motion, LIDAR), 0, seconds)
    odometry = LidarInertialOdometry(config(simulation))
    estimates = run(odometry, simulation.events())
    assert odometry.start is not None and odometry.start.kind == "moving"
    assert abs(np.linalg.norm(odometry.start.state.v_world_imu) - speed) < 0.1
    errors = position_errors(simulation, estimates)
    assert ((errors < 0.03) | (deviations(simulation, estimates) < 5.0)).all()
    assert odometry.contradiction is None
