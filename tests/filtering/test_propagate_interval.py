"""The forward pass over a scan: clipping, the input of each step, holding, gaps (docs/lidar_inertial_odometry.md, section 3)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.filtering.nav_state import TANGENT, NavState
from boxplus.filtering.propagation import (
    FOLLOWED,
    N_P,
    N_R,
    N_TIME,
    N_V,
    N_W,
    NODE,
    propagate_interval,
    propagate_step,
    transition,
)
from boxplus.manifolds import so3
from tests.filtering.random_states import random_covariance, random_state

DENSITY = np.array([1e-3, 2e-2, 3e-4, 4e-3]) ** 2
GAP_DENSITY = np.array([0.5, 3.0, 1e-4, 1e-3]) ** 2
MAX_GAP = 0.15
seeds = st.integers(0, 2**32 - 1)


def _forward(
    x: NavState, cov: np.ndarray, time: np.ndarray, gyro: np.ndarray, accel: np.ndarray, duration: float, max_gap: float = MAX_GAP
) -> tuple[NavState, np.ndarray, np.ndarray]:
    packed, cov, nodes = x.pack(), cov.copy(), np.full((len(time) + 3, NODE), np.nan)
    count = propagate_interval(packed, cov, time, gyro, accel, duration, DENSITY, max_gap, GAP_DENSITY, nodes)
    return NavState.unpack(packed), cov, nodes[:count]


def _reference(
    x: NavState, cov: np.ndarray, time: np.ndarray, gyro: np.ndarray, accel: np.ndarray, duration: float
) -> tuple[NavState, np.ndarray, list[float]]:
    """The same in words: the mean of the two samples around each step, the nearest one outside of them."""
    bounds = [0.0, *[t for t in time if 0.0 < t < duration], duration]
    packed, cov = x.pack(), cov.copy()
    for begin, end in pairwise(bounds):
        middle = 0.5 * (begin + end)
        after = int(np.searchsorted(time, middle))
        around = [max(after - 1, 0), min(after, len(time) - 1)]
        propagate_step(packed, cov, gyro[around].mean(axis=0), accel[around].mean(axis=0), end - begin, DENSITY, np.zeros(NODE))
    return NavState.unpack(packed), cov, bounds


@settings(max_examples=50)
@given(seeds, st.integers(1, 12), st.floats(-0.02, 0.06), st.floats(0.01, 0.12))
def test_against_the_specification(seed: int, samples: int, first: float, duration: float) -> None:
    random = np.random.default_rng(seed)
    time = first + np.cumsum(random.uniform(0.002, 0.02, samples))
    gyro, accel = random.normal(size=(samples, 3)), 10.0 * random.normal(size=(samples, 3))
    x, cov = random_state(random), random_covariance(random)
    state, covariance, nodes = _forward(x, cov, time, gyro, accel, duration)
    expected, expected_cov, bounds = _reference(x, cov, time, gyro, accel, duration)
    assert np.allclose(state.pack(), expected.pack(), atol=1e-12)
    assert np.allclose(covariance, expected_cov, rtol=1e-9, atol=1e-12)
    assert np.array_equal(nodes[:, N_TIME], bounds[:-1])


@given(seeds)
def test_nodes_continue_one_another(seed: int) -> None:
    random = np.random.default_rng(seed)
    time = np.arange(-0.004, 0.11, 0.005)
    gyro, accel = random.normal(size=(len(time), 3)), 10.0 * random.normal(size=(len(time), 3))
    x = random_state(random)
    state, _, nodes = _forward(x, np.eye(TANGENT), time, gyro, accel, 0.1)
    assert np.array_equal(nodes[0, N_R:N_P], x.pack()[:9])
    ends = np.append(nodes[1:, N_TIME], 0.1)
    for node, end, after in zip(nodes, ends, [*nodes[1:], None], strict=True):
        s = end - node[N_TIME]
        R_end = node[N_R:N_P].reshape(3, 3) @ so3.exp(node[N_W:] * s)
        p_end = node[N_P:N_V] + node[N_V : N_V + 3] * s + 0.5 * node[N_V + 3 : N_W] * s**2
        expected_R = state.R_world_imu if after is None else after[N_R:N_P].reshape(3, 3)
        expected_p = state.p_world_imu if after is None else after[N_P:N_V]
        assert np.allclose(R_end, expected_R, atol=1e-12)
        assert np.allclose(p_end, expected_p, atol=1e-11)


def test_a_constant_input_does_not_care_where_the_samples_lie() -> None:
    random = np.random.default_rng(0)
    x, gyro, accel = random_state(random), random.normal(size=3), random.normal(size=3)
    expected = None
    for time in ([0.05], [-0.01, 0.2], [0.0, 0.1], [-0.05, 0.02, 0.07]):
        n = len(time)
        state, _, _ = _forward(
            x, np.eye(TANGENT), np.array(time), np.tile(gyro, (n, 1)), np.tile(accel, (n, 1)), 0.1, max_gap=1.0
        )
        expected = state if expected is None else expected
        assert np.allclose(state.R_world_imu, expected.R_world_imu, atol=1e-12)


def test_across_a_gap_velocity_is_held_and_the_covariance_widens() -> None:
    random = np.random.default_rng(1)
    x = random_state(random)
    turn = x.bias_gyro + np.array([0.0, 0.0, 1.0])
    gyro = np.array([turn, turn, 50.0 * np.ones(3), 50.0 * np.ones(3)])
    accel = 10.0 * random.normal(size=(4, 3))
    x0 = x.boxplus(np.zeros(TANGENT))
    time = np.array([-0.4, 0.0, 0.5, 0.505])
    start = 1e-4 * np.eye(TANGENT)
    state, cov, nodes = _forward(x0, start, time, gyro, accel, 0.3)
    assert len(nodes) == 1
    assert np.allclose(state.v_world_imu, x.v_world_imu, atol=1e-12)
    assert np.allclose(state.p_world_imu, x.p_world_imu + 0.3 * x.v_world_imu, atol=1e-12)
    assert np.allclose(state.R_world_imu, x.R_world_imu @ so3.exp([0.0, 0.0, 0.3]), atol=1e-12)
    _, believed, _ = _forward(x0, start, time, gyro, accel, 0.3, max_gap=1.0)
    assert np.all(cov.diagonal()[:9] > 3.0 * believed.diagonal()[:9])
    assert np.linalg.eigvalsh(cov).min() > 0


def test_a_gap_that_began_before_the_scan_is_a_gap_in_all_of_it() -> None:
    x = NavState.identity()
    gyro, accel = np.zeros((2, 3)), np.tile([5.0, 0.0, 9.81], (2, 1))
    state, _, _ = _forward(x, np.eye(TANGENT), np.array([-0.2, 0.02]), gyro, accel, 0.02)
    assert np.array_equal(state.v_world_imu, np.zeros(3))


def test_samples_missing_at_the_end_are_held_or_bridged() -> None:
    x = NavState.identity()
    gyro, accel = np.zeros((2, 3)), np.tile([5.0, 0.0, 9.81], (2, 1))
    time = np.array([0.0, 0.1])
    held, _, _ = _forward(x, np.eye(TANGENT), time, gyro, accel, 0.2)
    assert np.allclose(held.v_world_imu, [1.0, 0.0, 0.0])
    bridged, _, _ = _forward(x, np.eye(TANGENT), time, gyro, accel, 0.3)
    assert np.allclose(bridged.v_world_imu, [0.5, 0.0, 0.0])


def test_thousands_of_steps_leave_a_rotation() -> None:
    random = np.random.default_rng(2)
    x, cov = random_state(random), np.eye(TANGENT)
    x = NavState.unpack(x.pack() * (1.0 + 1e-7))  # rotations that are no longer orthonormal
    time = np.linspace(0.0, 0.1, 21)
    for _ in range(50):
        x, cov, _ = _forward(x, cov, time, 5.0 * random.normal(size=(21, 3)), random.normal(size=(21, 3)), 0.1)
    assert so3.is_rotation(x.R_world_imu, 1e-13)
    assert so3.is_rotation(x.R_imu_lidar, 1e-13)


def test_an_interval_without_length_has_a_node_and_changes_nothing() -> None:
    random = np.random.default_rng(3)
    x, cov = random_state(random), random_covariance(random)
    state, covariance, nodes = _forward(x, cov, np.array([-0.1, 0.1]), np.ones((2, 3)), np.ones((2, 3)), 0.0)
    assert len(nodes) == 1
    assert np.allclose(state.pack(), x.pack(), atol=1e-14)
    assert np.allclose(covariance, cov, rtol=1e-12)


@settings(max_examples=50)
@given(seeds, st.integers(2, 12), st.floats(0.01, 0.12))
def test_the_transition_carries_a_covariance_as_the_pass_does(seed: int, samples: int, duration: float) -> None:
    """Across a gap too; what the noise adds is the difference to a pass without errors at its beginning."""
    random = np.random.default_rng(seed)
    time = np.cumsum(random.uniform(0.002, 0.03, samples))
    gyro, accel = random.normal(size=(samples, 3)), 10.0 * random.normal(size=(samples, 3))
    x, cov = random_state(random), random_covariance(random)
    state, carried, nodes = _forward(x, cov, time, gyro, accel, duration, max_gap=0.02)
    _, noise, _ = _forward(x, np.zeros((TANGENT, TANGENT)), time, gyro, accel, duration, max_gap=0.02)
    Phi = np.eye(TANGENT)
    Phi[:FOLLOWED, :FOLLOWED] = transition(nodes, duration, state.gravity_world)
    np.testing.assert_allclose(Phi @ cov @ Phi.T + noise, carried, rtol=1e-9, atol=1e-9)
