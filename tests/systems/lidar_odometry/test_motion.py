"""The motion between two states against central differences, and its prior against the equations it stands for."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.manifolds import so3
from boxplus.sensors.lidar.deskew import deskew_into
from boxplus.systems.lidar_odometry.motion import DOF, MotionBetween, MotionState, joint_prior, nav_state

seeds = st.integers(0, 2**32 - 1)


def _states(seed: int) -> tuple[MotionState, MotionState]:
    """Two states 0.1 s apart, as a brisk hand makes them."""
    random = np.random.default_rng(seed)
    first = MotionState(
        5_000_000_000, so3.exp(random.normal(0, 1, 3)), random.normal(0, 5, 3), random.normal(0, 1.5, 3), random.normal(0, 3, 3)
    )
    jerked = random.normal(0, 1, DOF) * np.repeat([0.003, 0.01, 0.5, 0.5], 3)
    return first, first.predicted(5_100_000_000).plus(jerked)


def _at(motion: MotionBetween, seconds: float, p_lidar: np.ndarray) -> np.ndarray:
    """In the world, a point that was seen so long after the first state."""
    turn, p, _ = motion.poses(np.array([seconds]))
    return motion.first.R_world_lidar @ so3.exp(turn[0]) @ p_lidar + p[0]


@settings(max_examples=25)
@given(seeds, st.floats(0.0, 0.1))
def test_a_point_moves_with_the_states_as_the_jacobian_says(seed: int, seconds: float) -> None:
    first, last = _states(seed)
    motion = MotionBetween(first, last)
    p_lidar = np.random.default_rng(seed).normal(0, 10, 3)
    p_world = _at(motion, seconds, p_lidar)
    # The error [θ, p] of the last pose moves a point of the world by R θ × (y − p_last) + p.
    of_pose = np.hstack([-so3.hat(p_world - last.p_world_lidar) @ last.R_world_lidar, np.eye(3)])
    analytic = of_pose @ motion.jacobians(np.array([seconds]))[0]
    step = 1e-6
    for k in range(2 * DOF):
        delta = np.zeros(2 * DOF)
        delta[k] = step
        ahead = MotionBetween(first.plus(delta[:DOF]), last.plus(delta[DOF:]))
        behind = MotionBetween(first.plus(-delta[:DOF]), last.plus(-delta[DOF:]))
        numeric = (_at(ahead, seconds, p_lidar) - _at(behind, seconds, p_lidar)) / (2 * step)
        # Left out are terms of the second order in the turning between the states.
        assert np.abs(numeric - analytic[:, k]).max() < 0.02 * max(1.0, np.abs(numeric).max()), k


@settings(max_examples=10)
@given(seeds)
def test_the_motion_meets_its_states(seed: int) -> None:
    first, last = _states(seed)
    motion = MotionBetween(first, last)
    turn, p, v = motion.poses(np.array([0.0, 0.1]))
    np.testing.assert_allclose(first.R_world_lidar @ so3.exp(turn), [first.R_world_lidar, last.R_world_lidar], atol=1e-9)
    np.testing.assert_allclose(p, [first.p_world_lidar, last.p_world_lidar], atol=1e-9)
    np.testing.assert_allclose(v, [first.velocity, last.velocity], atol=1e-9)
    step = 1e-5
    turn = motion.poses(np.array([0.0, step, 0.1 - step, 0.1]))[0]
    R = so3.exp(turn)
    np.testing.assert_allclose(so3.log(R[0].T @ R[1]) / step, first.rate, atol=1e-3)
    np.testing.assert_allclose(so3.log(R[2].T @ R[3]) / step, last.rate, atol=1e-3)


@settings(max_examples=10)
@given(seeds)
def test_points_are_deskewed_as_the_motion_goes(seed: int) -> None:
    first, last = _states(seed)
    motion = MotionBetween(first, last)
    random = np.random.default_rng(seed)
    p_lidar = random.normal(0, 10, (50, 3)).astype(np.float32)
    seconds = np.sort(random.uniform(0, 0.1, 50))
    time_ns = first.time_ns + np.rint(seconds * 1e9).astype(np.int64)
    out = np.empty_like(p_lidar)
    nodes = motion.nodes(np.linspace(0.0, 0.1, 101))
    deskew_into(p_lidar, time_ns, first.time_ns, nodes, len(nodes), nav_state(last).pack(), out)
    p_world = np.array([_at(motion, (t - first.time_ns) * 1e-9, p.astype(float)) for t, p in zip(time_ns, p_lidar, strict=True)])
    # Between nodes the turn rate is held, which goes away with the square of their distance.
    np.testing.assert_allclose(out @ last.R_world_lidar.T + last.p_world_lidar, p_world, atol=3e-4)


def test_the_prior_is_the_integral_of_white_noise() -> None:
    state = MotionState(0, np.eye(3), np.zeros(3), np.zeros(3), np.array([1.0, 2.0, 3.0]))
    cov, density = 0.01 * np.eye(DOF), np.array([0.5, 2.0])
    joint = joint_prior(state, cov, 0.1, density)
    assert np.linalg.eigvalsh(joint).min() > 0
    # Against many small steps, which add q dt to the velocities only.
    F, P = np.eye(DOF), cov.copy()
    step = 0.1 / 2000
    F[0:3, 6:9] = F[3:6, 9:12] = step * np.eye(3)
    for _ in range(2000):
        P = F @ P @ F.T
        P[6:, 6:] += step * np.diag(np.repeat(density, 3))
    np.testing.assert_allclose(joint[DOF:, DOF:], P, rtol=2e-3, atol=1e-9)
