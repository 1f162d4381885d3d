"""The iterated update against the textbook gain and against a general solver of the same problem.

Derivation: docs/lidar_inertial_odometry.md, section 7.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from boxplus.filtering.nav_state import MEASURED, TANGENT, NavState
from boxplus.filtering.update_step import map_step, move_covariance
from boxplus.manifolds import so3
from tests.filtering.random_states import derivative, random_covariance, random_state

seeds = st.integers(0, 2**32 - 1)


def _step(x: NavState, prior: NavState, cov: np.ndarray, A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
    delta, posterior = np.zeros(TANGENT), np.zeros((TANGENT, TANGENT))
    ok = map_step(x.pack(), prior.pack(), cov, A, b, delta, posterior)
    return delta, posterior, ok


def _inverse_jacobian(d: np.ndarray) -> np.ndarray:
    """J of docs/lidar_inertial_odometry.md, section 7 inverted: the right Jacobians of the two rotations."""
    return block_diag(so3.right_jacobian(d[:3]), np.eye(15), so3.right_jacobian(d[18:21]), np.eye(3))


@settings(max_examples=50)
@given(seeds, st.integers(1, 40), st.sampled_from([0.0, 0.1, 1.0]))
def test_a_step_is_the_textbook_kalman_update(seed: int, rows: int, distance: float) -> None:
    random = np.random.default_rng(seed)
    prior, cov = random_state(random), random_covariance(random)
    x = prior.boxplus(distance * random.normal(size=TANGENT))
    H = np.zeros((rows, TANGENT))
    H[:, MEASURED] = random.normal(size=(rows, 12))
    z, r = random.normal(size=rows), 10.0 ** random.uniform(-3, 0, rows)
    A, b = H[:, MEASURED].T @ (H[:, MEASURED] / r[:, None]), H[:, MEASURED].T @ (z / r)
    delta, posterior, ok = _step(x, prior, cov, A, b)
    assert ok
    d = x.boxminus(prior)
    Ji = _inverse_jacobian(d)
    P = Ji @ cov @ Ji.T
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(r))
    expected = -K @ z - (np.eye(TANGENT) - K @ H) @ Ji @ d
    sigma = np.sqrt(P.diagonal())
    assert np.allclose(delta / sigma, expected / sigma, atol=1e-5 * max(1.0, np.abs(expected / sigma).max()))
    assert np.allclose(posterior / np.outer(sigma, sigma), (np.eye(TANGENT) - K @ H) @ P / np.outer(sigma, sigma), atol=1e-6)


def test_a_scan_that_says_nothing_leaves_the_prior() -> None:
    random = np.random.default_rng(0)
    prior, cov = random_state(random), random_covariance(random)
    delta, posterior, ok = _step(prior, prior, cov, np.zeros((12, 12)), np.zeros(12))
    assert ok
    assert not delta.any()
    assert np.allclose(posterior, cov, rtol=1e-7, atol=1e-9)


def test_a_step_back_to_the_prior_without_a_measurement() -> None:
    random = np.random.default_rng(1)
    prior, cov = random_state(random), random_covariance(random)
    x = prior.boxplus(0.5 * random.normal(size=TANGENT))
    delta, _, _ = _step(x, prior, cov, np.zeros((12, 12)), np.zeros(12))
    # −J⁻¹ d leads back in one step: J_r(θ) θ = θ.
    assert np.allclose(x.boxplus(delta).pack(), prior.pack(), atol=1e-7)


def _bearings(random: np.random.Generator, truth: NavState, count: int) -> tuple[Callable[[NavState], np.ndarray], np.ndarray]:
    """Points on planes seen from `truth`: residuals of a state, and their standard deviation."""
    points, normals = 8.0 * random.normal(size=(count, 3)), random.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    def world(x: NavState) -> np.ndarray:
        return (points @ x.R_imu_lidar.T + x.p_imu_lidar) @ x.R_world_imu.T + x.p_world_imu

    offsets = np.einsum("ij,ij->i", normals, world(truth)) + 0.02 * random.normal(size=count)
    return lambda x: np.einsum("ij,ij->i", normals, world(x)) - offsets, np.full(count, 0.02)


@settings(max_examples=15)
@given(seeds)
def test_iterating_reaches_the_maximum_a_posteriori(seed: int) -> None:
    random = np.random.default_rng(seed)
    prior = random_state(random)
    sigma = np.repeat([0.3, 0.5, 1.0, 0.01, 0.1, 0.1, 0.1, 0.1], 3)
    correlation = random_covariance(random)
    correlation /= np.sqrt(np.outer(correlation.diagonal(), correlation.diagonal()))
    cov = np.outer(sigma, sigma) * correlation
    truth = prior.boxplus(np.linalg.cholesky(cov) @ random.normal(size=TANGENT))
    residuals, sigma_z = _bearings(random, truth, 60)

    x = prior
    for _ in range(30):
        z = residuals(x)
        H = derivative(lambda e, x=x: residuals(x.boxplus(e)), TANGENT)[:, MEASURED]
        A, b = H.T @ (H / sigma_z[:, None] ** 2), H.T @ (z / sigma_z**2)
        delta, posterior, ok = _step(x, prior, cov, A, b)
        assert ok
        x = x.boxplus(delta)
        if np.abs(delta).max() < 1e-9:
            break
    root = np.linalg.inv(np.linalg.cholesky(cov))

    def whole(d: np.ndarray) -> np.ndarray:
        return np.concatenate([residuals(prior.boxplus(d)) / sigma_z, root @ d])

    # The cost over the tangent space of the prior, minimised from the filter's answer by another method: it stays there.
    found = x.boxminus(prior)
    solution = least_squares(whole, found, xtol=1e-14, ftol=1e-14, gtol=1e-12)
    assert np.allclose(solution.x / sigma, found / sigma, atol=1e-4)
    # The posterior covariance is that of the problem in the tangent space at the estimate.
    J = derivative(lambda e: whole(x.boxplus(e).boxminus(prior)), TANGENT)
    move_covariance(posterior, delta)
    expected = np.linalg.inv(J.T @ J)
    assert np.allclose(posterior / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=1e-5)
    assert np.array_equal(posterior, posterior.T)
    assert np.linalg.eigvalsh(posterior / np.outer(sigma, sigma)).min() > 0


@given(seeds)
def test_a_measurement_never_adds_uncertainty(seed: int) -> None:
    random = np.random.default_rng(seed)
    prior, cov, A = random_state(random), random_covariance(random), random_covariance(random, 12)
    _, posterior, ok = _step(prior, prior, cov, A, random.normal(size=12))
    assert ok
    sigma = np.sqrt(cov.diagonal())
    difference = (cov - posterior) / np.outer(sigma, sigma)
    assert np.linalg.eigvalsh(0.5 * (difference + difference.T)).min() > -1e-9


@given(seeds, st.sampled_from([0.0, 1e-3, 0.5]))
def test_the_covariance_moves_to_the_new_tangent_space(seed: int, size: float) -> None:
    random = np.random.default_rng(seed)
    cov, delta = random_covariance(random), size * random.normal(size=TANGENT)
    moved = cov.copy()
    move_covariance(moved, delta)
    x = random_state(random)
    # ∂[(x ⊞ (δ + e)) ⊟ (x ⊞ δ)] / ∂e
    L = derivative(lambda e: x.boxplus(delta + e).boxminus(x.boxplus(delta)), TANGENT)
    assert np.allclose(moved, L @ cov @ L.T, atol=1e-8 * np.abs(cov).max())
    assert np.array_equal(moved, moved.T)
    assert np.linalg.eigvalsh(moved).min() > 0


def test_what_is_no_covariance_is_refused() -> None:
    prior = random_state(np.random.default_rng(2))
    bad = np.eye(TANGENT)
    bad[4, 4] = -1.0
    assert not _step(prior, prior, bad, np.zeros((12, 12)), np.zeros(12))[2]
    assert not _step(prior, prior, np.eye(TANGENT), -2.0 * np.eye(12), np.zeros(12))[2]
    assert not _step(prior, prior, np.full((TANGENT, TANGENT), np.nan), np.zeros((12, 12)), np.zeros(12))[2]
