"""Axes about which the surroundings show no turn, and the gyroscope's word for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import LidarPath
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
    facing = _before_a_wall(path)
    compared = (imu, simulation.T_imu_lidar[:3, :3], np.zeros(3), 0.0, wide_prior())
    assert compare_accelerations(facing, *compared) is None
    found, exact = compare_accelerations(turned_by_gyroscope(facing), *compared), compare_accelerations(path, *compared)
    assert found is not None and exact is not None
    assert found.gravity == pytest.approx(exact.gravity, abs=0.1)
    assert np.array_equal(facing.information[:, :3, 3:], np.zeros((len(path), 3, 3))), "the path that came in stays as it was"
