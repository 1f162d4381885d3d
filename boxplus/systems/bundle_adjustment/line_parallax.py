"""Whether the cameras of a line set move apart at all, or images that only turn explain everything as well (`parallax.py`).

Between cameras in one place the planes of a line's segments are one plane but for noise, and lines and cameras fit that noise. So
everything is explained once more from one place; what distances explain beyond that is compared with the noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.reconstructions.vgg_lines import VggLines
from boxplus.manifolds import quaternion
from boxplus.optimization.losses import Loss
from boxplus.optimization.problem import Problem
from boxplus.systems.bundle_adjustment.config import LineAdjustmentConfig
from boxplus.systems.bundle_adjustment.examination import Watch
from boxplus.systems.bundle_adjustment.line_problem import add_line_set
from boxplus.systems.bundle_adjustment.parallax import mean_directions, ratio_from_one_place

Floats = NDArray[np.float64]

_TINY = 1e-12  # of a sum of opposite directions, which has none


def line_parallax_ratio(
    adjusted: VggLines, seen: NDArray[np.intp], config: LineAdjustmentConfig, loss: Loss | None, cost: float, watch: Watch
) -> float:
    """Cost that distances explain, for each of their numbers, over that of a number that explains noise; see `parallax_ratio`.

    Args:
        adjusted: where the adjustment ended, at `cost`.
        seen: (k,) the segments that were adjusted.
    """
    problem = Problem()
    cameras, _, points = add_line_set(problem, _in_one_place(adjusted, seen), seen, config, loss)
    shown, view_count = len(np.unique(adjusted.line_of[seen])), len(np.unique(adjusted.view_of[seen]))
    point_count = 0 if points is None else len(np.unique(adjusted.point_of))
    numbers = 2 * shown + point_count + 3 * (view_count - 1) - 1  # distance and slant of a line
    measured = sum(2 * group.residual.count for group in problem.groups)
    left = measured - numbers - 2 * shown - 2 * point_count - 3 * (view_count - 1)
    return ratio_from_one_place(problem, cameras, view_count, numbers, left, cost, config.solver, config.sigma_px, watch)


def _in_one_place(data: VggLines, seen: NDArray[np.intp]) -> VggLines:
    """All cameras at the origin, and every line and point at distance 1 in the mean plane and direction it is seen in.

    Args:
        seen: (k,) the segments to go by.
    """
    R = quaternion.to_matrix(np.ascontiguousarray(data.T_camera_world[:, :4]))
    ends = data.end_points_world.copy()
    views, line_of = data.view_of[seen], data.line_of[seen]
    first, last = (_rays(data.K, R, views, data.segments[seen, k : k + 2]) for k in (0, 2))
    normals = np.cross(first, last)
    for own in _groups(line_of):
        normal = np.linalg.svd(normals[own])[2][0]
        middle = (first[own] + last[own]).sum(axis=0)
        middle -= normal * (normal @ middle)
        middle /= max(float(np.linalg.norm(middle)), _TINY)
        along = 0.5 * np.cross(normal, middle)
        ends[line_of[own[0]]] = np.concatenate([middle - along, middle + along])
    points = mean_directions(_rays(data.K, R, data.point_view_of, data.pixels), data.point_of, data.points_world)
    T = data.T_camera_world.copy()
    T[:, 4:] = 0.0
    return replace(data, T_camera_world=T, end_points_world=ends, points_world=points)


def _groups(number: NDArray[np.integer]) -> list[NDArray[np.intp]]:
    """Where each of the numbers (n,) occurs, in their order."""
    order = np.argsort(number, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(number[order])) + 1) if len(number) else []


def _rays(K: Floats, R: Floats, views: NDArray[np.integer], pixels: Floats) -> Floats:
    """(N, 3) unit vectors in the world."""
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
    rays = np.einsum("nji,nj->ni", R[views], np.einsum("nij,nj->ni", np.linalg.inv(K)[views], homogeneous))
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
