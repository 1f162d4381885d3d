"""The rows of the point-to-plane measurement against differences on the manifold, far from zero residual.

Derivation: docs/lidar_inertial_odometry.md, section 6.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.filtering.nav_state import MEASURED, TANGENT, NavState
from boxplus.filtering.plane_information import FEW_NEIGHBOURS, GATED, NOT_A_PLANE, USED, accumulate_planes
from boxplus.maps.plane_matching import PLANE
from tests.filtering.random_states import derivative, random_state

seeds = st.integers(0, 2**32 - 1)
_GROUPS = 50


def _accumulate(
    x: NavState, points: np.ndarray, planes: np.ndarray, fate: np.ndarray, with_extrinsic: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    A, b, _, sums = _accumulate_with_pull(x, points, planes, fate, with_extrinsic)
    return A, b, sums


def _accumulate_with_pull(
    x: NavState, points: np.ndarray, planes: np.ndarray, fate: np.ndarray, with_extrinsic: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    A, b, pull, sums, N = np.zeros((12, 12)), np.zeros(12), np.zeros(12), np.zeros(2), np.zeros((6, 6))
    accumulate_planes(x.pack(), points, planes, fate, 4e-4, 4e-4, with_extrinsic, True, A, b, pull, N, sums)
    return A, b, pull, sums


def _world(x: NavState, points: np.ndarray) -> np.ndarray:
    p_imu = points.astype(np.float64) @ x.R_imu_lidar.T + x.p_imu_lidar
    return p_imu @ x.R_world_imu.T + x.p_world_imu


def _planes_at(x: NavState, points: np.ndarray, z: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """A plane for every point, of any direction, that lies `z` below the point along its normal."""
    planes = np.zeros((len(points), PLANE))
    normals = random.normal(size=(len(points), 3))
    planes[:, :3] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    planes[:, 3] = np.einsum("ij,ij->i", planes[:, :3], _world(x, points)) - z
    planes[:, 4] = 1e-4
    return planes


def _residual(x: NavState, point: np.ndarray, plane: np.ndarray) -> float:
    return float(plane[:3] @ _world(x, point[None])[0] - plane[3])


@settings(max_examples=40)
@given(seeds, st.sampled_from([-0.4, -0.1, 0.01, 0.3]))
def test_rows_against_differences(seed: int, z: float) -> None:
    random = np.random.default_rng(seed)
    x = random_state(random)
    direction = random.normal(size=3)
    point = (random.uniform(20.0, 60.0) * direction / np.linalg.norm(direction)).astype(np.float32)[None]
    planes = _planes_at(x, point, np.array([z]), random)
    A, b, sums = _accumulate(x, point, planes, np.zeros(1, np.uint8))
    # One point: A = w h hᵀ and b = w h z. The normal is a unit vector, so the trace of its block is the weight.
    weight = np.trace(A[3:6, 3:6])
    h = b / (weight * z)
    numeric = derivative(lambda e: np.array([_residual(x.boxplus(e), point[0], planes[0])]), TANGENT)[0]
    assert np.allclose(h, numeric[MEASURED], atol=1e-7 * max(1.0, np.abs(numeric).max()))
    assert np.allclose(np.delete(numeric, MEASURED), 0, atol=1e-10)  # velocity, biases and gravity are not seen
    assert np.allclose(A, weight * np.outer(h, h), rtol=1e-9, atol=1e-9 * weight)
    assert np.allclose(sums, [1.0, z * z])


@given(seeds)
def test_the_sign_of_the_normal_does_not_matter(seed: int) -> None:
    random = np.random.default_rng(seed)
    x, points = random_state(random), (10.0 * random.normal(size=(8, 3))).astype(np.float32)
    planes = _planes_at(x, points, 0.05 * random.normal(size=8), random)
    flipped = planes.copy()
    flipped[:, :4] *= -1.0
    for one, other in zip(
        _accumulate(x, points, planes, np.zeros(8, np.uint8)), _accumulate(x, points, flipped, np.zeros(8, np.uint8)), strict=True
    ):
        assert np.allclose(one, other, rtol=1e-12)


@given(seeds)
def test_points_add_up(seed: int) -> None:
    random = np.random.default_rng(seed)
    x, points = random_state(random), (10.0 * random.normal(size=(6, 3))).astype(np.float32)
    planes = _planes_at(x, points, 0.02 * random.normal(size=6), random)
    together = _accumulate(x, points, planes, np.zeros(6, np.uint8))
    single = [_accumulate(x, points[i : i + 1], planes[i : i + 1], np.zeros(1, np.uint8)) for i in range(6)]
    for k in range(3):
        parts = sum(s[k] for s in single)
        assert np.allclose(together[k], parts, rtol=1e-9, atol=1e-9 * np.abs(parts).max())


def test_without_the_extrinsic_only_the_pose_is_measured() -> None:
    random = np.random.default_rng(0)
    x, points = random_state(random), (10.0 * random.normal(size=(6, 3))).astype(np.float32)
    planes = _planes_at(x, points, 0.02 * random.normal(size=6), random)
    A, b, _ = _accumulate(x, points, planes, np.zeros(6, np.uint8), with_extrinsic=False)
    A_all, b_all, _ = _accumulate(x, points, planes, np.zeros(6, np.uint8))
    assert np.array_equal(A[:6, :6], A_all[:6, :6])
    assert np.array_equal(b[:6], b_all[:6])
    assert not A[6:].any()
    assert not A[:, 6:].any()
    assert not b[6:].any()


@pytest.mark.parametrize(
    ("metres", "z", "fate"), [(9.0, 0.33, USED), (9.0, 0.34, GATED), (36.0, -0.66, USED), (36.0, -0.67, GATED)]
)
def test_the_gate_opens_with_the_root_of_the_range(metres: float, z: float, fate: int) -> None:
    random = np.random.default_rng(1)
    x, point = random_state(random), np.array([[0.0, 0.0, metres]], np.float32)
    became = np.zeros(1, np.uint8)
    _, b, sums = _accumulate(x, point, _planes_at(x, point, np.array([z]), random), became)
    assert became[0] == fate
    assert bool(sums[0]) == (fate == USED) == bool(b.any())


def test_a_gated_point_may_come_back_and_one_without_a_plane_may_not() -> None:
    random = np.random.default_rng(2)
    x, points = random_state(random), (10.0 * random.normal(size=(4, 3))).astype(np.float32)
    planes = _planes_at(x, points, np.full(4, 0.01), random)
    fate = np.array([GATED, NOT_A_PLANE, FEW_NEIGHBOURS, USED], np.uint8)
    _, _, sums = _accumulate(x, points, planes, fate)
    assert fate.tolist() == [USED, NOT_A_PLANE, FEW_NEIGHBOURS, USED]
    assert sums[0] == 2


def test_a_point_weighs_less_the_less_is_known() -> None:
    random = np.random.default_rng(3)
    x, point = random_state(random), np.array([[0.0, 0.0, 20.0]], np.float32)

    def weight(z: float, misfit: float, tilt: float) -> float:
        planes = _planes_at(x, point, np.array([z]), np.random.default_rng(4))
        planes[0, 4] = misfit
        planes[0, 8] = -tilt  # gᵀ (y − q) = tilt: the point lies beyond the plane's own points
        return float(np.trace(_accumulate(x, point, planes, np.zeros(1, np.uint8))[0][3:6, 3:6]))

    certain = weight(0.0, 0.0, 0.0)
    assert np.isfinite(certain)
    assert certain > weight(0.2, 0.0, 0.0) > 0
    assert certain > weight(0.0, 1e-2, 0.0) > 0
    assert certain > weight(0.0, 0.0, 5.0) > 0


@settings(max_examples=20)
@given(seeds)
def test_the_noise_of_the_normals_is_what_tilted_normals_add(seed: int) -> None:
    """N against the scatter of the rows of A when each normal is drawn from its own covariance, a point at a time."""
    random = np.random.default_rng(seed)
    x, point = random_state(random), (8.0 * random.normal(size=(1, 3))).astype(np.float32)
    plane = _planes_at(x, point, np.zeros(1), random)
    plane[0, 13] = plane[0, 4]
    _, _, frame = np.linalg.svd(plane[:, :3])
    g = frame[1:] * random.uniform(0.5, 2.0, (2, 1))
    centroid = _world(x, point)[0]
    for first, vector in zip((5, 9), g, strict=True):
        plane[0, first : first + 3], plane[0, first + 3] = vector, vector @ centroid
    A, N = np.zeros((12, 12)), np.zeros((6, 6))
    accumulate_planes(
        x.pack(), point, plane, np.zeros(1, np.uint8), 4e-4, 4e-4, False, True, A, np.zeros(12), np.zeros(12), N, np.zeros(2)
    )
    weight = A[3:6, 3:6].trace()
    sharp = plane.copy()
    sharp[:, 5:13] *= 1e-6  # the normal is known
    known = np.zeros((12, 12))
    accumulate_planes(
        x.pack(),
        point,
        sharp,
        np.zeros(1, np.uint8),
        4e-4,
        4e-4,
        False,
        False,
        known,
        np.zeros(12),
        np.zeros(12),
        N.copy(),
        np.zeros(2),
    )
    assert weight == pytest.approx(known[3:6, 3:6].trace() / (1.0 + 1e-4 * np.sum(g**2) / 0.01), rel=1e-6)
    s = x.R_imu_lidar @ point[0].astype(np.float64) + x.p_imu_lidar
    signs = np.array([[a, b] for a in (-1.0, 1.0) for b in (-1.0, 1.0)])  # four draws of exact mean and covariance
    expected = np.zeros((6, 6))
    for tilt in 0.01 * signs @ g:  # the plane's own points lie 1 cm off it
        row = np.concatenate([np.cross(s, x.R_world_imu.T @ tilt), tilt])
        expected += weight * np.outer(row, row) / len(signs)
    found = N
    assert np.allclose(found, expected, rtol=2e-3, atol=1e-3 * np.abs(expected).max())


@settings(max_examples=20)
@given(seeds)
def test_the_pull_is_what_noisy_normals_make_of_a_point_beside_the_middle_of_its_plane(seed: int) -> None:
    """b less the pull where the sensor is right, over many normals that noise has tilted: nothing, where b alone is not."""
    random = np.random.default_rng(seed)
    x, point = random_state(random), (8.0 * random.normal(size=(1, 3))).astype(np.float32)
    frame = np.linalg.svd(random.normal(size=(1, 3)))[2]
    count, sigma = 40_000, 0.01
    g = frame[1:] * random.uniform(2.0, 4.0, (2, 1))
    middle = _world(x, point)[0] - np.array([0.1, -0.07]) @ frame[1:]
    planes = np.zeros((count, PLANE))
    tilts = sigma * random.normal(size=(count // 2, 2)) @ g
    tilted = frame[0] + np.concatenate([tilts, -tilts])  # what is odd in them evens out
    planes[:, :3] = tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
    planes[:, 3] = planes[:, :3] @ middle
    planes[:, 5:8], planes[:, 8], planes[:, 9:12], planes[:, 12] = g[0], g[0] @ middle, g[1], g[1] @ middle
    planes[:, 13] = sigma**2
    parts, pulls = [], []
    for k in range(_GROUPS):  # each with both halves of its pairs
        group = planes[k::_GROUPS]
        points, fate = np.repeat(point, len(group), axis=0), np.zeros(len(group), np.uint8)
        _, with_noise, pull, _ = _accumulate_with_pull(x, points, group, fate)
        parts.append(with_noise)
        pulls.append(pull)
    with_noise, left = np.sum(parts, axis=0), np.sum(parts, axis=0) - np.sum(pulls, axis=0)
    by_chance = np.std(np.array(parts) - np.array(pulls), axis=0) * np.sqrt(_GROUPS)
    assert np.linalg.norm(with_noise[3:6]) > 0
    for block in (slice(0, 6), slice(6, 12)):
        # What chance leaves is as large where the pulls of both directions nearly cancel, and b is small.
        assert np.linalg.norm(left[block]) < 0.02 * np.linalg.norm(with_noise[block]) + 5.0 * np.linalg.norm(by_chance[block])
        assert np.linalg.norm(by_chance[block]) < 0.1 * max(np.linalg.norm(with_noise[block]), np.linalg.norm(with_noise))


@pytest.mark.parametrize("spoilt", ["plane", "point"])
def test_what_is_no_number_is_gated(spoilt: str) -> None:
    random = np.random.default_rng(0)
    x, points = random_state(random), random.normal(size=(3, 3)).astype(np.float32)
    planes, fate = _planes_at(x, points, np.zeros(3), random), np.zeros(3, np.uint8)
    (planes if spoilt == "plane" else points)[1, 0] = np.nan
    A, b, sums = _accumulate(x, points, planes, fate)
    assert fate.tolist() == [USED, GATED, USED] and sums[0] == 2.0
    assert np.isfinite(A).all() and np.isfinite(b).all()
