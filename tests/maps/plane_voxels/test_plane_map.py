"""Planes of a map: found where they are, whole though a face between voxels cuts them, and what lies on them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.maps.plane_voxels.plane_map import PlaneMap, PlaneVoxelConfig, find_planes
from boxplus.maps.plane_voxels.thickness import sharpness
from boxplus.maps.plane_voxels.voxel_sums import COUNT, VoxelSums, clusters, coordinates, moments, pack, shifted

SIGMA = 0.02
NOWHERE = np.eye(3), np.zeros(3)


def wall(at: float, rng: np.random.Generator, count: int = 6000, size: float = 3.9) -> NDArray[np.float32]:
    """Points on x = at, with noise along x, within the voxel of 4 m beside the origin."""
    points = rng.uniform(0.05, size, (count, 3))
    points[:, 0] = at + SIGMA * rng.normal(size=count)
    return points.astype(np.float32)


def planes_of(*groups: NDArray[np.float32]) -> PlaneMap:
    voxels = VoxelSums(0.5)
    for number, points in enumerate(groups):
        voxels.add(points, *NOWHERE, number)
    return find_planes(voxels, PlaneVoxelConfig())  # type: ignore[call-arg]


def test_sums_are_those_of_the_points() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-40.0, 40.0, (20_000, 3)).astype(np.float32)  # more voxels than the first table holds
    voxels = VoxelSums(2.0)
    voxels.add(points, *NOWHERE)
    slots = voxels.filled()
    assert voxels.count == len(slots) and voxels.sums[slots, COUNT].sum() == len(points)
    cells = coordinates(voxels.keys[slots])
    np.testing.assert_array_equal(pack(cells), voxels.keys[slots])
    middle = (cells[7] + 0.5) * 2.0
    inside = points[(np.floor(points / 2.0) == cells[7]).all(axis=1)].astype(np.float64)
    mean, covariance = moments(voxels.sums[slots[7:8]])
    np.testing.assert_allclose(mean[0] + middle, inside.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(covariance[0], np.cov(inside.T, bias=True), atol=1e-6)
    moved = clusters(shifted(voxels.sums[slots[7:8]], middle[None]))[0]
    homogeneous = np.hstack([inside, np.ones((len(inside), 1))])
    np.testing.assert_allclose(moved, homogeneous.T @ homogeneous, rtol=1e-9, atol=1e-4)


def test_a_wall_is_one_plane_of_its_thickness() -> None:
    rng = np.random.default_rng(1)
    found = planes_of(wall(2.2, rng), wall(2.2, rng))
    assert len(found) == 1
    assert abs(found.planes[0, 0]) == pytest.approx(1.0, abs=1e-4)
    assert found.centres[0, 0] == pytest.approx(2.2, abs=0.002)
    assert found.thickness[0] == pytest.approx(SIGMA, rel=0.05)


def test_a_plane_that_one_keyframe_sees_is_none() -> None:
    assert len(planes_of(wall(2.2, np.random.default_rng(2)))) == 0


def test_a_corner_is_split_until_its_walls_are_apart() -> None:
    rng = np.random.default_rng(3)
    both = [np.concatenate([wall(1.2, rng), wall(2.8, rng)[:, [1, 0, 2]]]) for _ in range(2)]
    found = planes_of(*both)
    assert len(found) > 4
    along = np.abs(found.planes[:, :3]).max(axis=1)
    assert along.min() > 0.99
    at = np.where(np.abs(found.planes[:, 0]) > 0.9, np.abs(found.centres[:, 0] - 1.2), np.abs(found.centres[:, 1] - 2.8))
    assert at.max() < 0.02


def test_a_wall_in_a_face_between_voxels_is_taken_whole() -> None:
    """Half of its points lie in either voxel: two planes would each be pushed away from it by 0.8 σ."""
    rng = np.random.default_rng(4)
    others = [(2.2, [1, 0, 2]), (2.2, [2, 1, 0])]
    groups = [np.concatenate([wall(4.0, rng), *(wall(at, rng)[:, axes] for at, axes in others)]) for _ in range(2)]
    found = planes_of(*groups)
    world = np.zeros((len(found), 4, 4))
    for points in groups:
        numbers, own = found.clusters_of(points, *NOWHERE)
        T = np.tile(np.eye(4), (len(numbers), 1, 1))
        T[:, :3, 3] = -found.centres[numbers]
        world[numbers] += T @ own @ np.swapaxes(T, 1, 2)
    fitted = found.refitted(world, np.ones(len(found), dtype=np.int64))
    is_wall = (np.abs(found.planes[:, 0]) > 0.9) & (np.abs(found.centres[:, 0] - 4.0) < 0.1)
    seen = np.flatnonzero(is_wall & (world[:, 3, 3] > 0.0))
    assert world[seen, 3, 3].sum() > 0.8 * 12_000
    np.testing.assert_allclose(fitted.centres[seen, 0], 4.0, atol=0.004)
    np.testing.assert_allclose(fitted.thickness[seen], SIGMA, rtol=0.1)


def test_what_was_seen_from_behind_is_on_another_plane() -> None:
    """The ceiling below a floor is as flat as the floor, and with a drift of a hand's breadth lies in the same place."""
    rng = np.random.default_rng(7)
    points = wall(2.2, rng)
    found = planes_of(points, wall(2.2, rng))
    there = np.hstack([points - found.centres[0], np.ones((len(points), 1))])
    sides = (np.zeros(3), np.array([4.0, 0.0, 0.0]))
    for number, seen_from in enumerate(sides):
        fitted = found.refitted(np.einsum("ni,nj->ij", there, there)[None], found.seen_from(seen_from, np.arange(1)))
        assert fitted.planes[0, :3] @ (seen_from - fitted.centres[0]) > 0.0
        for other, p in enumerate(sides):
            own = fitted.clusters_of((points - p).astype(np.float32), np.eye(3), p)[0]
            assert len(own) == (other == number)


def test_points_near_two_planes_belong_to_neither() -> None:
    rng = np.random.default_rng(5)
    both = [np.concatenate([wall(1.2, rng), wall(2.8, rng)[:, [1, 0, 2]]]) for _ in range(2)]
    found = planes_of(*both)
    corner = np.array([[1.2, 2.8, 1.0]], dtype=np.float32)
    assert not len(found.clusters_of(corner, *NOWHERE)[0])


def test_thickness_shows_a_shift_far_below_the_noise() -> None:
    rng = np.random.default_rng(6)
    points = wall(0.0, rng, count=40_000).astype(np.float64)
    shifted_points = points + [[0.002], [-0.002]][0] * np.repeat([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], 20_000, axis=0)
    before, after = (sharpness((h := np.hstack([p, np.ones((len(p), 1))])).T[None] @ h[None]) for p in (shifted_points, points))
    assert after.points == before.points == 40_000
    assert after.thickness == pytest.approx(SIGMA, rel=0.03)
    assert before.thickness**2 - after.thickness**2 == pytest.approx(0.002**2, rel=0.5)
    assert before.entropy > after.entropy
