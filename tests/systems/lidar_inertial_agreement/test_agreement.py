"""What is recorded twice, or late, changes nothing about a comparison; and what turns too little contradicts no mounting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from boxplus.manifolds import so3
from boxplus.systems.lidar_inertial_agreement.agreement import compare_sensors, contradicted_within
from boxplus.systems.lidar_inertial_agreement.rotation import RotationFit
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


def test_turns_about_a_constant_rate_contradict_a_mounting_only_where_they_are_no_noise() -> None:
    """Lasers out of line made 0.2 deg/s of a circle at a constant rate, which fitted a mounting half a turn off to 2.5 deg."""
    covariance = np.diag([0.044, 0.044, 3.0, 0.01, 0.01, 0.01, 0.06, 0.88]) ** 2
    fit = RotationFit(
        R_imu_lidar=np.eye(3), offset_s=0.0, scale=1.0, bias=np.zeros(3), covariance=covariance, sigma=np.radians(0.05),
        explained=0.9, mirrored=0.86, together=0.9, sigma_registration=np.radians(0.05),
        excitation=np.radians([0.2, 0.0, 0.0]), intervals=39, covered=1.0, coarse=False, main_axis=np.array([0.0, 0.0, 1.0]),
    )  # fmt: skip
    half_a_turn = so3.exp(np.array([np.radians(167.0), 0.0, 0.0]))
    assert contradicted_within(fit, half_a_turn) is None
    turning = replace(fit, excitation=np.radians([3.0, 0.0, 0.0]))
    assert contradicted_within(turning, half_a_turn) is not None
    assert contradicted_within(replace(turning, sigma=np.radians(2.0)), half_a_turn) is None
    assert contradicted_within(turning, np.eye(3)) is None
