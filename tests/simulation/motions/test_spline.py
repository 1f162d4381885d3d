"""Splines on the manifold: derivatives against differences, continuity, standstill."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.simulation import SplineTrajectory

KNOT_NS = 100_000_000


def random_trajectory(seed: int, knots: int = 9) -> SplineTrajectory:
    random = np.random.default_rng(seed)
    R = [so3.exp(random.uniform(-3, 3, 3))]
    for _ in range(knots - 1):
        R.append(R[-1] @ so3.exp(random.uniform(-1.2, 1.2, 3)))
    return SplineTrajectory(5_000_000_000, KNOT_NS * 1e-9, np.stack(R), random.uniform(-2, 2, (knots, 3)))


seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_velocity_and_acceleration_are_the_derivatives_of_position(seed: int) -> None:
    trajectory = random_trajectory(seed)
    middles = trajectory.start_ns + KNOT_NS * np.arange(6) + KNOT_NS // 3
    h_ns = 10_000_000
    p = [trajectory.evaluate(middles + k * h_ns).p_world_imu for k in (-2, -1, 0, 1, 2)]
    motion = trajectory.evaluate(middles)
    # Five-point differences are exact for the cubic between two knots.
    h = h_ns * 1e-9
    np.testing.assert_allclose((p[0] - 8 * p[1] + 8 * p[3] - p[4]) / (12 * h), motion.v_world_imu, atol=1e-9)
    np.testing.assert_allclose((-p[0] + 16 * p[1] - 30 * p[2] + 16 * p[3] - p[4]) / (12 * h * h), motion.a_world_imu, atol=1e-7)


@given(seeds)
def test_body_rate_is_the_derivative_of_rotation(seed: int) -> None:
    trajectory = random_trajectory(seed)
    middles = trajectory.start_ns + KNOT_NS * np.arange(6) + KNOT_NS // 2
    h_ns = 100_000
    before, after = (trajectory.evaluate(middles + s * h_ns).R_world_imu for s in (-1, 1))
    numeric = so3.boxminus(after, before) / (2e-9 * h_ns)
    np.testing.assert_allclose(numeric, trajectory.evaluate(middles).omega_imu, atol=3e-5)


@given(seeds)
def test_motion_is_continuous_at_the_knots(seed: int) -> None:
    trajectory = random_trajectory(seed)
    knots = trajectory.start_ns + KNOT_NS * np.arange(1, 6)
    left, right = trajectory.evaluate(knots - 1), trajectory.evaluate(knots + 1)
    for a, b in zip(left, right, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)
    assert so3.is_rotation(right.R_world_imu, 1e-12)


def test_equal_control_poses_are_an_exact_standstill() -> None:
    R = so3.exp([0.3, -0.2, 1.0])
    trajectory = SplineTrajectory(0, 0.1, np.broadcast_to(R, (8, 3, 3)), np.broadcast_to([1.0, 2.0, 3.0], (8, 3)))
    motion = trajectory.evaluate(np.linspace(0, trajectory.end_ns, 50).astype(np.int64))
    assert not motion.v_world_imu.any()
    assert not motion.a_world_imu.any()
    np.testing.assert_allclose(motion.omega_imu, 0.0, atol=1e-14)
    np.testing.assert_allclose(motion.R_world_imu - R, 0.0, atol=1e-14)


def test_a_later_start_is_the_same_motion() -> None:
    trajectory = random_trajectory(3)
    later = trajectory.starting_at(0.2)
    time = later.start_ns + np.array([0, 12_345_678, 399_000_000])
    for a, b in zip(later.evaluate(time), trajectory.evaluate(time + 200_000_000), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-10)


def test_refused() -> None:
    trajectory = random_trajectory(0)
    with pytest.raises(InputError, match=r"expected times within \[5000000000, 5600000000\] ns"):
        trajectory.evaluate([trajectory.end_ns + 1])
    with pytest.raises(InputError, match=r"integer nanoseconds of shape \(N,\) – got float64"):
        trajectory.evaluate([5.1])
    with pytest.raises(InputError, match="K ≥ 4 control poses"):
        SplineTrajectory(0, 0.1, np.stack([np.eye(3)] * 3), np.zeros((3, 3)))
    with pytest.raises(InputError, match="rotation matrices"):
        SplineTrajectory(0, 0.1, np.stack([2 * np.eye(3)] * 4), np.zeros((4, 3)))
    with pytest.raises(InputError, match="positive time between knots"):
        SplineTrajectory(0, 0.0, np.stack([np.eye(3)] * 4), np.zeros((4, 3)))
