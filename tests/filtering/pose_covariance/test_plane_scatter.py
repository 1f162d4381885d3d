"""What residuals bear out of the variance that weights state, against pieces counted one by one and against sampled errors."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.filtering.nav_state import NavState
from boxplus.filtering.plane_information import GATED, USED
from boxplus.filtering.pose_covariance.plane_scatter import LEAST, plane_scatter
from boxplus.maps.plane_matching import PLANE
from tests.filtering.random_states import random_state

seeds = st.integers(0, 2**32 - 1)
_WEIGHT = 400.0  # a standard deviation of 5 cm


def _walls(random: np.random.Generator, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) on the walls, floor and ceiling of a room of 12.6 × 10.8 × 4.4 m, world frame, with the normals there."""
    half = np.array([6.3, 5.4, 2.2])
    y, axis = random.uniform(-half, half, (points, 3)), random.integers(0, 3, points)
    side = random.choice([-1.0, 1.0], points)
    y[np.arange(points), axis] = side * half[axis]
    normals = np.zeros((points, 3))
    normals[np.arange(points), axis] = side
    return y, normals


def _scan(x: NavState, y: np.ndarray, normals: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (n, 3) LiDAR frame that lie `z` (n,) off their planes, these planes, and the rows h (n, 6) of the pose."""
    p_imu = (y - x.p_world_imu) @ x.R_world_imu
    p_lidar = ((p_imu - x.p_imu_lidar) @ x.R_imu_lidar).astype(np.float32)
    planes = np.zeros((len(y), PLANE))
    planes[:, :3] = normals
    seen = x.to_world(p_lidar)
    planes[:, 3] = np.einsum("ij,ij->i", normals, seen) - z
    planes[:, 14] = _WEIGHT
    return p_lidar, planes, np.hstack([np.cross(p_imu, normals @ x.R_world_imu), normals])


@settings(max_examples=30)
@given(seeds, st.sampled_from([0.2, 0.3]))
def test_it_is_the_worst_direction_of_the_sandwich(seed: int, size: float) -> None:
    """B of the pieces, one by one, against A: so few that few share a slot."""
    random = np.random.default_rng(seed)
    x = random_state(random)
    y, normals = _walls(random, 120)
    z = size / np.sqrt(_WEIGHT) * random.normal(size=len(y))
    p_lidar, planes, h = _scan(x, y, normals, z)
    fate = np.where(random.random(len(y)) < 0.1, GATED, USED).astype(np.uint8)
    pieces: defaultdict[tuple[int, ...], list[int]] = defaultdict(list)
    for n in np.flatnonzero(fate == USED):
        at = x.to_world(p_lidar[n : n + 1])[0]
        pieces[*np.floor(at).astype(int), int(np.abs(normals[n]).argmax())].append(n)
    A = _WEIGHT * h[fate == USED].T @ h[fate == USED]
    B = np.zeros((6, 6))
    for piece in pieces.values():
        g, trace = _WEIGHT * h[piece].T @ z[piece], np.trace(np.linalg.solve(A, _WEIGHT * h[piece].T @ h[piece]))
        B += np.outer(g, g) / (1.0 - trace) ** 2
    expected = LEAST + np.linalg.eigvals(np.linalg.solve(A, B)).real.max()
    assert plane_scatter(x.pack(), p_lidar, planes, fate, A) == pytest.approx(min(expected, 1.0), rel=0.25)


@pytest.mark.parametrize("size", [0.1, 0.3, 0.45])
@pytest.mark.parametrize("shared", [False, True])
def test_errors_of_the_pose_spread_no_more_than_it_says(size: float, shared: bool) -> None:
    """Sampled: independent errors of points, and errors that pieces of a metre share; never surer than the truth."""
    random = np.random.default_rng(1)
    x = random_state(random)
    y, normals = _walls(random, 800)
    piece = np.unique(np.hstack([np.floor(y), np.abs(normals).argmax(axis=1)[:, None]]), axis=0, return_inverse=True)[1].ravel()
    said, errors = [], []
    for _ in range(200):
        own = random.normal(size=len(y))
        of_piece = random.normal(size=piece.max() + 1)[piece]
        z = size / np.sqrt(_WEIGHT) * (np.sqrt(0.5) * (own + of_piece) if shared else own)
        p_lidar, planes, h = _scan(x, y, normals, z)
        A = _WEIGHT * h.T @ h
        said.append(plane_scatter(x.pack(), p_lidar, planes, np.zeros(len(y), np.uint8), A))
        errors.append(np.linalg.solve(A, _WEIGHT * h.T @ z))
    really = np.linalg.eigvals(A @ np.cov(np.transpose(errors))).real
    assert really.max() < np.mean(said) * 1.1  # as 200 samples scatter
    assert np.mean(said) < LEAST + 2.5 * really.max()
    assert np.std(said) < 0.3 * np.mean(said)


def test_more_is_never_borne_out_than_is_stated_and_never_nothing() -> None:
    random = np.random.default_rng(2)
    x = random_state(random)
    y, normals = _walls(random, 200)
    found = []
    for z in (np.zeros(len(y)), 0.5 * random.normal(size=len(y))):
        p_lidar, planes, h = _scan(x, y, normals, z)
        found.append(plane_scatter(x.pack(), p_lidar, planes, np.zeros(len(y), np.uint8), _WEIGHT * h.T @ h))
    assert found == [pytest.approx(LEAST, abs=1e-6), 1.0]


def test_points_that_leave_a_direction_open_bear_nothing_out() -> None:
    """A floor alone: nothing to hold residuals against."""
    random = np.random.default_rng(3)
    y = np.column_stack([random.uniform(-5, 5, (100, 2)), np.zeros(100)])
    normals = np.tile([0.0, 0.0, 1.0], (100, 1))
    p_lidar, planes, h = _scan(NavState.identity(), y, normals, np.zeros(100))
    found = plane_scatter(NavState.identity().pack(), p_lidar, planes, np.zeros(100, np.uint8), _WEIGHT * h.T @ h)
    assert found == 1.0


@pytest.mark.parametrize("end_points", [15, 40])
@pytest.mark.parametrize("size", [0.1, 0.3])
def test_a_piece_on_which_a_direction_hangs_says_nothing_of_itself(end_points: int, size: float) -> None:
    """A corridor of 2.7 m with an end wall of which one piece is seen: its residuals vanish, and may be anything."""
    random = np.random.default_rng(4)
    x = NavState.identity()
    walls = np.column_stack([random.uniform(-15, 15, 800), random.choice([-1.35, 1.35], 800), random.uniform(-1.2, 1.2, 800)])
    floor = np.column_stack([random.uniform(-15, 15, 400), random.uniform(-1.35, 1.35, 400), np.full(400, -1.2)])
    end = np.column_stack([np.full(end_points, 15.5), random.uniform(0.05, 0.95, (end_points, 2))])
    y = np.vstack([walls, floor, end])
    normals = np.repeat(np.eye(3)[[1, 2, 0]], [800, 400, end_points], axis=0)
    piece = np.unique(np.hstack([np.floor(y), normals]), axis=0, return_inverse=True)[1].ravel()
    z = size / np.sqrt(_WEIGHT) * random.normal(size=piece.max() + 1)[piece]
    p_lidar, planes, h = _scan(x, y, normals, z)
    A = _WEIGHT * h.T @ h
    drawn = np.linalg.solve(A, _WEIGHT * h.T @ z)
    planes[:, 3] += h @ drawn  # at the minimum
    assert plane_scatter(x.pack(), p_lidar, planes, np.zeros(len(y), np.uint8), A) == 1.0
