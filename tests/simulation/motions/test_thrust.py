"""Flights along their thrust: derivatives against differences, the specific force, standstill."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.simulation import ThrustTrajectory
from boxplus.simulation.imu import GRAVITY

KNOT_NS = 100_000_000
seeds = st.integers(0, 2**32 - 1)


def random_flight(seed: int) -> ThrustTrajectory:
    random = np.random.default_rng(seed)
    p = np.cumsum(random.uniform(-0.03, 0.03, (14, 3)), axis=0)
    return ThrustTrajectory(7_000_000_000, KNOT_NS * 1e-9, p, np.cumsum(random.uniform(-0.1, 0.1, 14)))


def middles(flight: ThrustTrajectory) -> np.ndarray:
    return flight.start_ns + KNOT_NS * np.arange(9) + KNOT_NS // 3


@given(seeds)
def test_the_specific_force_lies_along_z(seed: int) -> None:
    motion = random_flight(seed).evaluate(middles(random_flight(seed)))
    force = np.einsum("nji,nj->ni", motion.R_world_imu, motion.a_world_imu + np.array([0.0, 0.0, GRAVITY]))
    np.testing.assert_allclose(force[:, :2], 0.0, atol=1e-12)
    assert (force[:, 2] > 0.0).all()
    assert so3.is_rotation(motion.R_world_imu, 1e-12)


@given(seeds)
def test_velocity_acceleration_and_body_rate_are_derivatives(seed: int) -> None:
    flight = random_flight(seed)
    h_ns = 100_000
    before, motion, after = (flight.evaluate(middles(flight) + k * h_ns) for k in (-1, 0, 1))
    h = 2e-9 * h_ns
    np.testing.assert_allclose((after.p_world_imu - before.p_world_imu) / h, motion.v_world_imu, atol=1e-5)
    np.testing.assert_allclose((after.v_world_imu - before.v_world_imu) / h, motion.a_world_imu, atol=1e-4)
    np.testing.assert_allclose(so3.boxminus(after.R_world_imu, before.R_world_imu) / h, motion.omega_imu, atol=1e-4)


@given(seeds)
def test_motion_is_continuous_at_the_knots(seed: int) -> None:
    flight = random_flight(seed)
    knots = flight.start_ns + KNOT_NS * np.arange(1, 9)
    for a, b in zip(flight.evaluate(knots - 1), flight.evaluate(knots + 1), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_equal_control_points_are_a_level_standstill() -> None:
    flight = ThrustTrajectory(0, 0.1, np.tile([1.0, 2.0, 3.0], (8, 1)), np.full(8, 0.7))
    assert flight.duration_s == pytest.approx(0.3)
    motion = flight.evaluate(np.arange(0, flight.end_ns + 1, 10_000_000))
    np.testing.assert_allclose(motion.p_world_imu, [[1.0, 2.0, 3.0]] * len(motion.p_world_imu), atol=1e-12)
    np.testing.assert_allclose(motion.R_world_imu, np.broadcast_to(so3.exp(np.array([0, 0, 0.7])), (31, 3, 3)), atol=1e-12)
    for rate in (motion.v_world_imu, motion.a_world_imu, motion.omega_imu):
        np.testing.assert_allclose(rate, 0.0, atol=1e-9)


def test_refused() -> None:
    with pytest.raises(InputError, match="expected K ≥ 6 control points"):
        ThrustTrajectory(0, 0.1, np.zeros((5, 3)), np.zeros(5))
    with pytest.raises(InputError, match="positive time between knots"):
        ThrustTrajectory(0, 0.0, np.zeros((6, 3)), np.zeros(6))
    with pytest.raises(InputError, match="the span of the trajectory"):
        ThrustTrajectory(0, 0.1, np.zeros((6, 3)), np.zeros(6)).evaluate([200_000_000])
