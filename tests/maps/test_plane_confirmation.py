"""Planes on which a direction of the pose hangs: which are looked at, and which the map around them does not bear out."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.filtering.iterated_update import Information
from boxplus.filtering.nav_state import NavState
from boxplus.filtering.plane_information import UNCONFIRMED, USED
from boxplus.manifolds import so3
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.ikd_tree.search import STACK, STACK_DEPTH
from boxplus.maps.plane_confirmation import confirm_planes
from boxplus.maps.plane_matching import PLANE, WEIGHT
from boxplus.maps.plane_measurement import PlaneMeasurement
from boxplus.maps.registration_config import RegistrationConfig

NEAR_M, DENSE_M, THRESHOLD_M = 1.2, 0.7, 0.1
seeds = st.integers(0, 2**32 - 1)


def _state(random: np.random.Generator) -> NavState:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3.exp(random.normal(size=3)), 0.3 * random.normal(size=3)
    return NavState.identity(T).boxplus(np.concatenate([random.normal(size=6), np.zeros(18)]))


def _seen(world: np.ndarray, x: NavState) -> np.ndarray:
    return (((world - x.p_world_imu) @ x.R_world_imu - x.p_imu_lidar) @ x.R_imu_lidar).astype(np.float32)


@settings(max_examples=25)
@given(seeds, st.sampled_from([1, 5, 25]), st.sampled_from([0.02, 0.5, 3.0]))
def test_against_brute_force(seed: int, wanted: int, mean_leverages: float) -> None:
    random = np.random.default_rng(seed)
    x = _state(random)
    origin = np.array([300.0, -200.0, 10.0])
    on_floor = random.uniform(-2.0, 2.0, (300, 3)) * [1.0, 1.0, 0.02]
    stored = (np.concatenate([on_floor, random.uniform(-2.0, 2.0, (40, 3))]) + origin).astype(np.float32)
    tree = IkdTree(stored.astype(np.float64))
    x = x.boxplus(np.concatenate([np.zeros(3), origin, np.zeros(18)]))
    world = random.uniform(-2.0, 2.0, (30, 3)) * [1.0, 1.0, 0.1] + origin
    p_lidar = _seen(world, x)
    # Where the kernel sees the points: their coordinates are rounded to float32.
    p_imu = p_lidar.astype(np.float64) @ x.R_imu_lidar.T + x.p_imu_lidar
    world = p_imu @ x.R_world_imu.T + x.p_world_imu
    planes = np.zeros((len(world), PLANE))
    normals = random.normal(size=(len(world), 3)) * [0.03, 0.03, 1.0]
    planes[:, :3] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    planes[:, 3] = planes[:, :3] @ origin + 0.03 * random.normal(size=len(world))
    planes[:, WEIGHT] = random.uniform(100.0, 1000.0, len(world))
    fate = np.where(random.uniform(size=len(world)) < 0.8, USED, 1).astype(np.uint8)

    h = np.hstack([np.cross(p_imu, planes[:, :3] @ x.R_world_imu), planes[:, :3]])
    covariance = np.linalg.inv((planes[:, WEIGHT, None] * h).T @ h)
    leverage = planes[:, WEIGHT] * np.einsum("ni,ij,nj->n", h, covariance, h)
    limit = mean_leverages * 6.0 / len(world)
    expected, doubtful = fate.copy(), np.abs(leverage - limit) < 1e-6
    for n in range(len(world)):
        distance = np.linalg.norm(stored - world[n], axis=1)
        order = [i for i in np.argsort(distance)[:wanted] if distance[i] <= NEAR_M]
        off = np.abs(stored[order].astype(np.float64) @ planes[n, :3] - planes[n, 3])
        filled = len(order) == wanted and distance[order[-1]] <= DENSE_M
        if fate[n] == USED and leverage[n] > limit and not filled and (off > THRESHOLD_M).any():
            expected[n] = UNCONFIRMED
        close = [abs(distance[order[-1]] - DENSE_M)] if order else []
        doubtful[n] |= bool((np.abs(off - THRESHOLD_M) < 1e-4).any()) or min([*close, *np.abs(distance - NEAR_M)]) < 1e-4
        ranked = np.sort(distance)
        doubtful[n] |= bool(ranked[wanted] - ranked[wanted - 1] < 1e-4)

    found = fate.copy()
    refused = confirm_planes(
        tree.view(),
        tree.origin,
        x.pack(),
        p_lidar,
        covariance,
        limit,
        NEAR_M**2,
        DENSE_M**2,
        THRESHOLD_M,
        planes,
        found,
        np.zeros(wanted, np.float32),
        np.zeros(STACK_DEPTH + wanted, STACK),
    )
    np.testing.assert_array_equal(found[~doubtful], expected[~doubtful])
    assert refused == np.count_nonzero(found == UNCONFIRMED)


def _street(random: np.random.Generator, sparse: bool) -> tuple[IkdTree, np.ndarray, NavState]:
    """Walls on all sides of a sensor, and what a coarse LiDAR leaves of their foot: two lines on each wall and one before it.

    Returns map, scan and state. Two of the lines lie on a plane that tilts by 45°, the world has none. With `sparse` false
    there are points on ground and walls in between, and the scan meets them as well.
    """
    along = np.arange(-4.0, 4.0, 0.25)
    cells = np.stack(np.meshgrid(along, np.arange(3.0, 8.0, 0.25), indexing="ij"), -1).reshape(-1, 2)
    foot = np.arange(0.125, 2.2, 0.25)
    ground = np.stack(np.meshgrid(along, foot, indexing="ij"), -1).reshape(-1, 2)
    walls, hits = [], []
    for quarter in range(4):
        turn = so3.exp(np.array([0.0, 0.0, 0.5 * np.pi * quarter]))
        wall = np.stack([np.full(len(cells), 6.0), cells[:, 0], cells[:, 1]], 1)
        lines = ((6.0, 1.1), (6.0, 0.3), (5.7, 0.0))
        rows = [np.stack([np.full(8, ahead), along[12:20], np.full(8, z)], 1) for ahead, z in lines]
        if not sparse:
            rows.append(np.stack([np.full(len(ground), 6.0), ground[:, 0], ground[:, 1]], 1))
            rows.append(np.stack([6.0 - ground[:, 1], ground[:, 0], np.zeros(len(ground))], 1))
        walls.append(np.concatenate([wall, *rows]) @ turn.T)
        hits.append(np.concatenate([wall, *rows]) @ turn.T)
    x = NavState.identity().boxplus(np.concatenate([np.zeros(5), [2.0], np.zeros(18)]))
    noise = 0.005 * random.normal(size=np.concatenate(walls).shape)
    return IkdTree(np.concatenate(walls) + noise), _seen(np.concatenate(hits), x), x


def _vertical(sparse: bool, confirm: bool) -> tuple[Information, dict[str, int]]:
    tree, points, x = _street(np.random.default_rng(0), sparse)
    measurement = PlaneMeasurement(points, tree, RegistrationConfig(), with_extrinsic=False, confirm=confirm)
    information = measurement.at(x.pack(), rematch=True)
    rejected = dict(measurement.rejected())
    assert information.used + sum(rejected.values()) == len(points)
    assert np.array_equal(information.A, information.A.T)
    # What was refused stays refused as long as nothing is searched anew.
    again = measurement.at(x.pack(), rematch=False)
    assert again.used == information.used
    np.testing.assert_allclose(again.A, information.A, atol=1e-12 * information.A.max())
    np.testing.assert_allclose(again.b, information.b, atol=1e-12 * np.abs(information.A).max())
    return information, rejected


def test_planes_between_two_scan_lines_do_not_hold_the_height() -> None:
    reason = "much hangs on it, and its surroundings are no plane"
    believed, rejected = _vertical(sparse=True, confirm=False)
    assert reason not in rejected
    looked_at, rejected = _vertical(sparse=True, confirm=True)
    assert 20 < rejected[reason] <= 96
    assert believed.A[5, 5] > 5.0 * looked_at.A[5, 5]
    # What the walls say stays.
    np.testing.assert_allclose(looked_at.A[3:5, 3:5].diagonal(), believed.A[3:5, 3:5].diagonal(), rtol=0.02)


def test_a_filled_map_is_not_doubted() -> None:
    (believed, _), (looked_at, rejected) = (_vertical(sparse=False, confirm=confirm) for confirm in (False, True))
    assert sum(rejected.values()) < 0.01 * looked_at.used
    np.testing.assert_allclose(looked_at.A[3:6, 3:6].diagonal(), believed.A[3:6, 3:6].diagonal(), rtol=0.01)
