"""What is recorded twice, or late, changes nothing about a comparison."""

from __future__ import annotations

import numpy as np

from boxplus.systems.lidar_inertial_agreement.agreement import compare_sensors
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, data, handheld


def test_scans_that_are_recorded_twice_or_late_are_left_out() -> None:
    simulation = handheld(2, seconds=3.0)
    scans, imu = data(simulation)
    once = compare_sensors(scans, imu, CONFIG, T_declared=simulation.T_imu_lidar)
    twice = [again for scan in scans for again in (scan, scan)]
    late = [*scans, scans[3]]
    for recorded in (twice, late):
        found = compare_sensors(recorded, imu, CONFIG, T_declared=simulation.T_imu_lidar)
        np.testing.assert_array_equal(found.path.p_path_lidar, once.path.p_path_lidar)
        assert found.rotation is not None and once.rotation is not None
        assert found.rotation.offset_s == once.rotation.offset_s
