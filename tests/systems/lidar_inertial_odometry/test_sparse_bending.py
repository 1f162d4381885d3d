"""Planes are bent in sparse maps for LiDARs that see one way where a map begins, and for no others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from boxplus.sensors.inertial.imu import ImuSamples
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


def test_it_is_said_by_all_scans_of_a_start_and_for_good(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where a map begins anew after a gap: a LiDAR on its side that flies high sees the ground only."""
    said = iter([True, False])
    monkeypatch.setattr(module, "sees_one_way", lambda _: next(said, True))
    world, rest = worlds.room((14.0, 11.0, 5.0), seed=2), trajectories.at_rest(16.5, (-3.0, 1.0, 1.5))
    lidar = SpinningLidar(azimuth_steps=300)
    simulation = Simulation(Scenario("rest", world, rest, lidar, ImuModel(), mounting(0.0, 0.0, 0.0, (0.0, 0.0, 0.1))), 1, 16.0)
    odometry = LidarInertialOdometry(LioConfig(T_imu_lidar=tuple(map(tuple, simulation.T_imu_lidar.tolist()))))
    first, last = simulation.start_ns + 2_000_000_000, simulation.start_ns + 13_500_000_000
    begun: list[int] = []
    for event in simulation.events():
        time_ns = int(event.time_ns[0])
        if first < time_ns < last:
            continue
        estimates = odometry.push_imu(event) if isinstance(event, ImuSamples) else odometry.push_scan(event)
        begun += [estimate.time_ns for estimate in estimates]
    assert min(begun) < first and max(begun) > last  # it has begun twice
    assert odometry._one_way is False
