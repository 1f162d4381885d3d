"""Which points lie on which planes: against every plane asked of every point."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.maps.plane_voxels.plane_map import PlaneMap, PlaneVoxelConfig, find_planes
from boxplus.maps.plane_voxels.voxel_sums import VoxelSums, pack

CELL = 0.5


def room(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """Points on the walls of a room that the faces of voxels cut, and some that lie on none."""
    points = rng.uniform((-6.1, -3.3, -1.1), (5.2, 4.0, 2.2), (count, 3))
    axis, side = rng.integers(0, 3, count), rng.integers(0, 2, count)
    walls = np.array([[-6.1, 5.2], [-3.3, 4.0], [-1.1, 2.2]])
    on_wall = rng.uniform(size=count) < 0.9
    points[on_wall, axis[on_wall]] = walls[axis, side][on_wall] + 0.01 * rng.normal(size=count)[on_wall]
    return points.astype(np.float32)


def member(x: NDArray[np.float64], map_: PlaneMap, voxels: dict[int, int]) -> int:
    """By the definition: the only plane near enough whose voxels hold the foot; asked are those of the voxel and beside it."""
    cell = np.floor(x / CELL).astype(np.int64)
    gate = 4.0 * np.maximum(map_.thickness, max(float(np.median(map_.thickness)), 0.003))
    found = set()
    inside = x / CELL - cell
    for axis in (-1, 0, 1, 2):
        there = cell.copy()
        if axis >= 0:
            there[axis] += 1 if inside[axis] > 0.5 else -1
        plane = voxels.get(int(pack(there[None])[0]), -1)
        if plane < 0:
            continue
        n, d, c = map_.planes[plane, :3], map_.planes[plane, 3], map_.centres[plane]
        distance = n @ (x - c) + d
        foot = np.floor((x - distance * n) / CELL).astype(np.int64)
        if abs(distance) <= gate[plane] and voxels.get(int(pack(foot[None])[0]), -1) == plane:
            found.add(plane)
    return found.pop() if len(found) == 1 else -1


@pytest.mark.parametrize("seed", range(3))
def test_points_are_on_the_planes_that_the_definition_names(seed: int) -> None:
    rng = np.random.default_rng(seed)
    voxels = VoxelSums(CELL)
    for group in range(3):
        voxels.add(room(rng, 20_000), np.eye(3), np.zeros(3), group)
    map_ = find_planes(voxels, PlaneVoxelConfig())  # type: ignore[call-arg]
    by_key = dict(zip(map_.keys.tolist(), map_.plane_of.tolist(), strict=True))
    points = room(rng, 3000)
    ends = np.array([0, 1000, 1000, 3000])  # the second scan has no points
    scan, plane, clusters = map_.clusters_of_scans(points, ends, np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3)))
    expected = np.zeros((3, len(map_)))
    for k, x in enumerate(points.astype(np.float64)):
        if (own := member(x, map_, by_key)) >= 0:
            expected[np.searchsorted(ends, k, side="right") - 1, own] += 1.0
    counts = np.zeros_like(expected)
    counts[scan, plane] = clusters[:, 3, 3]
    assert expected.sum() > 2000 and len(map_) > 20
    np.testing.assert_array_equal(counts, expected)
    assert len(np.unique(scan * len(map_) + plane)) == len(scan)
    one = map_.clusters_of(points[1000:], np.eye(3), np.zeros(3))
    order = np.argsort(plane[scan == 2])
    np.testing.assert_array_equal(one[0], plane[scan == 2][order])
    np.testing.assert_array_equal(one[1], clusters[scan == 2][order])


def test_far_points_and_those_that_are_not_numbers_are_on_no_plane() -> None:
    rng = np.random.default_rng(0)
    voxels = VoxelSums(CELL)
    for group in range(2):
        voxels.add(room(rng, 20_000), np.eye(3), np.zeros(3), group)
    map_ = find_planes(voxels, PlaneVoxelConfig())  # type: ignore[call-arg]
    lost = np.array([[np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0], [1e9, 0.0, 0.0], [500.0, 0.0, 0.0]], dtype=np.float32)
    assert not len(map_.clusters_of(lost, np.eye(3), np.zeros(3))[0])


def test_a_map_without_planes_has_no_points() -> None:
    map_ = find_planes(VoxelSums(CELL), PlaneVoxelConfig())  # type: ignore[call-arg]
    assert not len(map_) and not len(map_.clusters_of(room(np.random.default_rng(0), 100), np.eye(3), np.zeros(3))[0])
