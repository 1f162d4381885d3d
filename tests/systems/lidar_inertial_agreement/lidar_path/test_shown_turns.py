"""Axes about which the surroundings show no turn, and the gyroscope's word for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.shown_turns import shown_turns, turned_by_gyroscope
from boxplus.systems.lidar_inertial_agreement.translation import compare_accelerations, wide_prior
from tests.systems.lidar_inertial_agreement.lidar_path.test_explained_scans import true_path
from tests.systems.lidar_inertial_agreement.small_platforms import data, handheld

_NORMAL = np.array([0.6, 0.0, 0.8])


def _before_a_wall(path: LidarPath) -> LidarPath:
    """As if a turn about one axis had moved no point."""
    information = np.zeros_like(path.information)
    information[1:, 3:, 3:] = 1e6 * np.eye(3)
    information[1:, :3, :3] = 1e8 * (np.eye(3) - np.outer(_NORMAL, _NORMAL))
    return replace(path, information=information)


def test_the_axis_that_no_pose_knows_is_found() -> None:
    simulation = handheld(0)
    path = _before_a_wall(true_path(simulation, data(simulation)[0][:12]))
    shown, open_axes = shown_turns(path)
    assert shown.shape == (3, 2) and open_axes.shape == (3, 1)
    assert abs(open_axes[:, 0] @ _NORMAL) == pytest.approx(1.0)


def test_with_the_gyroscope_gravity_is_found_where_a_wall_does_not_show_a_turn() -> None:
    simulation = handheld(0)
    scans, imu = data(simulation)
    path = true_path(simulation, scans[:12])
    # About the normal the path turns as noise has it.
    noise = np.concatenate([[0.0], np.random.default_rng(0).normal(0.0, 0.02, len(path) - 1)])
    facing = replace(_before_a_wall(path), R_path_lidar=path.R_path_lidar @ so3.exp(noise[:, None] * _NORMAL))
    R, bias = simulation.T_imu_lidar[:3, :3], np.asarray(simulation.scenario.imu.gyro_bias)
    compared = (imu, R, bias, 0.0, wide_prior())
    assert compare_accelerations(facing, *compared) is None
    told = turned_by_gyroscope(facing, imu, R, bias)
    assert so3.log(np.swapaxes(told.R_path_lidar, 1, 2) @ path.R_path_lidar) == pytest.approx(0.0, abs=5e-3)
    assert np.abs(facing.information[1:, :3, :3] @ _NORMAL).max() < 1.0, "the path that came in stays as it was"
    found, exact = compare_accelerations(told, *compared), compare_accelerations(path, *compared)
    assert found is not None and exact is not None
    assert found.gravity == pytest.approx(exact.gravity, abs=0.3)


def test_a_path_that_shows_fewer_turns_than_two_stays_as_it_is() -> None:
    """A gyroscope that nothing holds against the LiDAR is not believed."""
    simulation = handheld(0)
    scans, imu = data(simulation)
    path = true_path(simulation, scans[:12])
    information = _before_a_wall(path).information
    information[1:, :3, :3] = 1e8 * np.outer(_NORMAL, _NORMAL)
    open_twice = replace(path, information=information)
    for unchanged in (open_twice, path):
        assert turned_by_gyroscope(unchanged, imu, simulation.T_imu_lidar[:3, :3], np.zeros(3)) is unchanged
