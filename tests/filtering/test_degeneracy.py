"""Directions that a scan does not determine: found as such, left untouched, and nothing else is.

Derivation: docs/lidar_inertial_odometry.md, section 7.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.filtering.degeneracy import pose_directions, strong_step, with_weak_axis, without_noise
from boxplus.filtering.nav_state import TANGENT, NavState
from boxplus.filtering.update_step import map_step
from tests.filtering.random_states import random_covariance, random_state

THRESHOLD = 2.5
TILT = 0.02  # of the normals [rad]
LEVER_ARM = 7.0
seeds = st.integers(0, 2**32 - 1)


def _information(x: NavState, normals: np.ndarray, p_imu: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A and b (pose only) of points at `p_imu` on planes with `normals` (world), residuals `z`, unit weights of 1 cm."""
    C = normals @ x.R_world_imu
    H = np.hstack([np.cross(p_imu, C), normals])
    A, b = np.zeros((12, 12)), np.zeros(12)
    A[:6, :6], b[:6] = 1e4 * H.T @ H, 1e4 * H.T @ z
    return A, b


def _noise(x: NavState, normals: np.ndarray, p_imu: np.ndarray, tilt: float = TILT) -> np.ndarray:
    """N of the same points: what normals that are off by `tilt` about each axis in the plane contribute by themselves."""
    N = np.zeros((6, 6))
    for u, s in zip(normals, p_imu, strict=True):
        _, _, frame = np.linalg.svd(u[None, :])
        for g in tilt * frame[1:]:
            row = np.concatenate([np.cross(s, x.R_world_imu.T @ g), g])
            N += 1e4 * np.outer(row, row)
    return N


def _tilted(random: np.random.Generator, normals: np.ndarray, tilt: float = TILT) -> np.ndarray:
    noisy = normals + tilt * random.normal(size=normals.shape)
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    return noisy


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
    directions = pose_directions(A[:6, :6], _noise(x, normals, p_imu), LEVER_ARM, THRESHOLD)
    assert directions.weak.tolist() == [True, False, False, False, False, False]
    assert directions.ratios[0] < 1e-9
    assert np.allclose(directions.vectors[:3, 0], 0, atol=1e-6)
    assert np.isclose(abs(directions.vectors[3:, 0] @ axis), 1.0)


@settings(max_examples=20)
@given(seeds)
def test_along_a_tube_of_noisy_normals_the_ratio_is_one(seed: int) -> None:
    axis = _unit(seed)
    x, normals, p_imu = _tube(seed, axis, count=1000)
    noisy = _tilted(np.random.default_rng(seed), normals)
    A, _ = _information(x, noisy, p_imu, np.zeros(len(normals)))
    directions = pose_directions(A[:6, :6], _noise(x, noisy, p_imu), LEVER_ARM, THRESHOLD)
    assert 0.8 < directions.ratios[0] < 1.2
    assert directions.weak.tolist() == [True] + [False] * 5


def test_a_floor_leaves_three_directions() -> None:
    random = np.random.default_rng(0)
    x = NavState.identity()
    p = np.column_stack([random.uniform(-10, 10, (300, 2)), np.full(300, -1.5)])
    normals = np.tile([0.0, 0.0, 1.0], (300, 1))
    A, _ = _information(x, normals, p, np.zeros(300))
    directions = pose_directions(A[:6, :6], _noise(x, normals, p), LEVER_ARM, THRESHOLD)
    assert directions.weak.sum() == 3  # two ways to slide, one to turn
    weak, _ = np.linalg.qr(directions.vectors[:, directions.weak])
    assert np.allclose(weak @ weak.T, np.diag([0.0, 0.0, 1.0, 1.0, 1.0, 0.0]), atol=1e-9)


@given(seeds)
def test_the_directions_diagonalise_information_and_noise(seed: int) -> None:
    random = np.random.default_rng(seed)
    x, normals = random_state(random), random.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    p_imu = 5.0 * random.normal(size=(50, 3))
    A, _ = _information(x, normals, p_imu, np.zeros(50))
    N = _noise(x, normals, p_imu)
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
    x, normals, p_imu = _tube(seed, _unit(seed))
    normals = _tilted(random, normals, 0.3)
    A, _ = _information(x, normals, p_imu, np.zeros(len(normals)))
    N = _noise(x, normals, p_imu, 0.1)
    ratios = pose_directions(A[:6, :6], N, LEVER_ARM, THRESHOLD).ratios
    assert np.allclose(pose_directions(weight * A[:6, :6], weight * N, LEVER_ARM, THRESHOLD).ratios, ratios, rtol=1e-6)
    # The floor of N is in units of the lever arm: far below this noise it does not matter.
    assert np.allclose(pose_directions(A[:6, :6], N, lever_arm, THRESHOLD).ratios, ratios, rtol=0.02)


def test_no_information_is_weak_everywhere() -> None:
    directions = pose_directions(np.zeros((6, 6)), np.zeros((6, 6)), LEVER_ARM, THRESHOLD)
    assert directions.weak.all()
    A, b = without_noise(np.eye(12), np.ones(12), directions)
    assert not A[:6].any()
    assert not b[:6].any()
    assert not strong_step(np.eye(12), np.ones(12), directions).any()


def test_exact_normals_still_have_a_weak_direction() -> None:
    x, normals, p_imu = _tube(3, np.array([1.0, 0.0, 0.0]))
    A, _ = _information(x, normals, p_imu, np.zeros(len(normals)))
    directions = pose_directions(A[:6, :6], np.zeros((6, 6)), LEVER_ARM, THRESHOLD)
    assert directions.weak.tolist() == [True] + [False] * 5


@given(seeds)
def test_normals_without_noise_keep_all_they_say(seed: int) -> None:
    random = np.random.default_rng(seed)
    A, b = random_covariance(random, 12), random.normal(size=12)
    directions = pose_directions(A[:6, :6], np.eye(6), 1.0, 0.0)
    left, pulled = without_noise(A, b, replace(directions, ratios=np.full(6, np.inf)))
    np.testing.assert_allclose(left, A, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(pulled, b, rtol=1e-6, atol=1e-9)
    assert np.allclose(strong_step(A, b, directions), -np.linalg.solve(A[:6, :6], b[:6]), rtol=1e-6)


@given(seeds)
def test_what_noise_has_made_is_left_out_direction_by_direction(seed: int) -> None:
    random = np.random.default_rng(seed)
    A, b = random_covariance(random, 12), random.normal(size=12)
    N = random_covariance(random, 6)
    directions = pose_directions(A[:6, :6], N, 3.0, 0.0)
    directions = pose_directions(A[:6, :6], N, 3.0, float(directions.ratios[2:4].mean()))
    left, pulled = without_noise(A, b, directions)
    V, ratios = directions.basis, directions.ratios
    share = np.where(directions.weak | (ratios < 1.0), 0.0, 1.0 - 1.0 / ratios)
    assert np.allclose(V.T @ left[:6, :6] @ V, np.diag(share**2 * ratios), atol=1e-6 * ratios.max())
    assert np.allclose(V.T @ pulled[:6], share * (V.T @ b[:6]), atol=1e-7 * np.abs(V.T @ b[:6]).max())


@given(seeds)
def test_the_step_is_the_one_of_errors_in_variables(seed: int) -> None:
    random = np.random.default_rng(seed)
    true, N, b = np.eye(6), np.eye(6), np.zeros(12)
    for M in (true, N):
        h = random.normal(size=(30, 6))
        M += h.T @ h
    b[:6] = random.normal(size=6)
    A = np.zeros((12, 12))
    A[:6, :6] = true + N
    directions = replace(pose_directions(A[:6, :6], N, 1.0, 0.0), weak=np.zeros(6, dtype=bool))
    left, pulled = without_noise(A, b, directions)
    # N is widened by what no normal is better than, a milliradian.
    np.testing.assert_allclose(left[:6, :6], true @ np.linalg.solve(A[:6, :6], true), rtol=1e-3, atol=1e-3 * true.max())
    np.testing.assert_allclose(np.linalg.solve(left[:6, :6], pulled[:6]), np.linalg.solve(true, b[:6]), rtol=1e-3, atol=1e-4)


def test_a_shift_along_a_tube_with_a_few_bars_across_is_measured_whole() -> None:
    """Noise of the walls' normals does not see the shift: it must neither hold the estimate back nor make it surer than it is."""
    random, shift, axis = np.random.default_rng(5), 0.05, np.array([1.0, 0.0, 0.0])
    plain, steps, variances, ratios = [], [], [], []
    for seed in range(300):
        _, normals, p_imu = _tube(seed, axis, 400)
        normals[:6] = axis
        x = NavState.identity()
        noisy = _tilted(random, normals, 0.1)
        z = -normals @ (shift * axis) + 0.01 * random.normal(size=len(normals))
        A, b = _information(x, noisy, p_imu, z)
        directions = pose_directions(A[:6, :6], _noise(x, noisy, p_imu, 0.1), LEVER_ARM, 1.3)
        if directions.weak.any():
            continue
        left, pulled = without_noise(A, b, directions)
        covariance = np.linalg.inv(left[:6, :6])
        plain.append(strong_step(A, b, directions)[3])
        steps.append(-(covariance @ pulled[:6])[3])
        variances.append(covariance[3, 3])
        ratios.append(directions.ratios[0])
    assert len(ratios) > 250
    assert 2.0 < np.median(ratios) < 4.0
    assert np.mean(plain) < 0.75 * shift
    assert np.mean(steps) == pytest.approx(shift, rel=0.1)
    assert np.std(steps) == pytest.approx(np.sqrt(np.mean(variances)), rel=0.3)


@settings(max_examples=30)
@given(seeds)
def test_the_update_leaves_the_axis_of_a_noisy_tube_alone(seed: int) -> None:
    random = np.random.default_rng(seed)
    axis = _unit(seed)
    x, normals, p_imu = _tube(seed, axis)
    noisy = _tilted(random, normals)  # noise in the normals looks like a measurement along the axis
    A, b = _information(x, noisy, p_imu, 0.05 + 0.02 * random.normal(size=len(normals)))
    directions = pose_directions(A[:6, :6], _noise(x, noisy, p_imu), LEVER_ARM, THRESHOLD)
    assert directions.weak.sum() == 1
    prior = np.diag(np.linspace(0.5, 2.0, TANGENT) ** 2)  # independent: what is not measured stays exactly
    # The directions are conjugate in N: where the prior is N⁻¹, they are independent in it as well.
    V = directions.basis
    prior[:6, :6] = V @ V.T
    delta, cov = np.zeros(TANGENT), np.zeros((TANGENT, TANGENT))
    packed = x.pack()
    assert map_step(packed, packed, prior, *without_noise(A, b, directions), delta, cov)
    along = np.linalg.solve(V, delta[:6])  # in units of the prior
    weak, strong = directions.weak, ~directions.weak
    assert np.allclose(along[weak], 0, atol=1e-6)
    variances = np.linalg.solve(V, np.linalg.solve(V, cov[:6, :6]).T)
    assert np.allclose(variances[np.ix_(weak, weak)], 1.0)
    # In the strong directions it is the update by what they measure, and nothing else.
    share = 1.0 - 1.0 / directions.ratios[strong]
    expected = -share * (V.T @ b[:6])[strong] / (1.0 + share**2 * directions.ratios[strong])
    assert np.abs(expected).max() > 1e-3
    assert np.allclose(along[strong], expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


@given(seeds)
def test_the_strong_step_minimises_within_the_strong_directions(seed: int) -> None:
    random = np.random.default_rng(seed)
    x, normals, p_imu = _tube(seed, _unit(seed))
    A, b = _information(x, normals, p_imu, 0.1 * random.normal(size=len(normals)))
    directions = pose_directions(A[:6, :6], _noise(x, normals, p_imu), LEVER_ARM, THRESHOLD)
    step = strong_step(A, b, directions)
    gradient = A[:6, :6] @ step + b[:6]
    strong = directions.basis[:, ~directions.weak]
    assert np.allclose(strong.T @ gradient, 0, atol=1e-6 * np.abs(strong.T @ b[:6]).max())
    assert np.allclose(np.linalg.solve(directions.basis, step)[directions.weak], 0, atol=1e-9)


@pytest.mark.parametrize("excess", [0.5, 2.0])
def test_the_threshold_is_a_multiple_of_the_noise(excess: float) -> None:
    x, normals, p_imu = _tube(1, np.array([1.0, 0.0, 0.0]), 1000)
    A, _ = _information(x, normals, p_imu, np.zeros(1000))
    N = _noise(x, normals, p_imu)
    end = np.zeros((12, 12))
    end[3, 3] = excess * THRESHOLD * (N[3, 3] + 1e-6 * np.trace(A[3:6, 3:6]))
    assert pose_directions((A + end)[:6, :6], N, LEVER_ARM, THRESHOLD).weak[0] == (excess < 1.0)


@given(seeds)
def test_an_axis_can_be_called_weak_whatever_its_ratio(seed: int) -> None:
    random = np.random.default_rng(seed)
    axis = random.normal(size=3)
    axis /= np.linalg.norm(axis)
    x, normals, p_imu = _tube(seed, axis)
    noisy = _tilted(random, normals, 3.0 * TILT)
    S = _information(x, noisy, p_imu, np.zeros(len(noisy)))[0][:6, :6]
    directions = pose_directions(S, _noise(x, noisy, p_imu), LEVER_ARM, THRESHOLD)
    forced = with_weak_axis(directions, axis)
    closest = int(np.argmax(np.abs(axis @ directions.vectors[3:])))
    assert forced.weak[closest] and abs(axis @ forced.vectors[3:, closest]) > 0.8
    np.testing.assert_array_equal(np.delete(forced.weak, closest), np.delete(directions.weak, closest))
    A = np.zeros((12, 12))
    A[:6, :6] = S
    along = np.r_[forced.basis[:, closest], np.zeros(6)]
    kept, _ = without_noise(A, np.zeros(12), forced)
    assert along @ kept @ along < 1e-9 * (along @ A @ along)
