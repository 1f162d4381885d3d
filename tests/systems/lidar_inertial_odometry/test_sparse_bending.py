"""Planes are bent in sparse maps for LiDARs that see one way where a map begins, and for no others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from boxplus.simulation import ImuModel, OmniLidar, RosetteLidar, Scenario, Simulation, SpinningLidar, mounting
from boxplus.simulation.motions import trajectories
from boxplus.simulation.worlds import worlds
from boxplus.systems.lidar_inertial_odometry import odometry as module
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from tests.systems.lidar_inertial_odometry.small_drives import run


@pytest.mark.parametrize(
    ("lidar", "one_way"),
    [
        (RosetteLidar(points_per_scan=6000), True),
        (SpinningLidar(azimuth_steps=500), False),
        (OmniLidar(points_per_scan=6000), False),
    ],
    ids=["rosette", "spinning", "omni"],
)
def test_the_first_scan_of_a_map_says_which(
    lidar: RosetteLidar | SpinningLidar | OmniLidar, one_way: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    class Asked(module.PlaneMeasurement):
        def __init__(self, *arguments: Any, bend_sparse: bool = False, **named: Any) -> None:
            asked.append(bend_sparse)
            super().__init__(*arguments, bend_sparse=bend_sparse, **named)

    monkeypatch.setattr(module, "PlaneMeasurement", Asked)
    world, rest = worlds.room((14.0, 11.0, 5.0), seed=2), trajectories.at_rest(2.5, (-3.0, 1.0, 1.5))
    simulation = Simulation(Scenario("rest", world, rest, lidar, ImuModel(), mounting(0.0, 0.0, 0.0, (0.0, 0.0, 0.1))), 1, 2.0)
    odometry = LidarInertialOdometry(LioConfig(T_imu_lidar=tuple(map(tuple, simulation.T_imu_lidar.tolist()))))
    estimates = run(odometry, list(simulation.events()))
    assert len(estimates) > 10
    assert np.all(np.array(asked) == one_way) and len(asked) > 10
