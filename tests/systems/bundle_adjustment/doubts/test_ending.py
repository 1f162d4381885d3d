"""A limit ends an adjustment: points that creep towards infinity speak against nothing, cameras on their way do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.manifolds import quaternion
from boxplus.optimization.solver_options import SolverOptions
from boxplus.systems.bundle_adjustment.bundle_adjustment import BundleAdjustmentResult, adjust_bundle
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from tests.small_problems import in_camera, scene
from tests.systems.bundle_adjustment.scenes import perturbed

FAR = 30


def with_far_points(seed: int, steps: int, start: float = 1e-3) -> BundleAdjustmentResult:
    """120 points near eight cameras and 30 that are 100 km away, which the start has at so many times that, 100 m."""
    rng = np.random.default_rng([seed, 7])
    T, p, camera_of, point_of = scene(seed, 8, 150)
    look = quaternion.to_matrix(T[:, :4])[:, 2].mean(axis=0)
    p[:FAR] = 1e5 * (look + 0.15 * rng.normal(size=(FAR, 3)))
    P = in_camera(T[camera_of], p[point_of])
    seen = (P[:, 2] > 0.5) & (np.abs(P[:, :2] / P[:, 2:]) < 1.2).all(axis=1)
    given = perturbed(rng, T, p, camera_of[seen], point_of[seen], "gbp", 0.005, 0.05)
    points = given.points.copy()
    points[:FAR] *= start
    return adjust_bundle(replace(given, points=points), BundleAdjustmentConfig(solver=SolverOptions(max_iterations=steps)))


def cameras_off(result: BundleAdjustmentResult, best: BundleAdjustmentResult) -> float:
    """How far the farthest camera is from `best`, in standard deviations of how the cameras lie to each other."""
    problem = result.solution._problem
    problem.start(result.solution.values)
    J = np.zeros((sum(group.r.size for group in problem.groups), problem.layout.dof))
    begin = 0
    for group in problem.groups:
        rows = begin + np.arange(group.r.size).reshape(group.r.shape)
        for connection, own in zip(group.connections, group.jacobians, strict=True):
            start = problem.layout.starts(connection).astype(np.int64)
            if own.shape[2]:
                J[rows[:, :, None], start[:, None, None] + np.arange(own.shape[2])] += own
        begin += group.r.size
    scale = 1.0 / np.linalg.norm(J, axis=0)
    weight, axes = np.linalg.eigh((J * scale).T @ (J * scale))
    G = (scale[:, None] * axes)[:, :7]  # the similarities
    covariance = (scale[:, None] * axes)[:, 7:] / weight[7:] @ (scale[:, None] * axes)[:, 7:].T

    cameras = next(block for block in problem.layout.blocks if block.name == "cameras").number
    tangents, first = problem.layout.tangents[cameras], int(problem.layout.start[problem.layout.number[cameras][0]])
    T = best.solution.values[cameras].copy()
    T[:, :4], T[:, 4:] = aligned(T, best.reconstruction.points[FAR:], result.reconstruction.points[FAR:])
    count = len(T)
    place = first + np.arange(6 * count).reshape(count, 6)
    W = np.zeros((6 * count, 6 * count))
    for own in place:
        W[np.ix_(own - first, own - first)] = J[:, own].T @ J[:, own]
    G = G[place.ravel()]
    S = np.eye(6 * count) - G @ np.linalg.solve(G.T @ W @ G, G.T @ W)
    u = (S @ tangents.boxminus(T, result.solution.values[cameras]).ravel()).reshape(count, 6)
    C = S @ covariance[np.ix_(place.ravel(), place.ravel())] @ S.T
    blocks = [C[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(count)]
    variance = 2.0 * best.solution.cost / (len(J) - problem.layout.dof)
    return float(max(np.sqrt(one @ np.linalg.solve(own, one) / variance) for one, own in zip(u, blocks, strict=True)))


def aligned(T: np.ndarray, points: np.ndarray, to: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and translations of T_camera_world after the similarity that takes `points` to others."""
    a, b = points - points.mean(axis=0), to - to.mean(axis=0)
    U, _, V = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V
    size = float(np.trace(R.T @ b.T @ a) / (a**2).sum())
    shift = to.mean(axis=0) - size * R @ points.mean(axis=0)
    turned = quaternion.to_matrix(np.ascontiguousarray(T[:, :4])) @ R.T
    return quaternion.from_matrix(turned), size * T[:, 4:] - turned @ shift


SEEDS = [pytest.param(seed, marks=[pytest.mark.slow] if seed >= 2 else []) for seed in range(24)]


@pytest.mark.parametrize("seed", SEEDS)
def test_cameras_are_doubted_where_they_are_off_among_each_other(seed: int) -> None:
    """Points that creep away take size and place of the whole scene with them, which is nobody's way."""
    best = with_far_points(seed, steps=300)
    for steps in (4, 8, 12, 20):
        result = with_far_points(seed, steps)
        off = cameras_off(result, best)
        assert result.doubt is not None or off < 1.1, (steps, off)
        assert result.doubt is None or off > 0.7, (steps, off, result.doubt)
    assert off < 0.7


@pytest.mark.parametrize("seed", [0, 4, 10, 13])
def test_points_that_creep_away_are_counted_and_condemn_nothing(seed: int) -> None:
    result = with_far_points(seed, steps=12)
    remainder = result.solution.remainder()
    assert result.solution.limit == "steps" and remainder is not None and remainder.total > 2.0
    assert result.doubt is None
    told = [note for note in result.notes if "whose depth is not determined" in note]
    assert len(told) == 1 and "still moving when the adjustment ended (iteration limit of 12 reached)" in told[0]


def test_cameras_that_are_on_their_way_condemn_it() -> None:
    result = with_far_points(0, steps=4)
    assert "no minimum was reached (iteration limit of 4 reached)" in (result.doubt or "") and "cameras" in (result.doubt or "")


@pytest.mark.parametrize(
    ("off", "told"),
    [
        (0.004, "1 point of 400 ended more than a standard deviation from where the images agree best (iteration limit of 1"),
        (0.02, "1 point lay at a wrong depth; it was put where its rays meet, but no steps were left to adjust all again"),
    ],
)
def test_few_points_that_are_late_are_named(off: float, told: str) -> None:
    """One of 400 points starts off, and arrives last: cameras and all others are where they belong."""
    rng = np.random.default_rng(5)
    T, p, camera_of, point_of = scene(5, 8, 400)
    start = perturbed(rng, T, p, camera_of, point_of, "gbp", 0.0, 0.0)
    best = adjust_bundle(start).reconstruction
    points = best.points.copy()
    points[17] += off * (points[17] - best.T_camera_world[0, 4:])
    held = BundleAdjustmentConfig(solver=SolverOptions(max_iterations=1, initial_damping=30.0))
    result = adjust_bundle(replace(best, points=points), held)
    assert result.solution.limit == "steps" and result.doubt is None
    assert [note for note in result.notes if told in note and note.endswith(": 17")]


def beyond_infinity(seed: int, steps: int) -> BundleAdjustmentResult:
    """The same scene with far points that start ten times too far, where nothing tells them to come back."""
    return with_far_points(seed, steps, start=10.0)


@pytest.mark.parametrize("seed", [101, 105, 109])
def test_cameras_that_points_beyond_infinity_bend_are_doubted(seed: int) -> None:
    """Steps leave such points where they are; put where their rays meet, they say how far the cameras are."""
    best = beyond_infinity(seed, steps=300)
    result = beyond_infinity(seed, steps=6)
    off = cameras_off(result, best)
    assert (result.doubt is not None) == (off > 1.0)
    assert "iteration limit of 6 reached" in result.solution.reason
    assert any("no steps were left to adjust all again" in note for note in result.notes)
