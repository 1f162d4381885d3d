"""Planes through five points against the singular value decomposition (docs/lidar_inertial_odometry.md, section 5)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba.core import config as numba_config

from boxplus.errors import InputError
from boxplus.maps.plane_fit import COLLINEAR_RATIO, fit_plane_into, planes_through

LIMIT = 0.1
# The compiled kernel computes in float64; as plain Python, NumPy would compute in the points' own precision.
_STORED = np.float64 if numba_config.DISABLE_JIT else np.float32
seeds = st.integers(0, 2**32 - 1)


def _fit(points: np.ndarray, limit: float = LIMIT) -> np.ndarray | None:
    plane = np.full(9, np.nan)
    return plane if fit_plane_into(points.astype(np.float32).astype(_STORED), len(points), limit, plane) else None


def _patch(seed: int, noise: float, count: int = 5, extent: tuple[float, float] = (1.0, 0.6)) -> np.ndarray:
    """Points about a plane through 0 of any direction, `extent` wide."""
    random = np.random.default_rng(seed)
    frame, _ = np.linalg.qr(random.normal(size=(3, 3)))
    local = random.uniform(-0.5, 0.5, (count, 3)) * [*extent, 0.0] + noise * random.normal(size=(count, 1)) * [0.0, 0.0, 1.0]
    return (local @ frame.T).astype(np.float32).astype(np.float64)


def _accepted(singular: np.ndarray, largest_distance: float) -> bool | None:
    """The rule of docs/lidar_inertial_odometry.md, section 5, or None where rounding may decide."""
    if abs(singular[1] / singular[0] - COLLINEAR_RATIO) < 1e-4 or abs(largest_distance - LIMIT) < 1e-5:
        return None
    return bool(singular[1] > COLLINEAR_RATIO * singular[0] and largest_distance < LIMIT)


@given(seeds, st.sampled_from([0.0, 1e-3, 0.02, 0.1, 0.3]), st.floats(0.01, 1.0))
def test_against_svd(seed: int, noise: float, width: float) -> None:
    points = _patch(seed, noise, extent=(1.0, width))
    centroid = points.mean(axis=0)
    _, singular, Vt = np.linalg.svd(points - centroid)
    distances = np.abs((points - centroid) @ Vt[2])
    expected = _accepted(singular, distances.max())
    plane = _fit(points)
    if expected is not None and singular[1] - singular[2] > 1e-3:
        assert (plane is not None) == expected
    if plane is None:
        return
    assert np.isclose(np.linalg.norm(plane[:3]), 1.0, atol=1e-12)
    assert np.allclose(plane[4:7], centroid, atol=1e-12)
    assert np.isclose(plane[3], plane[:3] @ centroid, atol=1e-12)
    if singular[1] - singular[2] > 0.02:  # otherwise the direction itself is not determined
        assert np.isclose(abs(plane[:3] @ Vt[2]), 1.0, atol=1e-6)
    assert np.isclose(plane[7], singular[2] ** 2 / 2.0, atol=1e-7)  # five points, three unknowns


@given(seeds, st.integers(3, 5))
def test_exact_planes_through_the_origin_of_the_world(seed: int, count: int) -> None:
    points = _patch(seed, 0.0, count)
    if np.linalg.svd(points - points.mean(axis=0))[1][1] < 0.1 * np.linalg.svd(points - points.mean(axis=0))[1][0]:
        return
    plane = _fit(points)
    assert plane is not None
    assert np.abs(points @ plane[:3] - plane[3]).max() < 1e-6
    assert abs(plane[3]) < 0.2  # n·x = −1 could not say this


@given(seeds)
def test_far_from_the_origin_as_well_as_near(seed: int) -> None:
    shift = np.array([800.0, -600.0, 50.0])
    points = _patch(seed, 0.005)
    near, far = _fit(points), _fit(points + shift)
    moved = (points + shift).astype(np.float32).astype(np.float64)  # what float32 leaves of the points
    _, singular, Vt = np.linalg.svd(moved - moved.mean(axis=0))
    if near is None or far is None or singular[1] < 0.1:
        return
    assert np.isclose(abs(far[:3] @ Vt[2]), 1.0, atol=1e-6)
    assert np.abs(moved @ far[:3] - far[3]).max() < 0.1


@given(seeds, st.floats(-6.0, 0.0), st.floats(-1.2, 0.0), st.sampled_from([5, 15]))
def test_variances_of_any_shape_are_those_of_lapack(seed: int, thin: float, narrow: float, count: int) -> None:
    """From sheets to balls, two extents alike among them, at any place."""
    random = np.random.default_rng(seed)
    frame, _ = np.linalg.qr(random.normal(size=(3, 3)))
    extent = np.array([1.0, 10.0**narrow, 10.0 ** min(thin, narrow)]) * 10.0 ** random.uniform(-2.0, 1.0)
    points = ((random.normal(size=(count, 3)) * extent) @ frame.T + random.uniform(-50.0, 50.0, 3)).astype(np.float32)
    plane = _fit(points, limit=np.inf)
    scatter = np.cov(points.T.astype(np.float64), bias=True) * count
    smallest, middle, largest = np.linalg.eigvalsh(scatter)
    if plane is None:
        assert middle < 1.001 * COLLINEAR_RATIO**2 * largest
        return
    assert plane[7] * (count - 3) == pytest.approx(max(smallest, 0.0), abs=1e-11 * largest)
    assert plane[8] == pytest.approx(middle, abs=1e-11 * largest)
    assert plane[:3] @ scatter @ plane[:3] == pytest.approx(smallest, abs=1e-9 * largest)


@given(seeds)
def test_the_order_of_the_points_does_not_matter(seed: int) -> None:
    points = _patch(seed, 0.01)
    one, other = _fit(points), _fit(points[::-1])
    assert (one is None) == (other is None)
    if one is not None and other is not None:
        assert np.isclose(abs(one[:3] @ other[:3]), 1.0, atol=1e-9)


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.0), (40.0, -7.0, 2.0)])
def test_degenerate_sets_are_refused(centre: tuple[float, float, float]) -> None:
    line = np.outer(np.linspace(0.0, 1.0, 5), [0.6, 0.0, 0.8])
    box = 0.4 * np.array([[1, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1], [0, 0, 0]])
    for points in (np.zeros((5, 3)), line, line + 1e-7, box):
        assert _fit(points + centre) is None
    assert _fit(np.full((5, 3), np.nan)) is None
    flat = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.5, 0.5, 0.0]])
    assert _fit(flat + centre) is not None


def test_one_point_off_the_plane() -> None:
    flat = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.5, 0.5, 0.0]])
    lifted = flat.copy()
    lifted[4, 2] = 0.2  # 0.16 m off the plane of all five
    assert _fit(lifted) is None
    assert _fit(lifted, limit=0.2) is not None


def test_only_the_points_counted_are_used() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9]], np.float32)
    plane = np.zeros(9)
    assert fit_plane_into(points, 3, LIMIT, plane)
    assert np.allclose(np.abs(plane[:3]), [0.0, 0.0, 1.0])


@given(seeds, st.sampled_from([0.0, 0.02, 0.3]), st.sampled_from([3, 5, 15, 40]))
def test_planes_through_handfuls_against_eigenvalues(seed: int, noise: float, count: int) -> None:
    random = np.random.default_rng(seed)
    counts = random.integers(1, count + 1, 6)
    points = np.stack([_patch(seed + k, noise, count) + 100.0 * random.normal(size=3) for k in range(6)])
    for k, held in enumerate(counts):
        points[k, held:] = np.nan  # as a search leaves them that finds fewer
    found = planes_through(points, counts)
    for k, held in enumerate(counts):
        few = points[k, :held]
        values, axes = np.linalg.eigh(np.cov(few.T, bias=True) if held > 1 else np.zeros((3, 3)))
        assert found.middles[k] == pytest.approx(few.mean(axis=0), abs=1e-9)
        assert found.thickness_sq[k] == pytest.approx(max(values[0], 0.0), abs=1e-9)
        assert found.width_sq[k] == pytest.approx(max(values[1], 0.0), abs=1e-9)
        assert np.linalg.norm(found.normals[k]) == pytest.approx(1.0)
        if values[1] > 1e-4 and values[0] < 0.5 * values[1]:
            assert abs(found.normals[k] @ axes[:, 0]) == pytest.approx(1.0, abs=1e-6)
    whole = planes_through(points[:, : counts.min()])
    assert whole.middles == pytest.approx(points[:, : counts.min()].mean(axis=1), abs=1e-9)
    assert len(planes_through(np.zeros((0, count, 3))).normals) == 0


@pytest.mark.parametrize("count", [0, 4])
def test_handfuls_of_no_points_or_of_more_than_there_are_are_refused(count: int) -> None:
    with pytest.raises(InputError, match="expected 1 to 3 points of each plane"):
        planes_through(np.ones((2, 3, 3)), np.array([3, count]))


@pytest.mark.parametrize("side", [0.01, 0.05, 1.0])
def test_points_of_no_direction_have_the_variance_that_they_have(side: float) -> None:
    """Of an octahedron all extents are one, but for rounding: the three roots of the cubic lie on each other."""
    random, octahedron = np.random.default_rng(0), np.concatenate([np.eye(3), -np.eye(3)])
    found = 0
    for _ in range(1000):
        frame, _ = np.linalg.qr(random.normal(size=(3, 3)))
        plane = _fit(side * octahedron @ frame.T, limit=2.0 * side)
        if plane is not None:
            found += 1
            assert plane[7] == pytest.approx(2.0 * side**2 / 3.0, rel=1e-3)
            assert plane[8] == pytest.approx(2.0 * side**2, rel=1e-3)
    assert found > 900
