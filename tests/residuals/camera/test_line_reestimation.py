"""Cameras and lines of the Oxford line sets, estimated anew from segments alone and perturbed starts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.formats.reconstructions.vgg_lines import VggLines, read_vgg_lines
from boxplus.manifolds import lines
from boxplus.manifolds.lines import Line3D
from boxplus.manifolds.se3 import SE3Left
from boxplus.optimization.problem import Problem
from boxplus.residuals.camera.line_reprojection import LineReprojection


def level(data: VggLines, poses: NDArray[np.float64], world: NDArray[np.float64]) -> tuple[float, float]:
    """Median over the observations of the rms of their two distances [px], and the cost ½ Σ r²."""
    r = LineReprojection(data.K[data.view_of], data.segments).evaluate(poses[data.view_of], world[data.line_of])
    return float(np.median(np.sqrt((r**2).mean(axis=1)))), 0.5 * float((r**2).sum())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("name", "stated", "optimum"),
    [("Corridor", 0.16, 47.4096), ("Model-House", 0.24, 40.9552), ("Merton-College-I", 0.28, 61.5029)],
)
def test_reestimation_returns_to_the_stated_level(shared_data: Path, name: str, stated: float, optimum: float, seed: int) -> None:
    folder = shared_data / "lines" / "vgg" / name
    if not folder.is_dir():
        pytest.skip(f"{name} is not on this machine")
    data = read_vgg_lines(folder)
    given = lines.from_points(data.end_points_world[:, :3], data.end_points_world[:, 3:])
    depth = float(np.median(np.linalg.norm(data.end_points_world[:, :3], axis=1)))
    rng = np.random.default_rng(seed)
    sigma = 0.005 * np.array([1.0, 1.0, 1.0, depth, depth, depth])
    poses = SE3Left.boxplus(data.T_camera_world, sigma * rng.normal(size=(len(data.names), 6)))
    world = Line3D.boxplus(given, 0.01 * rng.normal(size=(len(given), 4)))
    assert level(data, poses, world)[0] > 20.0 * stated

    problem = Problem()
    cameras = problem.add_variables(SE3Left, poses, name="cameras")
    world_lines = problem.add_variables(Line3D, world, name="lines")
    problem.add_residuals(LineReprojection(data.K[data.view_of], data.segments), cameras[data.view_of], world_lines[data.line_of])
    problem.fix(cameras[0])  # the scale stays free: damping holds it
    solution = problem.solve(max_iterations=1000)
    assert solution.status == "converged"
    median, cost = level(data, solution[cameras], solution[world_lines])
    assert median <= stated
    assert cost == pytest.approx(optimum, rel=1e-4)
    assert cost < level(data, data.T_camera_world, given)[1]
