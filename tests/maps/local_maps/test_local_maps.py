"""Local maps against brute force, and the covariance between them against simulated odometry."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se3, so3
from boxplus.maps.local_maps.builder import LocalMapBuilder
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.maps.local_maps.local_map import LocalMap, relative_covariance

MS = 1_000_000


def straight(steps: int, step_m: float = 0.5, config: LocalMapConfig | None = None) -> list[LocalMap]:
    builder = LocalMapBuilder(config or LocalMapConfig(length=3.0))
    random = np.random.default_rng(0)
    maps = []
    for k in range(steps):
        points = random.uniform(-10.0, 10.0, (50, 3)).astype(np.float32)
        maps += builder.push(100 * MS * k, [1.0, 0.0, 0.0, 0.0, step_m * k, 0.0, 0.0], np.zeros((6, 6)), points)
    return maps + builder.flush()


def test_maps_are_cut_by_way_and_hold_every_scan_once() -> None:
    maps = straight(20)
    assert [m.number for m in maps] == list(range(len(maps)))
    assert all(a.end_ns == b.begin_ns for a, b in itertools.pairwise(maps))  # they meet at a scan
    assert maps[0].begin_ns == 0 and maps[-1].end_ns == 1900 * MS
    assert all(m.begin_ns <= m.time_ns <= m.end_ns for m in maps)
    np.testing.assert_allclose([m.path_m for m in maps[:3]], [1.5, 4.5, 7.5])


def test_standing_still_makes_no_maps() -> None:
    assert len(straight(300, step_m=1e-4)) == 1


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**31), st.floats(0.1, 1.0))
def test_points_are_those_of_the_scans_one_a_voxel(seed: int, voxel: float) -> None:
    random = np.random.default_rng(seed)
    builder = LocalMapBuilder(LocalMapConfig(length=1000.0, voxel=voxel, max_range=8.0))
    seen = []
    for k in range(4):
        pose = np.concatenate([quaternion.from_matrix(so3.exp(random.normal(0.0, 0.2, 3))), random.normal(0.0, 2.0, 3)])
        points = random.uniform(-6.0, 6.0, (60, 3)).astype(np.float32)
        assert not builder.push(k, pose, np.zeros((6, 6)), points)
        seen.append(se3.act(pose, points[np.linalg.norm(points, axis=1) < 8.0].astype(np.float64)))
    (made,) = builder.flush()
    world = se3.act(made.T_odo_map, made.points.astype(np.float64))
    every = np.concatenate(seen)
    distance = np.linalg.norm(world[:, None] - every[None], axis=2)
    assert (distance.min(axis=1) < 1e-4).all()  # no point that no scan saw
    cells = np.floor(made.points.astype(np.float64) / voxel)
    assert len(np.unique(cells, axis=0)) == len(cells)
    # Nothing seen is farther from the map than the diagonals of the two voxels, of the scan's and of the map's thinning.
    assert distance.min(axis=0).max() < 2.0 * np.sqrt(3.0) * voxel + 1e-4


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**31))
def test_the_frame_is_level(seed: int) -> None:
    random = np.random.default_rng(seed)
    up = so3.exp(random.normal(0.0, 0.1, 3)) @ [0.0, 0.0, 1.0]
    builder = LocalMapBuilder()
    pose = np.concatenate([quaternion.from_matrix(so3.exp(random.normal(0.0, 1.0, 3))), random.normal(0.0, 2.0, 3)])
    builder.push(0, pose, np.zeros((6, 6)), np.zeros((1, 3), np.float32), 3.0 * up)
    (made,) = builder.flush()
    R = quaternion.to_matrix(made.T_odo_map[:4])
    np.testing.assert_allclose(R[:, 2], up, atol=1e-12)
    np.testing.assert_allclose(made.T_odo_map[4:], pose[4:])


def test_relative_covariance_is_that_of_the_steps_between() -> None:
    """Poses along a chain of noisy steps: their covariances against the first pose give back those of the steps."""
    random = np.random.default_rng(3)
    step = se3.exp(np.array([0.1, -0.05, 0.3, 1.0, 0.2, 0.0]))
    L = random.normal(0.0, 0.01, (6, 6))
    Q, Ad = L @ L.T, se3.adjoint(se3.inverse(step))
    before = Q.copy()
    for _ in range(4):
        before = Ad @ before @ Ad.T + Q
    np.testing.assert_allclose(relative_covariance(before, Ad @ before @ Ad.T + Q, step), Q, atol=1e-12)


def test_relative_covariance_of_sampled_odometry() -> None:
    """Monte Carlo: the spread of T_before_after over many odometries is what the formula says."""
    random = np.random.default_rng(4)
    step, sigma = se3.exp(np.array([0.0, 0.1, 0.4, 2.0, 0.0, 0.1])), np.repeat([2e-3, 0.01], 3)
    n = 4000
    T = np.tile([1.0, 0, 0, 0, 0, 0, 0], (n, 1))
    poses, true, exact = [T], [np.array([1.0, 0, 0, 0, 0, 0, 0])], np.array([1.0, 0, 0, 0, 0, 0, 0])
    for _ in range(3):
        T, exact = (
            se3.compose(se3.compose(T, np.tile(step, (n, 1))), se3.exp(random.normal(0.0, sigma, (n, 6)))),
            se3.compose(exact, step),
        )
        poses.append(T)
        true.append(exact)
    P = [np.cov(se3.log(se3.compose(se3.inverse(t), p)).T) for t, p in zip(true, poses, strict=True)]
    between = se3.compose(se3.inverse(true[1]), true[3])
    spread = np.cov(se3.log(se3.compose(se3.inverse(between), se3.compose(se3.inverse(poses[1]), poses[3]))).T)
    claimed = relative_covariance(P[1], P[3], between)
    # 4,000 samples give a variance to 2.2 %; the difference of two of twice the size to some 7 %: within four of those.
    np.testing.assert_allclose(np.diag(claimed), np.diag(spread), rtol=0.28)


def test_what_cannot_be_used_is_refused() -> None:
    builder = LocalMapBuilder()
    pose, zero, none = [1.0, 0, 0, 0, 0, 0, 0], np.zeros((6, 6)), np.zeros((0, 3))
    builder.push(5, pose, zero, none)
    with pytest.raises(InputError, match="scans in order of time – got 5 ns after 5 ns"):
        builder.push(5, pose, zero, none)
    with pytest.raises(InputError, match="p_body of shape"):
        builder.push(6, pose, zero, np.zeros((3, 2)))
    with pytest.raises(InputError, match="up_odo as a direction"):
        builder.push(6, pose, zero, none, [0.0, 0.0, 0.0])
    with pytest.raises(InputError, match="covariance of shape"):
        builder.push(6, pose, np.zeros(6), none)
    with pytest.raises(InputError, match="a symmetric covariance"):
        builder.push(6, pose, np.triu(np.ones((6, 6))), none)
