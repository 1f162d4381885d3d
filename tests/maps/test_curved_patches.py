"""Patches that bend where five points are no plane: against NumPy, on surfaces that are known, and within a measurement."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.filtering.iterated_update import Information
from boxplus.filtering.nav_state import NavState
from boxplus.filtering.plane_information import NOT_A_PLANE, USED
from boxplus.manifolds import so3
from boxplus.maps.curved_patches import FILLED_CELLS, PATCH, bend_planes
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.ikd_tree.search import STACK, STACK_DEPTH
from boxplus.maps.plane_matching import PLANE, WEIGHT
from boxplus.maps.plane_measurement import PlaneMeasurement, sees_one_way
from boxplus.maps.registration_config import RegistrationConfig

REACH_M, SIGMA_M, RANGE_M = 0.25, 0.02, 2.0
seeds = st.integers(0, 2**32 - 1)


def _column(random: np.random.Generator, radius: float, count: int, noise_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Points (count, 3) on the visible side, within 60 deg, of a column along z at the origin; and their normals."""
    angle, z = random.uniform(-np.pi / 3.0, np.pi / 3.0, count), random.uniform(-0.5, 0.5, count)
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    return normals * (radius + noise_m * random.normal(size=(count, 1))) + [0.0, 0.0, 1.0] * z[:, None], normals


def _chord(points: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """The record of the plane through five points."""
    centre = points.mean(axis=0)
    values, vectors = np.linalg.eigh((points - centre).T @ (points - centre))
    plane = np.zeros(PLANE)
    plane[:3], plane[3] = vectors[:, 0], vectors[:, 0] @ (centre + origin)
    plane[4] = plane[13] = values[0] / 2.0
    plane[WEIGHT] = 1.0
    return plane


def _bend(
    tree: IkdTree, x: NavState, p_lidar: np.ndarray, planes: np.ndarray, fate: np.ndarray, least_leverage: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    which, bent = np.zeros(len(planes), dtype=np.int64), np.zeros_like(planes)
    count = bend_planes(
        tree.view(),
        tree.origin,
        x.pack(),
        p_lidar.astype(np.float32),
        np.eye(6),
        least_leverage,
        RANGE_M**2,
        REACH_M,
        SIGMA_M**2,
        planes,
        fate,
        which,
        bent,
        np.zeros(PATCH, dtype=np.float32),
        np.zeros(STACK_DEPTH + PATCH, dtype=STACK),
    )
    return which[:count], bent[:count]


def _reference(y: np.ndarray, near: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, float, float, float, np.ndarray]:
    """Tangent normal (3,), distance of y from the patch, variance of a point, and over it those of patch and normal (3, 3)."""
    _, _, V = np.linalg.svd(u[None])
    basis = V[1:]
    d = near - y
    e, f = d @ basis[0], d @ basis[1]
    B = np.stack([np.ones(PATCH), e, f, 0.5 * e * e, e * f, 0.5 * f * f], axis=1)
    reach = max(REACH_M, np.linalg.norm(d, axis=1).max() / FILLED_CELLS)
    w = np.exp(-np.sum(d * d, axis=1) / reach**2)
    C = np.linalg.inv(B.T @ (w[:, None] * B) + np.diag([0.0] * 3 + [1.0, 2.0, 1.0]) * (SIGMA_M * REACH_M) ** 2)
    solution = C @ B.T @ (w * (d @ u))
    variance = w @ (d @ u - B @ solution) ** 2 / w.sum() * PATCH / (PATCH - 6)
    normal = u - solution[1:3] @ basis
    length = np.linalg.norm(normal)
    return normal / length, -solution[0] / length, variance, C[0, 0], basis.T @ C[1:3, 1:3] @ basis


@settings(max_examples=30)
@given(seeds, st.floats(0.15, 1.0), st.sampled_from([25, 60, 120]))
def test_against_numpy(seed: int, radius: float, count: int) -> None:
    random = np.random.default_rng(seed)
    origin = np.array([500.0, -200.0, 30.0])
    stored = _column(random, radius, count, noise_m=0.01)[0].astype(np.float32).astype(np.float64)
    tree = IkdTree(stored + origin)
    stored = tree.points() - origin
    points = _column(random, radius, 20)[0]
    x = NavState.identity().boxplus(np.concatenate([np.zeros(3), origin, np.zeros(18)]))
    y = points.astype(np.float32).astype(np.float64)
    nearest = [stored[np.argsort(np.linalg.norm(stored - point, axis=1))[:PATCH]] for point in y]
    planes = np.array([_chord(near[:5], origin) for near in nearest])
    fate = np.where(random.uniform(size=len(y)) < 0.8, USED, NOT_A_PLANE).astype(np.uint8)
    which, bent = _bend(tree, x, points, planes, fate)

    expected = {n: _reference(y[n], nearest[n], planes[n, :3]) for n in range(len(y))}
    wanted = [n for n, (_, _, variance, _, _) in expected.items() if fate[n] == USED and SIGMA_M**2 < planes[n, 4] > variance]
    assert which.tolist() == wanted
    for n, record in zip(which, bent, strict=True):
        normal, distance, variance, height, tilt = expected[n]
        np.testing.assert_allclose(record[:3], normal, atol=1e-4)
        assert abs(record[:3] @ (y[n] + origin) - record[3] - distance) < 1e-5
        np.testing.assert_allclose(1.2 * record[4], variance * (1.0 + height), rtol=2e-3)
        np.testing.assert_allclose(record[13], variance, rtol=2e-3)
        found = np.outer(record[5:8], record[5:8]) + np.outer(record[9:12], record[9:12])
        np.testing.assert_allclose(found, tilt, rtol=2e-3, atol=1e-3)
        for g, offset in ((5, 8), (9, 12)):  # where the point is, the tilt does not matter
            assert abs(record[g : g + 3] @ (y[n] + origin) - record[offset]) < 1e-6 * 500.0


@settings(max_examples=20)
@given(seeds, st.floats(0.2, 0.4))
def test_a_column_is_met_where_it_is_and_not_within(seed: int, radius: float) -> None:
    """Chords of columns as thick as a cell cut through; the patch's tangent touches."""
    random = np.random.default_rng(seed)
    stored = _column(random, radius, 120)[0]
    tree = IkdTree(stored)
    points, normals = _column(random, radius, 80)
    planes = np.array([_chord(stored[np.argsort(np.linalg.norm(stored - p, axis=1))[:15:3]], np.zeros(3)) for p in points])
    planes[:, 4] = np.maximum(planes[:, 4], 1.01 * SIGMA_M**2)
    which, bent = _bend(tree, NavState.identity(), points, planes, np.full(len(points), USED, dtype=np.uint8))
    assert len(which) > 40

    def off(records: np.ndarray) -> float:
        return float(np.sqrt(np.mean((np.sum(records[:, :3] * points[which], axis=1) - records[:, 3]) ** 2)))

    assert off(bent) < 0.75 * off(planes[which])
    cosines = [np.abs(np.sum(records[:, :3] * normals[which], axis=1)) for records in (planes[which], bent)]
    assert np.median(cosines[1]) > np.cos(np.deg2rad(8.0))


def test_what_noise_explains_stays_a_plane() -> None:
    random = np.random.default_rng(1)
    stored = random.uniform(-1.0, 1.0, (400, 3)) * [1.0, 1.0, 0.0] + 0.01 * random.normal(size=(400, 3))
    tree = IkdTree(stored)
    points = random.uniform(-0.7, 0.7, (50, 3)) * [1.0, 1.0, 0.0]
    planes = np.array([_chord(stored[np.argsort(np.linalg.norm(stored - p, axis=1))[:5]], np.zeros(3)) for p in points])
    fate = np.full(len(points), USED, dtype=np.uint8)
    which, _ = _bend(tree, NavState.identity(), points, planes, fate)
    assert len(which) <= 3  # a few in a hundred exceed twice their own standard deviation
    assert len(_bend(tree, NavState.identity(), points, planes, fate, least_leverage=1e9)[0]) == 0


def test_fewer_than_fifteen_neighbours_are_no_patch() -> None:
    points, _ = _column(np.random.default_rng(2), 0.2, PATCH - 1)
    planes = np.array([_chord(points[:5], np.zeros(3))])
    planes[:, 4] = 1.0
    which, _ = _bend(IkdTree(points), NavState.identity(), points[:1], planes, np.full(1, USED, dtype=np.uint8))
    assert len(which) == 0


def test_a_measurement_adds_up_the_patches_it_keeps() -> None:
    """Planes are weighed, looked at, and taken out again where patches take their place: the sums are those of what stays."""
    random = np.random.default_rng(3)
    floor = random.uniform(-4.0, 4.0, (4000, 3)) * [1.0, 1.0, 0.0] + 0.005 * random.normal(size=(4000, 3))
    columns = [_column(random, 0.2, 80, noise_m=0.005)[0] @ so3.exp(np.array([0.0, 0.0, yaw])).T for yaw in (0.0, 1.5, 3.0, 4.5)]
    centres = [(-3.0, 0.5, 0.5), (0.0, -3.0, 0.5), (3.0, 0.0, 0.5), (0.5, 3.0, 0.5)]
    world = np.concatenate([floor, *(c + centre for c, centre in zip(columns, centres, strict=True))])
    tree = IkdTree(world, cell_size=0.1)
    points = (world[::7] - np.array([0.0, 0.0, 1.0])).astype(np.float32)
    x = NavState.identity().boxplus(np.concatenate([np.zeros(3), [0.0, 0.0, 1.0], np.zeros(18)])).pack()
    measurement = PlaneMeasurement(points, tree, RegistrationConfig(), with_extrinsic=False, confirm=True)
    matched, kept = measurement.at(x, rematch=True), measurement.at(x, rematch=False)
    plain = PlaneMeasurement(points, tree, RegistrationConfig(), with_extrinsic=False).at(x, rematch=True)
    np.testing.assert_allclose(matched.A, kept.A, rtol=1e-9, atol=1e-6 * np.abs(kept.A).max())
    np.testing.assert_allclose(matched.b, kept.b, rtol=1e-9, atol=1e-6 * np.abs(kept.b).max())
    assert matched.used == kept.used
    assert np.abs(matched.A - plain.A)[3:5, 3:5].max() > 0.01 * plain.A[3, 3]


def _bushes(seed: int, sides: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of a map whose cells of 0.25 m are filled by half, and of a scan from the origin: 40 balls on each of `sides`."""
    random = np.random.default_rng(seed)
    both: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for ball in range(40 * sides):
        radius, distance = random.uniform(0.6, 1.2), random.uniform(8.0, 14.0)
        aside = random.uniform(-0.7, 0.7) + 2.0 * np.pi * (ball % sides) / sides
        centre = distance * np.array([np.cos(aside), np.sin(aside), random.uniform(-0.2, 0.2)])
        for seen in both:
            normals = random.normal(size=(int(7.0 * 4.0 * np.pi * radius**2), 3))
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            points = centre + radius * normals
            seen.append(points[np.sum(normals * points, axis=1) < -0.3 * np.linalg.norm(points, axis=1)])
    return np.concatenate(both[0]), np.concatenate(both[1])


def _information(seed: int, sides: int, *, bend_sparse: bool) -> Information:
    """What a scan of bushes says at its true pose."""
    stored, seen = _bushes(seed, sides)
    tree = IkdTree(stored, cell_size=0.25)
    measurement = PlaneMeasurement(
        seen.astype(np.float32), tree, RegistrationConfig(), with_extrinsic=False, confirm=True, bend_sparse=bend_sparse
    )
    return measurement.at(NavState.identity().pack(), rematch=True)


@settings(max_examples=10)
@given(seeds)
def test_a_sparse_map_of_bushes_pushes_a_sensor_that_looks_one_way_the_less(seed: int) -> None:
    def push(said: Information) -> float:
        return float(-np.linalg.solve(said.A[:6, :6], said.b[:6])[3])

    chords, patches = (push(_information(seed, 1, bend_sparse=sparse)) for sparse in (False, True))
    assert chords > 0.01  # towards the bushes
    assert abs(patches) < 0.5 * chords


@settings(max_examples=20)
@given(seeds)
def test_a_cone_of_130_degrees_is_one_way(seed: int) -> None:
    random = np.random.default_rng(seed)
    half_turn = so3.exp(random.normal(size=3))
    for cone_deg, one_way in ((40.0, True), (90.0, True), (120.0, True), (150.0, False), (360.0, False)):
        cos = random.uniform(np.cos(np.radians(0.5 * cone_deg)), 1.0, 5000)  # evenly over the sphere
        about = random.uniform(0.0, 2.0 * np.pi, 5000)
        sin = np.sqrt(1.0 - cos**2)
        rays = np.stack([cos, sin * np.cos(about), sin * np.sin(about)], axis=1) @ half_turn.T
        assert sees_one_way((random.uniform(1.0, 50.0, (5000, 1)) * rays).astype(np.float32)) is one_way
    assert not sees_one_way(np.zeros((0, 3), np.float32))
