"""Directions that a scan does not determine: found exactly, left untouched, and nothing else is (SPEC.md 9.8)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_states import random_covariance, random_state

from boxplus.filtering.degeneracy import pose_directions, project_out_weak, strong_step
from boxplus.filtering.nav_state import TANGENT, NavState
from boxplus.filtering.update_step import map_step

THRESHOLD = 0.004
LEVER_ARM = 7.0
seeds = st.integers(0, 2**32 - 1)


def _information(x: NavState, normals: np.ndarray, p_imu: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A and b (pose only) of points at `p_imu` on planes with `normals` (world), residuals `z`, unit weights of 1 cm."""
    C = normals @ x.R_world_imu
    H = np.hstack([np.cross(p_imu, C), normals])
    A, b = np.zeros((12, 12)), np.zeros(12)
    A[:6, :6], b[:6] = 1e4 * H.T @ H, 1e4 * H.T @ z
    return A, b


def _tube(seed: int, axis: np.ndarray, count: int = 400) -> tuple[NavState, np.ndarray, np.ndarray]:
    """Points on the four walls of a tube along `axis` (world), seen from within."""
    random = np.random.default_rng(seed)
    x = random_state(random)
    _, _, frame = np.linalg.svd(axis[None, :])
    across, up = frame[1], frame[2]
    side = random.integers(4, size=count)
    normals = np.where((side % 2 == 0)[:, None], across, up) * np.where(side < 2, 1.0, -1.0)[:, None]
    other = np.where((side % 2 == 0)[:, None], up, across)
    along = random.uniform(-12.0, 12.0, (count, 1))
    p_world = 2.0 * normals + random.uniform(-2.0, 2.0, (count, 1)) * other + along * axis
    return x, normals, p_world @ x.R_world_imu


def _unit(seed: int) -> np.ndarray:
    axis = np.random.default_rng(seed).normal(size=3)
    return axis / np.linalg.norm(axis)


@given(seeds)
def test_a_tube_has_one_weak_direction_along_its_axis(seed: int) -> None:
    axis = _unit(seed)
    x, normals, p_imu = _tube(seed, axis)
    A, _ = _information(x, normals, p_imu, np.zeros(len(normals)))
    directions = pose_directions(A, LEVER_ARM, THRESHOLD)
    assert directions.weak.tolist() == [True, False, False, False, False, False]
    assert directions.shares[0] < 1e-12
    assert np.allclose(directions.vectors[:3, 0], 0, atol=1e-9)
    assert np.isclose(abs(directions.vectors[3:, 0] @ axis), 1.0)


def test_a_floor_leaves_three_directions() -> None:
    random = np.random.default_rng(0)
    x = NavState.identity()
    p = np.column_stack([random.uniform(-10, 10, (300, 2)), np.full(300, -1.5)])
    A, _ = _information(x, np.tile([0.0, 0.0, 1.0], (300, 1)), p, np.zeros(300))
    directions = pose_directions(A, LEVER_ARM, THRESHOLD)
    assert directions.weak.sum() == 3  # two ways to slide, one to turn
    weak = directions.vectors[:, directions.weak]
    assert np.allclose(weak @ weak.T, np.diag([0.0, 0.0, 1.0, 1.0, 1.0, 0.0]), atol=1e-9)


@given(seeds)
def test_shares_depend_neither_on_the_number_nor_on_the_weight_of_the_points(seed: int) -> None:
    random = np.random.default_rng(seed)
    x, normals = random_state(random), random.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    A, _ = _information(x, normals, 5.0 * random.normal(size=(50, 3)), np.zeros(50))
    shares = pose_directions(A, LEVER_ARM, THRESHOLD).shares
    assert np.all(np.diff(shares) >= 0)
    assert np.allclose(pose_directions(37.0 * A, LEVER_ARM, THRESHOLD).shares, shares, atol=1e-12)
    assert np.isclose(shares.sum(), np.trace(A[:3, :3]) / LEVER_ARM**2 / np.trace(A[3:6, 3:6]) + 1.0)


def test_no_information_is_weak_everywhere() -> None:
    directions = pose_directions(np.zeros((12, 12)), LEVER_ARM, THRESHOLD)
    assert directions.weak.all()
    A, b = project_out_weak(np.eye(12), np.ones(12), directions)
    assert not A[:6].any()
    assert not b[:6].any()
    assert not strong_step(np.eye(12), np.ones(12), directions).any()


@given(seeds)
def test_without_a_weak_direction_nothing_is_changed(seed: int) -> None:
    random = np.random.default_rng(seed)
    A, b = random_covariance(random, 12), random.normal(size=12)
    projected = project_out_weak(A, b, pose_directions(A, 1.0, 0.0))
    assert projected[0] is A
    assert projected[1] is b
    assert np.allclose(strong_step(A, b, pose_directions(A, 1.0, 0.0)), -np.linalg.solve(A[:6, :6], b[:6]), rtol=1e-7)


@settings(max_examples=30)
@given(seeds)
def test_the_update_leaves_the_axis_of_a_noisy_tube_alone(seed: int) -> None:
    random = np.random.default_rng(seed)
    axis = _unit(seed)
    x, normals, p_imu = _tube(seed, axis)
    normals = normals + 0.02 * random.normal(size=normals.shape)  # noise in the normals looks like a measurement along the axis
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    A, b = _information(x, normals, p_imu, 0.05 + 0.02 * random.normal(size=len(normals)))
    directions = pose_directions(A, LEVER_ARM, THRESHOLD)
    assert directions.weak.sum() == 1
    prior = np.diag(np.linspace(0.5, 2.0, TANGENT) ** 2)  # independent: what is not measured stays exactly
    # Equal variances within the pose, in units of the lever arm: the weak direction is an axis of the prior as well.
    prior[:3, :3], prior[3:6, 3:6] = np.eye(3) / LEVER_ARM**2, np.eye(3)
    delta, cov = np.zeros(TANGENT), np.zeros((TANGENT, TANGENT))
    packed = x.pack()
    assert map_step(packed, packed, prior, *project_out_weak(A, b, directions), delta, cov)
    scaled = delta[:6] * np.array([LEVER_ARM] * 3 + [1.0] * 3)
    weak, strong = directions.vectors[:, directions.weak], directions.vectors[:, ~directions.weak]
    assert np.allclose(weak.T @ scaled, 0, atol=1e-9)
    assert np.linalg.norm(scaled) > 1e-3
    scale = np.array([LEVER_ARM] * 3 + [1.0] * 3)
    assert np.isclose((weak.T @ (cov[:6, :6] * np.outer(scale, scale)) @ weak).item(), 1.0)
    # Within the strong directions it is the update by what they measure, and nothing else.
    reduced = strong.T @ (A[:6, :6] / np.outer(scale, scale)) @ strong
    expected = -np.linalg.solve(np.eye(5) + reduced, strong.T @ (b[:6] / scale))
    assert np.allclose(strong.T @ scaled, expected, rtol=1e-6, atol=1e-9)


@given(seeds)
def test_the_strong_step_minimises_within_the_strong_directions(seed: int) -> None:
    random = np.random.default_rng(seed)
    x, normals, p_imu = _tube(seed, _unit(seed))
    A, b = _information(x, normals, p_imu, 0.1 * random.normal(size=len(normals)))
    directions = pose_directions(A, LEVER_ARM, THRESHOLD)
    step = strong_step(A, b, directions)
    gradient = A[:6, :6] @ step + b[:6]
    scale = np.array([1.0 / LEVER_ARM] * 3 + [1.0] * 3)
    strong = directions.vectors[:, ~directions.weak]
    assert np.allclose(strong.T @ (scale * gradient), 0, atol=1e-8 * np.abs(b).max())
    assert np.allclose(directions.vectors[:, directions.weak].T @ (step / scale), 0, atol=1e-12)


@pytest.mark.parametrize("share", [0.5, 2.0])
def test_the_threshold_is_a_share_of_the_points(share: float) -> None:
    x, normals, p_imu = _tube(1, np.array([1.0, 0.0, 0.0]), 1000)
    count = round(share * THRESHOLD * 1000)
    A, _ = _information(x, normals, p_imu, np.zeros(1000))
    end, _ = _information(x, np.tile([1.0, 0.0, 0.0], (count, 1)), np.zeros((count, 3)), np.zeros(count))
    assert pose_directions(A + end, LEVER_ARM, THRESHOLD).weak[0] == (share < 1.0)
