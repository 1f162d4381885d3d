"""Bundle adjustment on straight lines, and on points with them (docs/residuals/line_reprojection.md)."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_settings
from boxplus.errors import InputError
from boxplus.formats.reconstructions.vgg_lines import VggLines
from boxplus.manifolds import lines as line_manifold
from boxplus.manifolds import quaternion
from boxplus.optimization.losses import Loss
from boxplus.optimization.minimizers.minimize import Callback
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals.camera.line_reprojection import LineReprojection
from boxplus.systems.bundle_adjustment.config import LineAdjustmentConfig
from boxplus.systems.bundle_adjustment.depth import NOT_APART, TURNING
from boxplus.systems.bundle_adjustment.examination import Watch
from boxplus.systems.bundle_adjustment.line_parallax import line_parallax_ratio
from boxplus.systems.bundle_adjustment.line_problem import add_line_set
from boxplus.systems.bundle_adjustment.line_triangulation import LineTriangulation, have_direction, triangulate_lines

Floats = NDArray[np.float64]

_BAD_SHARE = 0.005  # of the observations that may lie behind their cameras before a result is not to be trusted
_MOST_SIGMAS = 5.0  # of the errors' root mean square, in standard deviations


@dataclass(frozen=True, slots=True)
class LineAdjustmentResult:
    """Adjusted cameras, lines and points.

    Attributes:
        data: like the input, with adjusted cameras, end points of the lines (moved onto the adjusted lines) and points; lines
            that no segment of a pixel and more is of stay as they were.
        errors_start, errors: (N,) root mean square of the distances of a segment's two ends from its projected line [px], NaN
            where the line is not determined or cannot be projected.
        point_errors_start, point_errors: (M,) distance of a pixel from its projected point [px], NaN where that is impossible;
            empty where points are not used.
        triangulation: of the lines, by the cameras of the start: which of them the segments determine, and why not.
        notes: what a user should know, one sentence each.
        doubt: why the result is not to be trusted; None where nothing speaks against it.
        solution: with history, covariance, and why it stopped.
        cameras, lines, points: the variables of `solution`; `points` is None where they are not used.
        time_s: seconds, set-up included.

    Example:
        >>> from boxplus.systems.bundle_adjustment import adjust_lines
        >>> result = adjust_lines(bp.formats.read_vgg_lines("Corridor"))
        >>> result.solution.status, result.errors.shape == result.errors_start.shape
        ('converged', True)
    """

    data: VggLines
    errors_start: Floats
    errors: Floats
    point_errors_start: Floats
    point_errors: Floats
    triangulation: LineTriangulation
    notes: tuple[str, ...]
    doubt: str | None
    solution: Solution
    cameras: Variables
    lines: Variables
    points: Variables | None
    time_s: float


def adjust_lines(
    data: VggLines,
    config: LineAdjustmentConfig | None = None,
    *,
    loss: Loss | None = None,
    callback: Callback | None = None,
) -> LineAdjustmentResult:
    """Minimise ½ Σ ρ(‖e/σ‖²) over cameras, lines and points: distances of segments' ends from projected lines, and of pixels.

    The first camera is held: where the world is, no image tells. Its size is not told either; damping keeps it. Lines of
    which the images determine nothing but a plane (seen once, or from cameras that move along them) are named; damping keeps
    them near their start in what is not determined. Those of which all segments are shorter than a pixel are left out. With
    `triangulate` lines have no start, and those are left out that are not determined, lie behind cameras or contradict their
    segments.

    Raises:
        InputError: no line that the segments determine; a method without damping.

    Example:
        >>> from boxplus.systems.bundle_adjustment import adjust_lines
        >>> result = adjust_lines(bp.formats.read_vgg_lines("Corridor"))
        >>> bool(np.nanmedian(result.errors) < np.nanmedian(result.errors_start))
        True
    """
    config = as_settings(LineAdjustmentConfig, config)
    if config.solver.method == "gauss_newton":
        raise InputError(
            "a method that damps its steps", "gauss_newton, though the size of the world is not determined", "use another"
        )
    begin = time.perf_counter()
    found = triangulate_lines(
        data.K, data.T_camera_world, data.segments, data.view_of, data.line_of, len(data.end_points_world), config.sigma_px
    )
    long = have_direction(data.segments)
    used = np.zeros(len(found.states), dtype=np.bool_)
    used[data.line_of[long]] = True
    if config.triangulate:
        used &= found.found
    seen = np.flatnonzero(used[data.line_of] & long)
    if not len(seen):
        why = " ".join(found.notes()) or "no segment"
        raise InputError("segments that determine a line", why, "give views from places beside the lines")
    problem = Problem()
    ends = _start_ends(data, found, used, config.triangulate)
    cameras, lines, points = add_line_set(problem, replace(data, end_points_world=ends), seen, config, loss)
    problem.fix(cameras[0])
    start = [block.values for block in problem.blocks]
    solution = problem.solve(config.solver, callback=callback)
    values = list(solution.values)
    adjusted = _adjusted(data, solution[cameras], solution[lines], None if points is None else solution[points], used)
    errors_start, errors = (_line_errors(data, v[cameras.number], v[lines.number], seen) for v in (start, values))
    empty = np.zeros(0)
    point_errors_start, point_errors = (
        empty if points is None else _point_errors(data, v[cameras.number], v[points.number]) for v in (start, values)
    )
    said = [_doubt(adjusted, errors, point_errors, seen, config, loss)]
    watch = Watch(callback)
    if not solution.is_broken_off and not line_parallax_ratio(adjusted, seen, config, loss, solution.cost, watch) > TURNING:
        said.append(NOT_APART)  # no minimum, either, and more steps lead to none
    else:
        said.append(solution.unconverged())
    # From a start that is off, segments of a line may disagree; what the adjustment makes of given lines decides about these.
    notes = found.notes() if config.triangulate else found.notes(("one view", "along the line", "too short"))
    if data.reflected:
        notes.append("the input has the world behind the cameras, as a mirror image; it was reflected through its origin")
    if not long.all():
        notes.append(f"{int((~long).sum())} segments shorter than 1 px have no direction and were left out")
    notes += [*watch.notes, *solution.doubts()]
    return LineAdjustmentResult(
        data=adjusted,
        errors_start=errors_start,
        errors=errors,
        point_errors_start=point_errors_start,
        point_errors=point_errors,
        triangulation=found,
        notes=tuple(notes),
        doubt="; ".join(text for text in said if text) or None,
        solution=solution,
        cameras=cameras,
        lines=lines,
        points=points,
        time_s=time.perf_counter() - begin,
    )


def _start_ends(data: VggLines, found: LineTriangulation, used: NDArray[np.bool_], triangulated: bool) -> Floats:
    """(L, 6): those that were triangulated, or those given."""
    return np.where(used[:, None], found.end_points_world, data.end_points_world) if triangulated else data.end_points_world


def _line_errors(data: VggLines, poses: Floats, lines: Floats, seen: NDArray[np.intp]) -> Floats:
    errors = np.full(len(data.segments), np.nan)
    residual = LineReprojection(data.K[data.view_of[seen]], data.segments[seen])
    r = residual.evaluate(poses[data.view_of[seen]], lines[data.line_of[seen]])
    errors[seen] = np.sqrt((r**2).mean(axis=1))
    return errors


def _point_errors(data: VggLines, poses: Floats, points: Floats) -> Floats:
    R = quaternion.to_matrix(np.ascontiguousarray(poses[data.point_view_of, :4]))
    p = np.einsum("nij,nj->ni", R, points[data.point_of]) + poses[data.point_view_of, 4:]
    image = np.einsum("nij,nj->ni", data.K[data.point_view_of], p)
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = np.linalg.norm(image[:, :2] / image[:, 2:] - data.pixels, axis=1)
    errors[p[:, 2] <= 0.0] = np.nan
    return np.asarray(errors)


def _adjusted(data: VggLines, poses: Floats, lines: Floats, points: Floats | None, used: NDArray[np.bool_]) -> VggLines:
    """The data with the solution's values; the ends of a line are the points of the adjusted one nearest to where they were."""
    ends = data.end_points_world.copy()
    L = line_manifold.to_plucker(lines)
    d2 = (L[:, 3:] ** 2).sum(axis=1, keepdims=True)
    foot = np.cross(L[:, 3:], L[:, :3]) / d2
    for k in (0, 3):
        along = ((ends[:, k : k + 3] - foot) * L[:, 3:]).sum(axis=1, keepdims=True) / d2
        ends[:, k : k + 3] = np.where(used[:, None], foot + along * L[:, 3:], ends[:, k : k + 3])
    p_world = data.points_world if points is None else points
    return replace(data, T_camera_world=poses, end_points_world=ends, points_world=p_world)


def _doubt(
    adjusted: VggLines,
    errors: Floats,
    point_errors: Floats,
    seen: NDArray[np.intp],
    config: LineAdjustmentConfig,
    loss: Loss | None,
) -> str | None:
    views, own = adjusted.view_of[seen], adjusted.line_of[seen]
    R = quaternion.to_matrix(np.ascontiguousarray(adjusted.T_camera_world[:, :4]))
    ends = adjusted.end_points_world[own].reshape(-1, 2, 3)
    depth = np.einsum("ni,nki->nk", R[views, 2], ends) + adjusted.T_camera_world[views, 6][:, None]
    behind = int((depth.max(axis=1) <= 0.0).sum())
    if behind > _BAD_SHARE * len(seen):
        return f"{behind} of {len(seen)} segments show lines that lie behind their cameras: the start is too far off"
    of_points = np.empty(0) if loss is not None else point_errors
    reasons = []
    for rms, sigma, told in (
        (_rms(errors[seen], np.inf), config.sigma_px, "the ends of the segments are {:.2f} px from their lines"),
        (_rms(of_points, 0.0), config.sigma_point_px, "the pixels are {:.2f} px from their points"),
    ):
        if rms > _MOST_SIGMAS * sigma:
            reasons.append(
                f"{told.format(rms)} (root mean square), with a standard deviation of {sigma:g} px: they are matched wrongly, or "
                "the noise is larger (--sigma)"
            )
    return "; ".join(reasons) or None


def _rms(errors: Floats, of_none: float) -> float:
    known = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else of_none
