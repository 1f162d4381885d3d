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


def with_far_points(seed: int, steps: int) -> BundleAdjustmentResult:
    """120 points near eight cameras and 30 that are 100 km away, where the start has them at 100 m."""
    rng = np.random.default_rng([seed, 7])
    T, p, camera_of, point_of = scene(seed, 8, 150)
    look = quaternion.to_matrix(T[:, :4])[:, 2].mean(axis=0)
    p[:FAR] = 1e5 * (look + 0.15 * rng.normal(size=(FAR, 3)))
    P = in_camera(T[camera_of], p[point_of])
    seen = (P[:, 2] > 0.5) & (np.abs(P[:, :2] / P[:, 2:]) < 1.2).all(axis=1)
    start = perturbed(rng, T, p, camera_of[seen], point_of[seen], "gbp", 0.005, 0.05)
    points = start.points.copy()
    points[:FAR] *= 1e-3
    return adjust_bundle(replace(start, points=points), BundleAdjustmentConfig(solver=SolverOptions(max_iterations=steps)))


@pytest.mark.parametrize("seed", [0, 4, 10])
def test_points_that_creep_away_are_counted_and_condemn_nothing(seed: int) -> None:
    result = with_far_points(seed, steps=8)
    remainder = result.solution.remainder()
    assert result.solution.limit == "steps" and remainder is not None and remainder.total > 2.0
    assert result.doubt is None
    told = [note for note in result.notes if "whose depth is not determined" in note]
    assert len(told) == 1 and "still moving when the adjustment ended (iteration limit of 8 reached)" in told[0]
    assert set(np.flatnonzero(remainder.variables[result.points.number] > 1.0)) <= set(range(FAR))


def test_cameras_that_are_on_their_way_condemn_it() -> None:
    result = with_far_points(0, steps=4)
    assert "no minimum was reached (iteration limit of 4 reached)" in (result.doubt or "") and "cameras[" in (result.doubt or "")


def test_few_points_that_are_late_are_named() -> None:
    """One of 400 points starts far off and arrives last: cameras and all others are where they belong."""
    rng = np.random.default_rng(5)
    T, p, camera_of, point_of = scene(5, 8, 400)
    start = perturbed(rng, T, p, camera_of, point_of, "gbp", 0.0, 0.0)
    best = adjust_bundle(start).reconstruction
    points = best.points.copy()
    points[17] += 0.02 * (points[17] - best.T_camera_world[0, 4:])
    held = BundleAdjustmentConfig(solver=SolverOptions(max_iterations=1, initial_damping=30.0))
    result = adjust_bundle(replace(best, points=points), held)
    assert result.solution.limit == "steps" and result.doubt is None
    assert any("1 point of 400 ended more than a standard deviation from where the images agree best" in n for n in result.notes)
