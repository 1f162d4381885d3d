"""Directions that a scan does not determine: found as such, and nothing else is.

Derivation: docs/lidar_inertial_odometry.md, section 8.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.filtering.degeneracy import PoseDirections, pose_directions, strong_covariance, strong_step, threshold_for
from boxplus.filtering.nav_state import NavState
from tests.filtering.noisy_planes import LEVER_ARM, information, noise, tilted, tube, unit_vector
from tests.filtering.random_states import random_state

THRESHOLD = 2.5
seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_a_tube_has_one_weak_direction_along_its_axis(seed: int) -> None:
    axis = unit_vector(seed)
    x, normals, p_imu = tube(seed, axis)
    A, _ = information(x, normals, p_imu, np.zeros(len(normals)))
    directions = pose_directions(A[:6, :6], noise(x, normals, p_imu), LEVER_ARM, THRESHOLD)
    assert directions.weak.tolist() == [True, False, False, False, False, False]
    assert directions.ratios[0] < 1e-9
    assert np.allclose(directions.vectors[:3, 0], 0, atol=1e-6)
    assert np.isclose(abs(directions.vectors[3:, 0] @ axis), 1.0)


@settings(max_examples=20)
@given(seeds)
def test_along_a_tube_of_noisy_normals_the_ratio_is_one(seed: int) -> None:
    axis = unit_vector(seed)
    x, normals, p_imu = tube(seed, axis, count=1000)
    noisy = tilted(np.random.default_rng(seed), normals)
    A, _ = information(x, noisy, p_imu, np.zeros(len(normals)))
    directions = pose_directions(A[:6, :6], noise(x, noisy, p_imu), LEVER_ARM, THRESHOLD)
    assert 0.8 < directions.ratios[0] < 1.2
    assert directions.weak.tolist() == [True] + [False] * 5


def test_a_floor_leaves_three_directions() -> None:
    random = np.random.default_rng(0)
    x = NavState.identity()
    p = np.column_stack([random.uniform(-10, 10, (300, 2)), np.full(300, -1.5)])
    normals = np.tile([0.0, 0.0, 1.0], (300, 1))
    A, _ = information(x, normals, p, np.zeros(300))
    directions = pose_directions(A[:6, :6], noise(x, normals, p), LEVER_ARM, THRESHOLD)
    assert directions.weak.sum() == 3  # two ways to slide, one to turn
    weak, _ = np.linalg.qr(directions.vectors[:, directions.weak])
    assert np.allclose(weak @ weak.T, np.diag([0.0, 0.0, 1.0, 1.0, 1.0, 0.0]), atol=1e-9)


@given(seeds)
def test_the_directions_diagonalise_information_and_noise(seed: int) -> None:
    random = np.random.default_rng(seed)
    x, normals = random_state(random), random.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    p_imu = 5.0 * random.normal(size=(50, 3))
    A, _ = information(x, normals, p_imu, np.zeros(50))
    N = noise(x, normals, p_imu)
    directions = pose_directions(A[:6, :6], N, LEVER_ARM, THRESHOLD)
    V = directions.basis
    # N is widened by what no normal is better than: a milliradian beside 20.
    assert np.allclose(V.T @ N @ V, np.eye(6), atol=0.01)
    assert np.allclose(V.T @ A[:6, :6] @ V, np.diag(directions.ratios), atol=1e-6 * directions.ratios.max())
    assert np.all(np.diff(directions.ratios) >= 0)
    assert np.allclose(np.linalg.norm(directions.vectors, axis=0), 1.0)


@given(seeds, st.floats(0.1, 100.0), st.floats(2.0, 20.0))
def test_ratios_depend_neither_on_the_weight_of_the_points_nor_on_the_unit_of_the_rotation(
    seed: int, weight: float, lever_arm: float
) -> None:
    random = np.random.default_rng(seed)
    x, normals, p_imu = tube(seed, unit_vector(seed))
    normals = tilted(random, normals, 0.3)
    A, _ = information(x, normals, p_imu, np.zeros(len(normals)))
    N = noise(x, normals, p_imu, 0.1)
    ratios = pose_directions(A[:6, :6], N, LEVER_ARM, THRESHOLD).ratios
    assert np.allclose(pose_directions(weight * A[:6, :6], weight * N, LEVER_ARM, THRESHOLD).ratios, ratios, rtol=1e-6)
    # The floor of N is in units of the lever arm: far below this noise it does not matter.
    assert np.allclose(pose_directions(A[:6, :6], N, lever_arm, THRESHOLD).ratios, ratios, rtol=0.02)


def test_exact_normals_still_have_a_weak_direction() -> None:
    x, normals, p_imu = tube(3, np.array([1.0, 0.0, 0.0]))
    A, _ = information(x, normals, p_imu, np.zeros(len(normals)))
    directions = pose_directions(A[:6, :6], np.zeros((6, 6)), LEVER_ARM, THRESHOLD)
    assert directions.weak.tolist() == [True] + [False] * 5


@given(seeds)
def test_the_strong_step_minimises_within_the_strong_directions(seed: int) -> None:
    random = np.random.default_rng(seed)
    x, normals, p_imu = tube(seed, unit_vector(seed))
    A, b = information(x, normals, p_imu, 0.1 * random.normal(size=len(normals)))
    directions = pose_directions(A[:6, :6], noise(x, normals, p_imu), LEVER_ARM, THRESHOLD)
    step = strong_step(A, b, directions)
    gradient = A[:6, :6] @ step + b[:6]
    strong = directions.basis[:, ~directions.weak]
    assert np.allclose(strong.T @ gradient, 0, atol=1e-6 * np.abs(strong.T @ b[:6]).max())
    assert np.allclose(np.linalg.solve(directions.basis, step)[directions.weak], 0, atol=1e-9)


@pytest.mark.parametrize("excess", [0.5, 2.0])
def test_the_threshold_is_a_multiple_of_the_noise(excess: float) -> None:
    x, normals, p_imu = tube(1, np.array([1.0, 0.0, 0.0]), 1000)
    A, _ = information(x, normals, p_imu, np.zeros(1000))
    N = noise(x, normals, p_imu)
    end = np.zeros((12, 12))
    end[3, 3] = excess * THRESHOLD * (N[3, 3] + 1e-6 * np.trace(A[3:6, 3:6]))
    assert pose_directions((A + end)[:6, :6], N, LEVER_ARM, THRESHOLD).weak[0] == (excess < 1.0)


@given(st.floats(1.01, 5.0), st.integers(1, 20_000))
def test_fewer_points_ask_for_more_than_chance_gives(threshold: float, points: int) -> None:
    asked = threshold_for(threshold, points)
    assert asked >= threshold
    assert (asked == threshold) == (points >= 2000)
    assert asked - 1.0 == pytest.approx((threshold - 1.0) * max(1.0, (2000 / points) ** 0.5))
    assert threshold_for(0.0, points) == 0.0


def test_chance_seldom_calls_a_direction_measured_that_is_not() -> None:
    """Along a tube, of planes that share their normals by tens: the ratio scatters the more the fewer there are."""
    axis, random, called = np.array([1.0, 0.0, 0.0]), np.random.default_rng(8), 0
    for seed in range(200):
        x, normals, p_imu = tube(seed, axis, 40)
        each = np.repeat(np.arange(40), 10)  # ten points on each
        noisy = tilted(random, normals, 0.1)[each]
        A, _ = information(x, noisy, p_imu[each], np.zeros(400))
        N = noise(x, noisy, p_imu[each], 0.1)
        called += not pose_directions(A[:6, :6], N, LEVER_ARM, threshold_for(1.3, 400)).weak[0]
        assert pose_directions(A[:6, :6], N, LEVER_ARM, 0.0).ratios[0] < 2.5
    assert called <= 6


@given(seeds, st.integers(0, 6))
def test_the_covariance_is_that_of_what_is_left_of_the_pose(seed: int, weak: int) -> None:
    random = np.random.default_rng(seed)
    basis, root = random.normal(size=(6, 6)), random.normal(size=(12, 12))
    A = root @ root.T
    strong = np.arange(6) >= weak
    found = strong_covariance(A, PoseDirections(np.ones(6), np.eye(6), 1.0, ~strong, basis))
    V = basis[:, strong]
    expected = V @ np.linalg.solve(V.T @ A[:6, :6] @ V, V.T)
    assert np.allclose(found, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max(initial=1e-300))


def test_no_information_along_a_direction_that_is_not_weak_is_an_error() -> None:
    directions = PoseDirections(np.ones(6), np.eye(6), 1.0, np.zeros(6, bool), np.eye(6))
    with pytest.raises(np.linalg.LinAlgError, match="zero along a direction"):
        strong_covariance(np.diag([1.0, 1.0, 0.0, 1.0, 1.0, 1.0]), directions)


def test_elimination_goes_on_where_the_first_number_is_zero() -> None:
    A = np.eye(6)[[1, 0, 2, 3, 4, 5]]
    directions = PoseDirections(np.ones(6), np.eye(6), 1.0, np.zeros(6, bool), np.eye(6))
    assert np.array_equal(strong_covariance(A, directions), A)
