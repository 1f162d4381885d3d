"""Depths by the motion: the filter against its posterior on a grid, outliers, and points of keyframes that are carried over."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.manifolds import se3
from boxplus.sensors.images.image import Image
from boxplus.systems.direct_odometry.depth.depth_filter import DepthFilter, depth_from, depth_of_two
from boxplus.systems.direct_odometry.depth.epipolar_search import pixels_per_inverse_depth
from boxplus.systems.direct_odometry.depth.sensed_depth import SensedDepth
from boxplus.systems.direct_odometry.direct_odometry import DirectOdometry
from tests.systems.direct_odometry.scenes import CAMERA, SHAPE, Room

ONE = np.ones(1, dtype=np.bool_)


def posterior_moments(mu: float, sigma: float, a: float, b: float, span: float, x: float, tau: float) -> tuple[float, ...]:
    """Mean and standard deviation of ρ, first and second moment of π, by sums over a grid."""
    rho = np.linspace(mu - 12.0 * sigma, mu + 12.0 * sigma, 20_001)
    pi = (np.arange(2000) + 0.5) / 2000.0
    prior_rho = np.exp(-0.5 * ((rho - mu) / sigma) ** 2)
    prior_pi = pi ** (a - 1.0) * (1.0 - pi) ** (b - 1.0)
    seen = np.exp(-0.5 * ((x - rho) / tau) ** 2) / (np.sqrt(2.0 * np.pi) * tau)
    # p(ρ, π | x) ∝ (π seen + (1 − π)/span) prior_rho prior_pi: two products.
    inlier = (prior_rho * seen, pi * prior_pi)
    outlier = (prior_rho / span, (1.0 - pi) * prior_pi)
    total = sum(r.sum() * p.sum() for r, p in (inlier, outlier))
    mean = sum((rho * r).sum() * p.sum() for r, p in (inlier, outlier)) / total
    square = sum((rho**2 * r).sum() * p.sum() for r, p in (inlier, outlier)) / total
    first = sum(r.sum() * (pi * p).sum() for r, p in (inlier, outlier)) / total
    second = sum(r.sum() * (pi**2 * p).sum() for r, p in (inlier, outlier)) / total
    return mean, np.sqrt(square - mean**2), first, second


@settings(max_examples=30, deadline=None)
@given(
    sigma=st.floats(0.01, 0.1), a=st.floats(1.0, 8.0), b=st.floats(1.0, 8.0), off=st.floats(-4.0, 4.0), tau=st.floats(0.01, 0.1)
)
def test_an_update_has_the_moments_of_the_posterior(sigma: float, a: float, b: float, off: float, tau: float) -> None:
    mu, span = 0.5, 1.0
    x = mu + off * np.hypot(sigma, tau)
    state = DepthFilter(*(np.array([value]) for value in (mu, sigma, a, b, span)))
    state.update(np.array([x]), np.array([tau]), ONE, ~ONE)
    after_a, after_b = float(state.a[0]), float(state.b[0])
    n = after_a + after_b
    found = (state.mu[0], state.sigma[0], after_a / n, after_a * (after_a + 1.0) / (n * (n + 1.0)))
    np.testing.assert_allclose(found, posterior_moments(mu, sigma, a, b, span, x, tau), rtol=2e-3)


def test_views_that_agree_are_believed_and_others_are_not() -> None:
    rng, n = np.random.default_rng(0), 2000
    truth = rng.uniform(0.2, 1.0, n)
    state = DepthFilter.over(np.full(n, 1.2), np.full(n, 0.1))
    is_wrong = rng.uniform(size=n) < 0.3  # points that no two views see at the same place
    tau = np.full(n, 0.01)
    for _ in range(4):
        x = np.where(is_wrong, rng.uniform(0.1, 1.2, n), truth + rng.normal(0.0, 0.01, n))
        lost = is_wrong & (rng.uniform(size=n) < 0.5)
        state.update(x, tau, ~lost, lost)
    believed = state.believed(4)
    assert believed[~is_wrong].mean() > 0.9
    assert believed[is_wrong].mean() < 0.1
    error = (state.mu - truth)[believed & ~is_wrong] / state.sigma[believed & ~is_wrong]
    assert 0.7 < np.sqrt(np.mean(np.minimum(np.abs(error), 4.0) ** 2)) < 1.4


@pytest.mark.parametrize("seed", range(3))
def test_the_line_of_a_pixel_is_followed_as_far_as_it_moves(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(0.0, 0.1, 6))
    rays = np.column_stack([rng.uniform(-0.5, 0.5, (30, 2)), np.ones(30)])
    rho, step = rng.uniform(0.1, 1.0, 30), 1e-6

    def pixels(at: np.ndarray) -> np.ndarray:
        return CAMERA.project(se3.act(T, rays / at[:, None]))[0]

    moved = np.linalg.norm(pixels(rho + step) - pixels(rho - step), axis=1) / (2.0 * step)
    np.testing.assert_allclose(pixels_per_inverse_depth(T, rays, rho, CAMERA.fx), moved, rtol=1e-4)


def seen(room: Room, T: np.ndarray, rng: np.random.Generator) -> tuple[Image, np.ndarray]:
    grey, z = room.render(T)
    return Image.from_array(grey + rng.normal(0.0, 1.0, SHAPE)), z


@pytest.mark.parametrize("seed", range(2))
def test_motion_tells_depths_with_their_standard_deviation(seed: int) -> None:
    rng, room = np.random.default_rng(seed), Room(seed)
    T = se3.exp([0.02, -0.03, 0.01, 0.2, 0.05, -0.03])
    (one, z), (two, _) = seen(room, se3.SE3.identity(), rng), seen(room, T, rng)
    found = depth_of_two(one, two, CAMERA, se3.inverse(T), (0.2, 1.5))
    known = found.z > 0.0
    error = (found.z - z)[known] / found.sigma[known]
    assert known.sum() > 1000 and not found.is_measured.any()
    assert np.mean(np.abs(error) > 5.0) < 0.05
    assert 0.3 < np.median(np.abs(error)) / 0.6745 < 1.3


def test_keyframes_hand_on_what_they_know_through_a_turn() -> None:
    """Without any parallax, depths are those of points that earlier keyframes have."""
    rng, room = np.random.default_rng(3), Room(3)
    odometry = DirectOdometry(CAMERA)
    one, z = seen(room, se3.SE3.identity(), rng)
    odometry.push_rgbd(0, one, z)
    turn = se3.exp([0.0, 0.15, 0.0, 0.0, 0.0, 0.0])
    two, z_turned = seen(room, turn, rng)
    found = depth_from(odometry.window.keyframes, two, CAMERA, turn, 0.0)
    known = found.z > 0.0
    assert known.sum() > 100
    assert np.median(np.abs(found.z / z_turned - 1.0)[known]) < 0.02
    some = np.zeros(SHAPE, dtype=np.bool_)
    some[:60] = True
    assert not depth_from(odometry.window.keyframes, two, CAMERA, turn, 0.0, some).z[60:].any()


def test_depths_that_a_sensor_did_not_measure_are_filled_in() -> None:
    measured = SensedDepth(*(np.array([[1.0, 0.0]], np.float32) for _ in range(2)), np.array([[True, False]]))
    other = SensedDepth(np.full((1, 2), 3.0, np.float32), np.full((1, 2), 0.5, np.float32), np.zeros((1, 2), np.bool_))
    both = measured.filled(other)
    assert both.z.tolist() == [[1.0, 3.0]] and both.sigma.tolist() == [[1.0, 0.5]]
    assert both.is_measured.tolist() == [[True, False]]
