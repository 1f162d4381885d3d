"""Matching a scan with planes of the map against brute force (docs/lidar_inertial_odometry.md, section 5)."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.filtering.nav_state import NavState
from boxplus.filtering.plane_information import FEW_NEIGHBOURS, NOT_A_PLANE, ONE_LINE, USED
from boxplus.manifolds import so3
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.ikd_tree.search import STACK, STACK_DEPTH
from boxplus.maps.plane_matching import MANY, NEIGHBOURS, PLANE, match_planes, settle_normals

MAX_DISTANCE = 0.8
THRESHOLD = 0.1
GRAZING = 0.04  # sine of the least angle between a ray and the plane it hits
seeds = st.integers(0, 2**32 - 1)


@dataclass
class Match:
    neighbours: np.ndarray
    reach: np.ndarray
    planes: np.ndarray
    fate: np.ndarray


def _new(count: int) -> Match:
    neighbours, reach = np.zeros((count, NEIGHBOURS, 3), np.float32), np.zeros((count, 4), np.float32)
    return Match(neighbours, reach, np.zeros((count, PLANE)), np.zeros(count, np.uint8))


def _match(tree: IkdTree, x: NavState, points: np.ndarray, into: Match | None = None) -> Match:
    match = into or _new(len(points))
    match_planes(
        tree.view(),
        tree.origin,
        x.pack(),
        points,
        0,
        len(points),
        MAX_DISTANCE**2,
        THRESHOLD,
        into is not None,
        match.neighbours,
        match.reach,
        match.planes,
        match.fate,
        np.zeros(NEIGHBOURS, np.float32),
        np.zeros(STACK_DEPTH + MANY, STACK),
    )
    return match


def _corner(seed: int, far: bool = False) -> tuple[IkdTree, np.ndarray, NavState, np.ndarray]:
    """A map of three rough walls, a state that looks into them, and a scan."""
    random = np.random.default_rng(seed)
    walls = [np.insert(random.uniform(0.0, 4.0, (120, 2)), axis, 0.0, axis=1) for axis in range(3)]
    offset = np.array([3000.0, -2000.0, 100.0]) if far else np.zeros(3)
    world = np.concatenate(walls) + 0.02 * random.normal(size=(360, 3)) + offset
    R, R_L = so3.exp(random.normal(size=(2, 3)))
    zero = np.zeros(3)
    p_L = 0.2 * random.normal(size=3)
    x = NavState(R, np.array([2.0, 1.5, 1.0]) + offset, zero, zero, zero, zero, R_L, p_L)
    seen = world[random.integers(360, size=40)] + 0.1 * random.normal(size=(40, 3))
    seen[-5:] += 1.0  # in the air, with few neighbours or none
    points = (((seen - x.p_world_imu) @ R - p_L) @ R_L).astype(np.float32)
    return IkdTree(world), world, x, points


def _world(x: NavState, points: np.ndarray) -> np.ndarray:
    return (points.astype(np.float64) @ x.R_imu_lidar.T + x.p_imu_lidar) @ x.R_world_imu.T + x.p_world_imu


@dataclass
class Fit:
    """The plane of some points by singular values, and whether they may be those of one line as seen along a ray."""

    points: np.ndarray
    ray: np.ndarray

    def __post_init__(self) -> None:
        self.centroid = self.points.mean(axis=0)
        _, self.singular, Vt = np.linalg.svd(self.points - self.centroid)
        self.normal = Vt[2]
        self.distance = np.abs((self.points - self.centroid) @ self.normal).max()
        self.sine = abs(self.normal @ self.ray) / np.linalg.norm(self.ray)
        thinnest = 0.02 * len(self.points) * min(1.0, np.linalg.norm(self.ray) ** 4 / 15.0**4)
        self.on_line = self.sine < GRAZING or self.singular[1] ** 2 < thinnest
        self.no_plane = self.distance > THRESHOLD or self.singular[1] < 0.05 * self.singular[0]
        # Singles and closed forms round differently.
        self.doubtful = (
            abs(self.sine - GRAZING) < 2e-3
            or abs(self.distance - THRESHOLD) < 1e-4
            or abs(self.singular[1] - 0.05 * self.singular[0]) < 1e-3 * self.singular[0]
            or abs(self.singular[1] ** 2 - thinnest) < 1e-4
            or self.singular[1] - self.singular[2] < 0.05
        )


def _brute_force(stored: np.ndarray, y: np.ndarray, sensor: np.ndarray) -> tuple[int, Fit | None, bool]:
    """Fate and plane of a point at y in a map (N, 3), seen from `sensor`; and whether rounding may decide otherwise."""
    squared = np.sort(np.sum((stored - y) ** 2, axis=1))
    order = np.argsort(np.sum((stored - y) ** 2, axis=1))
    doubtful = bool((np.abs(squared[[NEIGHBOURS - 1, MANY - 1]] - MAX_DISTANCE**2) < 1e-4).any())
    if squared[NEIGHBOURS - 1] > MAX_DISTANCE**2:
        return FEW_NEIGHBOURS, None, doubtful
    five = Fit(stored[order[:NEIGHBOURS]], y - sensor)
    if five.no_plane or not five.on_line:
        return (NOT_A_PLANE if five.no_plane else USED), five, doubtful or five.doubtful
    if squared[MANY - 1] > MAX_DISTANCE**2:
        return ONE_LINE, five, doubtful or five.doubtful
    fifteen = Fit(stored[order[:MANY]], y - sensor)
    refused = fifteen.no_plane or fifteen.on_line
    return (ONE_LINE if refused else USED), fifteen, doubtful or five.doubtful or fifteen.doubtful


@settings(max_examples=15)
@given(seeds, st.booleans())
def test_against_brute_force(seed: int, far: bool) -> None:
    tree, _, x, points = _corner(seed, far)
    match = _match(tree, x, points)
    stored = tree.points()
    sensor = x.R_world_imu @ x.p_imu_lidar + x.p_world_imu
    compared = 0
    for n, y in enumerate(_world(x, points)):
        fate, fit, doubtful = _brute_force(stored, y, sensor)
        if doubtful:
            continue
        compared += 1
        assert match.fate[n] == fate
        if fate == USED:
            assert fit is not None
            u, g = match.planes[n, :3], np.stack([match.planes[n, 5:8], match.planes[n, 9:12]])
            assert np.isclose(abs(u @ fit.normal), 1.0, atol=1e-5)
            assert np.isclose(match.planes[n, 3], u @ fit.centroid, atol=2e-3 if far else 1e-4)
            assert np.isclose(match.planes[n, 4], fit.singular[2] ** 2 / (len(fit.points) - 3), atol=1e-4)
            # The outer products of the two vectors are the inverse of the scatter within the plane.
            assert np.allclose(g @ u, 0, atol=1e-6 * np.abs(g).max())
            inside = (fit.points - fit.centroid) @ (np.eye(3) - np.outer(u, u))
            inverse = np.linalg.pinv(inside.T @ inside, rcond=1e-6)
            assert np.allclose(g.T @ g, inverse, rtol=1e-2, atol=(3e-2 if far else 2e-3) * np.abs(g).max() ** 2)
            assert np.allclose(match.planes[n, [8, 12]], g @ fit.centroid, rtol=1e-5, atol=1e-4 * np.abs(g).max())
    assert compared > 10


def test_a_ring_around_a_corner_is_not_taken_for_a_floor() -> None:
    """Two walls that meet at (20, 20), seen by the one horizontal ring of a LiDAR at the origin."""
    along = np.arange(15.0, 20.0, 0.4)
    wall = np.full_like(along, 20.0)
    ring = np.concatenate([np.stack([along, wall, 0.0 * wall], axis=1), np.stack([wall, along, 0.0 * wall], axis=1)])
    ring += 0.02 * np.random.default_rng(0).normal(size=ring.shape) * (1.0, 1.0, 0.0)
    match = _match(IkdTree(ring), NavState.identity(), ring.astype(np.float32))
    assert (match.fate != USED).all()
    # A second ring makes planes of both walls.
    match = _match(
        IkdTree(np.concatenate([ring, ring + np.array([0.0, 0.0, 0.5])])), NavState.identity(), ring.astype(np.float32)
    )
    used = match.fate == USED
    assert used.mean() > 0.5
    assert (np.abs(match.planes[used, 2]) < 0.3).all()


def _rings(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A wall 18 m ahead in rings 0.4 m apart, each a dense line, and the points of the middle one."""
    across = np.arange(-3.0, 3.0, 0.1)
    wall = np.concatenate(
        [np.stack([np.full_like(across, 18.0), across, np.full_like(across, z)], axis=1) for z in (-0.4, 0.0, 0.4)]
    )
    wall += np.random.default_rng(seed).normal(size=wall.shape) * (0.01, 0.0, 0.05)
    return wall, wall[60:120].astype(np.float32)


def test_where_five_points_lie_on_a_line_fifteen_show_the_next_one() -> None:
    wall, points = _rings(seed=1)
    match = _match(IkdTree(wall), NavState.identity(), points)
    used = match.fate == USED
    assert used.mean() > 0.8
    assert (np.abs(match.planes[used, 0]) > 0.99).all()
    alone = _match(IkdTree(wall[60:120]), NavState.identity(), points)
    assert (alone.fate != USED).all()


@settings(max_examples=15)
@given(seeds)
def test_the_variance_of_a_normal_is_drawn_to_that_of_all(seed: int) -> None:
    tree, _, x, points = _corner(seed)
    match = _match(tree, x, points)
    used = match.fate == USED
    rough = np.count_nonzero(match.fate == NOT_A_PLANE)
    own = match.planes[used, 4]
    common = (own.sum() + rough * THRESHOLD**2) / max(len(own) + rough, 1)
    settle_normals(x.pack(), points, THRESHOLD, match.planes, match.fate)
    variance = (2.0 * own + common) / 3.0
    np.testing.assert_allclose(match.planes[used, 13], variance)
    # Refused is what contains its ray within two standard deviations of the normal.
    ray = points[used].astype(np.float64) @ x.R_imu_lidar.T @ x.R_world_imu.T
    along = np.einsum("ni,ni->n", match.planes[used, :3], ray)
    tilt = np.einsum("ni,ni->n", match.planes[used, 5:8], ray) ** 2 + np.einsum("ni,ni->n", match.planes[used, 9:12], ray) ** 2
    np.testing.assert_array_equal(match.fate[used], np.where(along**2 < 4.0 * variance * tilt, ONE_LINE, USED))


@settings(max_examples=15)
@given(seeds, st.sampled_from([0.0, 0.01, 0.3]), st.booleans())
def test_a_warm_search_finds_what_a_cold_one_finds(seed: int, moved: float, of_rings: bool) -> None:
    tree, _, x, points = _corner(seed)
    if of_rings:
        wall, points = _rings(seed)
        tree, x = IkdTree(wall), NavState.identity()
    match = _match(tree, x, points)
    shift = np.zeros(24)
    shift[:6] = moved * np.random.default_rng(seed + 1).normal(size=6)
    elsewhere = x.boxplus(shift)
    warm, cold = _match(tree, elsewhere, points, into=match), _match(tree, elsewhere, points)
    assert np.array_equal(warm.fate, cold.fate)
    matched = cold.fate != FEW_NEIGHBOURS
    assert np.array_equal(warm.neighbours[matched], cold.neighbours[matched])
    used = cold.fate == USED
    assert np.array_equal(warm.planes[used], cold.planes[used])
    assert (cold.reach[:, 3] > 0.0).any() or not of_rings or moved == 0.3
    np.testing.assert_array_equal(warm.reach[:, 3], cold.reach[:, 3])


@settings(max_examples=10)
@given(seeds, st.sampled_from([1, 2, 7]))
def test_what_the_point_before_needed_decides_nothing(seed: int, run: int) -> None:
    """Points on rings, which need fifteen neighbours, and points of a dense floor, which do not, in runs of some of each."""
    random = np.random.default_rng(seed)
    wall, on_rings = _rings(seed)
    floor = np.stack([random.uniform(4.0, 9.0, 800), random.uniform(-3.0, 3.0, 800), random.normal(-1.5, 0.01, 800)], axis=1)
    points = np.concatenate([on_rings, floor[: len(on_rings)] + random.normal(scale=0.02, size=(len(on_rings), 3))])
    order = np.argsort(np.tile(np.arange(len(on_rings)) // run, 2) * 2 + np.repeat([0, 1], len(on_rings)), kind="stable")
    points = points[order].astype(np.float32)
    tree, x = IkdTree(np.concatenate([wall, floor])), NavState.identity()
    together, alone = _match(tree, x, points), [_match(tree, x, point[None]) for point in points]
    assert 0.2 < (together.reach[:, 3] > 0.0).mean() < 0.8
    for name in ("fate", "neighbours", "planes"):
        np.testing.assert_array_equal(getattr(together, name), np.concatenate([getattr(one, name) for one in alone]))
    np.testing.assert_array_equal(together.reach[:, 3], np.concatenate([one.reach[:, 3] for one in alone]))


def test_an_empty_map_has_no_planes() -> None:
    points = np.ones((3, 3), np.float32)
    assert np.all(_match(IkdTree(), NavState.identity(), points).fate == FEW_NEIGHBOURS)


@settings(max_examples=15)
@given(seeds)
def test_no_neighbour_is_lost_far_from_the_origin_of_the_map(seed: int) -> None:
    _, world, x, points = _corner(seed)
    far = np.array([4000.0, 3000.0, 0.0])
    tree = IkdTree(np.zeros((1, 3)))  # puts the origin at zero
    tree.insert(world + far)
    x = NavState(x.R_world_imu, x.p_world_imu + far, *(np.zeros(3),) * 4, x.R_imu_lidar, x.p_imu_lidar)
    first = _match(tree, x, points)
    found = first.fate != FEW_NEIGHBOURS
    again = _match(tree, x, points, copy.deepcopy(first))
    np.testing.assert_array_equal(again.fate, first.fate)
    np.testing.assert_array_equal(again.neighbours[found], first.neighbours[found])
    alone = np.concatenate([_match(tree, x, point[None]).fate for point in points])  # no point before bounds the search
    np.testing.assert_array_equal(alone, first.fate)
