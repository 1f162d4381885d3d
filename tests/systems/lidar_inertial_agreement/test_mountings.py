"""A mounting by many stretches together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.systems.lidar_inertial_agreement.agreement import compare_sensors
from boxplus.systems.lidar_inertial_agreement.mountings import Turn, mounting_of_many, turn_from
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, data, handheld, turned


def stretches(angle_deg: float, std_deg: float, count: int, seed: int = 0, spread: float = 1.0) -> list[Turn]:
    """Of a mounting that is off by so much about a slanted axis, each known to `std_deg` about every axis."""
    random = np.random.default_rng(seed)
    off = np.deg2rad(angle_deg) * np.array([0.6, 0.0, 0.8])
    known = np.eye(3) / np.deg2rad(std_deg) ** 2
    return [(off + spread * np.deg2rad(std_deg) * random.standard_normal(3), known) for _ in range(count)]


@pytest.mark.parametrize("seed", range(5))
def test_five_degrees_show_in_several_stretches_of_which_none_tells_them(seed: int) -> None:
    off = stretches(6.0, 0.9, 4, seed)
    assert mounting_of_many(off[:1]) is None
    found = mounting_of_many(off)
    assert found is not None and found.cause == "extrinsic"
    assert "in 4 stretches together" in found.text and "T_imu_lidar" in found.text
    assert mounting_of_many(stretches(0.0, 0.9, 4, seed)) is None
    assert mounting_of_many(stretches(1.5, 0.05, 40, seed)) is None  # as much as registrations lag


def test_stretches_that_differ_among_themselves_show_no_mounting() -> None:
    assert mounting_of_many(stretches(4.0, 0.1, 3)) is not None
    assert mounting_of_many(stretches(4.0, 0.1, 3, spread=25.0)) is None


def test_axes_that_no_stretch_shows_do_not_count() -> None:
    axis = np.array([0.0, 0.0, 1.0])
    known = np.diag([1e5, 1e5, 0.1])
    assert mounting_of_many([(0.2 * axis, known)] * 3) is None
    assert mounting_of_many([(0.2 * axis + np.array([0.2, 0.0, 0.0]), known)] * 3) is not None


@pytest.mark.slow
def test_a_turn_is_the_one_from_the_given_mounting() -> None:
    simulation = handheld(3)
    T = simulation.T_imu_lidar
    rotation = compare_sensors(*data(simulation), CONFIG, T_declared=T).rotation
    assert rotation is not None
    other = turned(T, 6.0, 1)[:3, :3]
    turn, known = turn_from(rotation, other)
    assert np.degrees(np.linalg.norm(turn - so3.log(T[:3, :3] @ other.T))) < 1.0
    np.testing.assert_allclose(np.linalg.inv(known), rotation.covariance[:3, :3])
    open_axis = np.array([0.0, 0.0, 1.0])
    covariance = rotation.covariance.copy()
    covariance[:3, :3] = np.diag([1e-4, 1e-4, 1.0])
    about = replace(rotation, R_imu_lidar=so3.exp(2.0 * open_axis) @ T[:3, :3], covariance=covariance, main_axis=open_axis)
    np.testing.assert_allclose(turn_from(about, T[:3, :3])[0], 0.0, atol=1e-9)
    right = turn_from(replace(rotation, R_imu_lidar=T[:3, :3]), T[:3, :3])
    assert mounting_of_many([right] * 3) is None
