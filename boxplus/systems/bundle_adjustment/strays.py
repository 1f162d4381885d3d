"""Points that ended in a minimum of their own: their rays meet elsewhere, and the images agree with that as well or better.

With the cameras held, the cost of one point may have several minima, and from a wrong depth a point settles in one that is not
the lowest, converged and with a small standard deviation. Where the rays of its observations meet does not depend on where it
started (Hartley and Sturm, Triangulation, 1997).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus._words import counted
from boxplus.errors import BoxplusError
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.optimization.losses import Loss, loss_at
from boxplus.optimization.problem import Problem
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from boxplus.systems.bundle_adjustment.examination import UNWATCHED, Watch
from boxplus.systems.bundle_adjustment.reconstruction_problem import add_reconstruction
from boxplus.systems.bundle_adjustment.sightings import Sightings, names_text
from boxplus.systems.bundle_adjustment.triangulation import intersect_rays

_APART = 5.0  # standard deviations of a point, were the cameras exact, by which its rays meet elsewhere
_AT_ALL = 1e-3  # of its distance, likewise
_LOWER = 1e-3  # of its cost, by which it has to fall
_STEPS = 20


def stray_points(
    adjusted: Reconstruction,
    used: NDArray[np.bool_],
    ratio: NDArray[np.float64],
    config: BundleAdjustmentConfig,
    loss: Loss | None,
    watch: Watch = UNWATCHED,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Numbers (s,) of the points that have a lower minimum elsewhere, and where it is, (s, 3) p_world.

    Args:
        adjusted: where bundle adjustment ended.
        used: (k,) observations that were adjusted.
        ratio: (n,) standard deviation of each point along its ray over its distance.
    """
    sightings, rows = Sightings.of(adjusted), np.flatnonzero(used)
    n = len(sightings.points)
    rays, found = sightings.bearings(rows)
    camera, of = sightings.camera_of[rows[found]], sightings.point_of[rows[found]]
    centers = sightings.centers[camera]
    directions = np.einsum("nji,nj->ni", sightings.R_camera_world[camera], rays[found])
    met = intersect_rays(centers, directions, of, n)
    distance, reach = np.full(n, np.inf), np.full(n, np.inf)
    off = np.linalg.norm(met - sightings.points, axis=1)
    with np.errstate(invalid="ignore"):  # rays that meet nowhere
        np.minimum.at(distance, of, np.linalg.norm(sightings.points[of] - centers, axis=1))
        np.minimum.at(reach, of, np.linalg.norm(met[of] - centers, axis=1))
        # Depths are known to a share of the distance that grows with it.
        share = ratio * np.minimum(reach / distance, 1.0)
        tried = np.flatnonzero(off > np.maximum(_APART * share, _AT_ALL) * np.minimum(distance, reach))
    tried = tried[~np.isnan(ratio[tried])]
    none = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
    if not len(tried):
        return none
    points = sightings.points.copy()
    points[tried] = met[tried]
    concerned = rows[np.isin(sightings.point_of[rows], tried)]
    # What lies behind a camera, or where a lens does not reach, is no place for a point.
    ahead = np.isfinite(sightings.errors(concerned, points[sightings.point_of[concerned]]))
    tried = np.setdiff1d(tried, sightings.point_of[concerned[~ahead]])
    concerned = concerned[np.isin(sightings.point_of[concerned], tried)]
    if not len(tried):
        return none
    moved = _settled(replace(adjusted, points=points), concerned, len(used), tried, config, loss, watch)
    if moved is None:
        return none

    def costs(p_world: NDArray[np.float64]) -> NDArray[np.float64]:
        error = sightings.errors(concerned, p_world[sightings.point_of[concerned]]) / config.sigma_px
        return np.asarray(np.bincount(sightings.point_of[concerned], _costs(loss, error**2), n)[tried], dtype=np.float64)

    before, after = costs(sightings.points), costs(moved)
    better = after < (1.0 - _LOWER) * before
    return tried[better].astype(np.int64), moved[tried[better]]


def stray_notes(strayed: list[NDArray[np.int64]], ids: NDArray[np.int64] | None, *, are_late: bool) -> list[str]:
    """A sentence on those that were found, round by round.

    Args:
        are_late: whether no steps were left to adjust all again after the last round.
    """
    if not strayed:
        return []
    numbers = np.unique(np.concatenate(strayed))
    one = len(numbers) == 1
    put = "it was put where its" if one else "they were put where their"
    lay = "lay" if are_late else f"had converged to {'a minimum of its' if one else 'minima of their'} own,"
    then = "but no steps were left to adjust all again (--max-iterations)" if are_late else "and all was adjusted again"
    return [f"{counted(len(numbers), 'point')} {lay} at a wrong depth; {put} rays meet, {then}: {names_text(numbers, ids)}"]


def _settled(
    start: Reconstruction,
    concerned: NDArray[np.int64],
    count: int,
    tried: NDArray[np.int64],
    config: BundleAdjustmentConfig,
    loss: Loss | None,
    watch: Watch,
) -> NDArray[np.float64] | None:
    """(n, 3) all points, with those that are tried where their cost is least between cameras that are held."""
    problem, used = Problem(), np.zeros(count, dtype=np.bool_)
    used[concerned] = True
    held = config.model_copy(update={"intrinsics": "held", "principal_point": "held"})
    cameras, points = add_reconstruction(problem, start, used, held, loss)
    problem.fix(cameras)
    problem.fix(points[np.setdiff1d(np.arange(len(points)), tried)])
    options = config.solver.model_copy(update={"max_iterations": _STEPS, "time_limit_s": None})
    try:
        solution = problem.solve(options, callback=watch.of("points at a wrong depth?"))
    except BoxplusError:
        return None
    return None if watch.is_stopped else np.asarray(solution[points])


def _costs(loss: Loss | None, squared: NDArray[np.float64]) -> NDArray[np.float64]:
    """ρ(s) of every squared error; infinite where there is none."""
    if loss is None:
        rho = squared
    elif loss.function is not None:
        rho = np.array([loss.scale**2 * loss.function(s / loss.scale**2)[0] for s in squared])
    else:
        rho = np.array([loss_at(loss.code, loss.scale, s)[0] for s in squared])
    return np.where(np.isfinite(squared), rho, np.inf)
