"""The voxel filter against a dictionary of voxels (docs/lidar_inertial_odometry.md)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.errors import InputError
from boxplus.sensors.lidar.downsampling import VoxelFilter

seeds = st.integers(0, 2**32 - 1)


def _points(seed: int, count: int, extent: float) -> np.ndarray:
    random = np.random.default_rng(seed)
    return random.uniform(-extent, extent, (count, 3)).astype(np.float32)


def _voxels(points: np.ndarray, size: float) -> list[np.ndarray]:
    """Rows of the points in each voxel, voxels in the order in which they are first seen."""
    found: dict[tuple[int, ...], list[int]] = {}
    for row, cell in enumerate(np.floor(points.astype(np.float64) * (1.0 / size)).astype(int)):
        found.setdefault(tuple(cell), []).append(row)
    return [np.array(rows) for rows in found.values()]


@settings(max_examples=40)
@given(seeds, st.integers(0, 300), st.sampled_from([0.5, 3.0, 80.0]), st.sampled_from([0.25, 0.3, 1.0]))
def test_against_a_dictionary(seed: int, count: int, extent: float, size: float) -> None:
    points = _points(seed, count, extent)
    centroids, representatives = VoxelFilter(size)(points)
    voxels = _voxels(points, size)
    assert len(centroids) == len(representatives) == len(voxels)
    for centroid, representative, rows in zip(centroids, representatives, voxels, strict=True):
        inside = points[rows].astype(np.float64)
        assert np.allclose(centroid, inside.mean(axis=0), atol=1e-5 * max(1.0, extent))
        distance = np.linalg.norm(inside - inside.mean(axis=0), axis=1)
        chosen = np.flatnonzero((points[rows] == representative).all(axis=1))
        assert len(chosen) > 0  # a point that was really seen, of this voxel
        assert distance[chosen[0]] <= distance.min() + 1e-4 * max(1.0, extent / 10.0)


def test_scratch_memory_does_not_leak_from_scan_to_scan() -> None:
    voxel_filter = VoxelFilter(0.5)
    for seed, count in enumerate([50, 3000, 10, 0, 1500]):
        points = _points(seed, count, 10.0)
        for used, fresh in zip(voxel_filter(points), VoxelFilter(0.5)(points), strict=True):
            assert np.array_equal(used, fresh)


def test_the_result_belongs_to_the_caller() -> None:
    voxel_filter, points = VoxelFilter(0.5), _points(0, 100, 5.0)
    first = voxel_filter(points)
    kept = [part.copy() for part in first]
    voxel_filter(_points(1, 100, 5.0))
    for part, before in zip(first, kept, strict=True):
        assert np.array_equal(part, before)


def test_with_a_limit_the_voxels_adapt_to_the_surroundings() -> None:
    random = np.random.default_rng(0)
    wall = np.column_stack([random.uniform(-20, 20, (20000, 2)), np.full(20000, 0.05)]).astype(np.float32)
    voxel_filter = VoxelFilter(0.2, 500)
    for _ in range(20):
        count = len(voxel_filter(wall)[0])
    assert 400 < count < 600
    assert voxel_filter.voxel_size > 0.2
    for _ in range(40):
        voxel_filter(wall[:50])
    assert voxel_filter.voxel_size == pytest.approx(0.2)


@pytest.mark.parametrize("size", [0.0, -1.0, np.nan, np.inf])
def test_a_voxel_has_a_size(size: float) -> None:
    with pytest.raises(InputError, match=r"expected voxel_size as a positive length in metres – got .* – typical values"):
        VoxelFilter(size)


@settings(max_examples=20)
@given(seeds, st.integers(0, 300))
def test_means_of_what_else_the_points_have(seed: int, count: int) -> None:
    points, values = _points(seed, count, 3.0), np.random.default_rng(seed).normal(size=(count, 2))
    voxel_filter = VoxelFilter(0.5)
    _, representatives = voxel_filter(points)
    assert np.array_equal(points[voxel_filter.representatives], representatives)
    expected = [values[rows].mean(axis=0) for rows in _voxels(points, 0.5)]
    np.testing.assert_allclose(voxel_filter.means(values), np.reshape(expected, (-1, 2)), atol=1e-6)
