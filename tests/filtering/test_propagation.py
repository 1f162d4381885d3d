"""One step of the IMU propagation: Jacobians, noise, and the motions that have closed solutions.

Derivation: docs/lidar_inertial_odometry.md, section 2.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.filtering.nav_state import TANGENT, NavState
from boxplus.filtering.propagation import N_A, N_P, N_R, N_V, N_W, NODE, P, R, V, propagate_step
from boxplus.manifolds import so3
from tests.filtering.random_states import derivative, random_covariance, random_state

SILENT = np.zeros(4)
DENSITY = np.array([1e-3, 2e-2, 3e-4, 4e-3]) ** 2
seeds = st.integers(0, 2**32 - 1)


def _step(
    x: NavState, gyro: np.ndarray, accel: np.ndarray, dt: float, cov: np.ndarray | None = None, density: np.ndarray = SILENT
) -> tuple[NavState, np.ndarray]:
    packed = x.pack()
    cov = np.zeros((TANGENT, TANGENT)) if cov is None else cov.copy()
    propagate_step(packed, cov, np.array(gyro, float), np.array(accel, float), dt, density, np.zeros(NODE))
    return NavState.unpack(packed), cov


def _numeric(x: NavState, gyro: np.ndarray, accel: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """F_x (24, 24) and F_w (24, 12) by differences of the mean's propagation alone."""
    end = _step(x, gyro, accel, dt)[0]

    def disturbed(noise: np.ndarray) -> np.ndarray:
        # measured = true + bias + noise; a bias walks by its noise times dt.
        moved = _step(x, gyro - noise[:3], accel - noise[3:6], dt)[0]
        walked = np.zeros(TANGENT)
        walked[9:15] = noise[6:] * dt
        return moved.boxplus(walked).boxminus(end)

    F_x = derivative(lambda e: _step(x.boxplus(e), gyro, accel, dt)[0].boxminus(end), TANGENT)
    return F_x, derivative(disturbed, 12)


@settings(max_examples=25)
@given(seeds, st.sampled_from([5e-3, 0.1, 0.4]), st.sampled_from([0.0, 1e-6, 0.5, 3.0]))
def test_covariance_follows_the_numeric_jacobians(seed: int, dt: float, rate: float) -> None:
    random = np.random.default_rng(seed)
    x, cov = random_state(random), random_covariance(random)
    gyro, accel = x.bias_gyro + rate * random.normal(size=3), 10.0 * random.normal(size=3)
    F_x, F_w = _numeric(x, gyro, accel, dt)
    assert np.allclose(_step(x, gyro, accel, dt, cov)[1], F_x @ cov @ F_x.T, atol=1e-9 * np.abs(cov).max(), rtol=1e-9)
    Q = np.kron(np.diag(DENSITY / dt), np.eye(3))
    noise = _step(x, gyro, accel, dt, density=DENSITY)[1]
    expected = F_w @ Q @ F_w.T
    sigma = np.sqrt(expected.diagonal())  # of the position only 2e-7: the differences leave six of its digits
    assert np.all(np.abs(noise - expected) <= 1e-5 * np.outer(sigma, sigma))


@pytest.mark.parametrize("column", range(TANGENT))
def test_every_column_of_the_jacobian(column: int) -> None:
    random = np.random.default_rng(column)
    x = random_state(random)
    gyro, accel, dt = random.normal(size=3), 10.0 * random.normal(size=3), 0.2
    f = _numeric(x, gyro, accel, dt)[0][:, column]
    unit = np.zeros((TANGENT, TANGENT))
    unit[column, column] = 1.0
    # A covariance along one axis only shows F's column in its outer product with itself.
    assert np.allclose(_step(x, gyro, accel, dt, unit)[1], np.outer(f, f), atol=1e-9)


@settings(max_examples=20)
@given(seeds, st.integers(2, 5))
def test_noise_does_not_depend_on_the_rate(seed: int, factor: int) -> None:
    random = np.random.default_rng(seed)
    x = random_state(random)
    gyro, accel = random.normal(size=3), 10.0 * random.normal(size=3)
    results = []
    for steps in (100, 100 * factor):
        state, cov = x, np.zeros((TANGENT, TANGENT))
        for _ in range(steps):
            state, cov = _step(state, gyro, accel, 0.5 / steps, cov, DENSITY)
        results.append(cov)
    sigma = np.sqrt(results[1].diagonal())
    # Only the discretisation differs, by the order of one step in a hundred; a per-sample noise would differ by `factor`.
    assert np.all(np.abs(results[0] - results[1]) <= 0.02 * np.outer(sigma, sigma))


@given(seeds, st.integers(1, 7))
def test_turning_about_a_fixed_axis_is_exact(seed: int, steps: int) -> None:
    random = np.random.default_rng(seed)
    x, rate = random_state(random), 3.0 * random.normal(size=3)
    state = x
    for _ in range(steps):
        state, _ = _step(state, x.bias_gyro + rate, np.zeros(3), 0.7 / steps)
    assert np.allclose(state.R_world_imu, x.R_world_imu @ so3.exp(0.7 * rate), atol=1e-13)


@given(seeds, st.integers(1, 7))
def test_free_fall_is_exact(seed: int, steps: int) -> None:
    x = random_state(np.random.default_rng(seed))
    state, t = x, 1.3
    for _ in range(steps):  # an accelerometer in free fall reads its bias, however it tumbles
        state, _ = _step(state, np.array([2.0, -1.0, 3.0]), x.bias_accel, t / steps)
    assert np.allclose(state.p_world_imu, x.p_world_imu + x.v_world_imu * t + 0.5 * x.gravity_world * t**2, atol=1e-12)
    assert np.allclose(state.v_world_imu, x.v_world_imu + x.gravity_world * t, atol=1e-12)


@given(seeds, st.integers(1, 7))
def test_constant_acceleration_is_exact(seed: int, steps: int) -> None:
    random = np.random.default_rng(seed)
    x, a_world, t = random_state(random), 5.0 * random.normal(size=3), 0.9
    reading = x.R_world_imu.T @ (a_world - x.gravity_world) + x.bias_accel
    state = x
    for _ in range(steps):
        state, _ = _step(state, x.bias_gyro, reading, t / steps)
    assert np.allclose(state.p_world_imu, x.p_world_imu + x.v_world_imu * t + 0.5 * a_world * t**2, atol=1e-12)
    assert np.allclose(state.v_world_imu, x.v_world_imu + a_world * t, atol=1e-12)


def test_what_does_not_move_stays() -> None:
    random = np.random.default_rng(1)
    x = random_state(random)
    moved = _step(x, random.normal(size=3), random.normal(size=3), 0.1, random_covariance(random), DENSITY)[0]
    assert np.array_equal(moved.pack()[15:], x.pack()[15:])  # biases, gravity, extrinsic


@given(seeds)
def test_covariance_stays_symmetric_and_positive(seed: int) -> None:
    random = np.random.default_rng(seed)
    state, cov = random_state(random), random_covariance(random)
    for _ in range(5):
        state, cov = _step(state, random.normal(size=3), 10.0 * random.normal(size=3), 0.1, cov, DENSITY)
    assert np.array_equal(cov, cov.T)
    assert np.linalg.eigvalsh(cov).min() > 0


def test_the_node_holds_the_head_of_the_step() -> None:
    random = np.random.default_rng(2)
    x = random_state(random)
    gyro, accel = random.normal(size=3), random.normal(size=3)
    packed, node = x.pack(), np.zeros(NODE)
    propagate_step(packed, np.zeros((TANGENT, TANGENT)), gyro, accel, 0.1, SILENT, node)
    before = x.pack()
    assert np.array_equal(node[N_R:N_P], before[R:P])
    assert np.array_equal(node[N_P:N_V], before[P:V])
    assert np.array_equal(node[N_V:N_A], x.v_world_imu)
    assert np.allclose(node[N_A:N_W], x.R_world_imu @ (accel - x.bias_accel) + x.gravity_world, atol=1e-14)
    assert np.allclose(node[N_W:], gyro - x.bias_gyro, atol=1e-16)
