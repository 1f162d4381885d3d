"""Cameras, lines and points as variables, and what was seen of them as residuals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.pinhole import Pinhole
from boxplus.formats.reconstructions.vgg_lines import VggLines
from boxplus.manifolds import lines as line_manifold
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.lines import Line3D
from boxplus.manifolds.se3 import SE3Left
from boxplus.optimization.losses import Loss
from boxplus.optimization.problem import Problem
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals.camera.line_reprojection import LineReprojection
from boxplus.residuals.camera.reprojection import Reprojection
from boxplus.systems.bundle_adjustment.config import LineAdjustmentConfig

Floats = NDArray[np.float64]


def add_line_set(
    problem: Problem, data: VggLines, seen: NDArray[np.intp], config: LineAdjustmentConfig, loss: Loss | None
) -> tuple[Variables, Variables, Variables | None]:
    """Cameras, lines and, where they are used, points, with their residuals; what no residual takes is held where it is."""
    cameras = problem.add_variables(SE3Left, data.T_camera_world, name="cameras")
    own = np.unique(data.line_of[seen])
    world = np.tile(Line3D.identity(), (len(data.end_points_world), 1))
    world[own] = line_manifold.from_points(data.end_points_world[own, :3], data.end_points_world[own, 3:])
    lines = problem.add_variables(Line3D, world, name="lines")
    segments = LineReprojection(data.K[data.view_of[seen]], data.segments[seen], sigma=config.sigma_px)
    problem.add_residuals(segments, cameras[data.view_of[seen]], lines[data.line_of[seen]], loss=loss, name="segments")
    problem.fix(lines[np.setdiff1d(np.arange(len(world)), own)])
    return cameras, lines, _add_points(problem, cameras, data, config, loss) if config.use_points and len(data.pixels) else None


def _add_points(
    problem: Problem, cameras: Variables, data: VggLines, config: LineAdjustmentConfig, loss: Loss | None
) -> Variables:
    points = problem.add_variables(Euclidean(3), data.points_world, name="points")
    for view, K in enumerate(data.K):
        rows = np.flatnonzero(data.point_view_of == view)
        if not len(rows):
            continue
        camera, pixels, information = _without_skew(K, data.pixels[rows], config.sigma_point_px)
        residual = Reprojection(camera, pixels, information=information)
        problem.add_residuals(
            residual,
            cameras[np.full(len(rows), view)],
            points[data.point_of[rows]],
            loss=loss,
            name=f"points of {data.names[view]}",
        )
    seen = np.unique(data.point_of)
    if len(seen) < len(data.points_world):
        problem.fix(points[np.setdiff1d(np.arange(len(data.points_world)), seen)])
    return points


def _without_skew(K: Floats, pixels: Floats, sigma_px: float) -> tuple[Pinhole, Floats, Floats]:
    """A camera with right angles, pixels (n, 2) as it has them, and their information (2, 2); M = [[1, −s/fy], [0, 1]]."""
    M = np.array([[1.0, -K[0, 1] / K[1, 1]], [0.0, 1.0]])
    moved = pixels @ M.T
    moved[:, 0] += K[0, 1] * K[1, 2] / K[1, 1]
    back = np.linalg.inv(M)
    return Pinhole(K[0, 0], K[1, 1], K[0, 2], K[1, 2]), moved, back.T @ back / sigma_px**2
