"""Whether the cameras move apart at all, or images that only turn explain everything as well.

Where cameras stand in one place, depths and positions fit nothing but noise, and fit it so well that the curvature at the minimum
looks as if they were measured. So the images are explained once more with all cameras in one place, everything else free as it
was. What depths and positions explain beyond that is compared with the noise, as in an F-test of nested models.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import BoxplusError
from boxplus.formats.reconstructions.bal import BalProblem
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.optimization.losses import Loss
from boxplus.optimization.problem import Problem
from boxplus.optimization.solver_options import SolverOptions
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals.prior import Prior
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from boxplus.systems.bundle_adjustment.examination import Watch
from boxplus.systems.bundle_adjustment.reconstruction_problem import add_reconstruction
from boxplus.systems.bundle_adjustment.sightings import Sightings

_LEAST_NOISE = 0.01  # [px] no pixel is measured better
_IN_PLACE = 1e8  # information that holds the cameras, where points are at distance 1
_FROM_ONE_PLACE = {"max_iterations": 30, "cost_tolerance": 1e-4}


def parallax_ratio(
    adjusted: Reconstruction,
    used: NDArray[np.bool_],
    config: BundleAdjustmentConfig,
    loss: Loss | None,
    cost: float,
    watch: Watch,
) -> float:
    """Cost that depths and positions explain, for each of their numbers, over that of a number that explains noise.

    1 to 2 where the cameras only turn (the best of many depths and positions was chosen), and large where they move apart;
    infinite where there are too few observations to tell, and where somebody stopped it.

    Args:
        adjusted: where bundle adjustment ended, at `cost`.
        used: (k,) observations that were adjusted.
    """
    problem = Problem()
    cameras, points = add_reconstruction(problem, _in_one_place(adjusted, used), used, config, loss)
    seen = np.zeros(len(points), dtype=np.bool_)
    for group in problem.groups:
        seen[group.connections[1].rows] = True
    problem.fix(points[~seen])
    m, n = len(cameras), int(np.count_nonzero(seen))
    left = sum(2 * group.residual.count for group in problem.groups) + 7 - 3 * n
    left -= sum(block.values.shape[0] * block.manifold.dof for block in problem.blocks if block is not points)
    return ratio_from_one_place(problem, cameras, m, n + 3 * (m - 1) - 1, left, cost, config.solver, config.sigma_px, watch)


def ratio_from_one_place(
    problem: Problem,
    cameras: Variables,
    views: int,
    numbers: int,
    left: int,
    cost: float,
    options: SolverOptions,
    sigma_px: float,
    watch: Watch,
) -> float:
    """The same of a problem whose cameras stand in one place, with what they see at distance 1, and are held there.

    Args:
        cameras: poses, translation last. views: how many of them see anything.
        numbers: unknowns of a problem whose cameras move apart that this one does not have.
        left: measurements of that problem less its unknowns. cost: of its minimum.
        sigma_px: what `cost` is scaled by [px].
    """
    if views < 2:
        return 0.0
    if left <= 0:
        return float("inf")
    information = np.zeros((cameras.manifold.dof, cameras.manifold.dof))
    information[3:6, 3:6] = _IN_PLACE * np.eye(3)
    problem.add_residuals(Prior(cameras.manifold, cameras.values, information=information), cameras[:])
    try:
        without = problem.solve(
            options.model_copy(update={**_FROM_ONE_PLACE, "time_limit_s": None}), callback=watch.of("do the cameras move apart?")
        )
    except BoxplusError:  # nothing is shown by what cannot be adjusted
        return float("inf")
    if watch.is_stopped or any(without.invalid.values()):
        return float("inf")  # no directions before all cameras explain the images
    noise = max(cost / left, 0.5 * (_LEAST_NOISE / sigma_px) ** 2)
    return float((without.cost - cost) / numbers / noise)


def mean_directions(rays: NDArray[np.float64], of: NDArray[np.integer], otherwise: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) unit vectors: the means of the rays (r, 3) `of` each, and `otherwise` (n, 3) where there is none."""
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    total = np.stack([np.bincount(of, x, len(otherwise)) for x in rays.T], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0.0, total / np.where(length > 0.0, length, 1.0), otherwise)


def _in_one_place(adjusted: Reconstruction, used: NDArray[np.bool_]) -> Reconstruction:
    """All cameras at the origin, and every point at distance 1 in the mean direction it is seen in."""
    sightings = Sightings.of(adjusted)
    rows = np.flatnonzero(used)
    rays, found = sightings.bearings(rows)
    own = sightings.R_camera_world[sightings.camera_of[rows[found]]]
    in_world = np.einsum("nji,nj->ni", own, rays[found])
    directions = mean_directions(in_world, sightings.point_of[rows[found]], sightings.points)
    if isinstance(adjusted, BalProblem):
        cameras = adjusted.cameras.copy()
        cameras[:, 3:6] = 0.0
        return replace(adjusted, cameras=cameras, points=directions)
    T = adjusted.T_camera_world.copy()
    T[:, 4:] = 0.0
    return replace(adjusted, T_camera_world=T, points=directions)
