"""Bundle adjustment: cameras and points that explain best where the points were seen (docs/residuals/reprojection.md)."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_settings, require
from boxplus._words import counted, either
from boxplus.errors import InputError
from boxplus.formats.reconstructions.bal import BalProblem
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.optimization.losses import Loss
from boxplus.optimization.minimizers.minimize import Callback
from boxplus.optimization.outliers.convex_start import solve_from_convex
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Iteration, Solution
from boxplus.optimization.terms.variables import Variables
from boxplus.systems.bundle_adjustment.cheirality import Cheirality, count_behind, make_sound
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from boxplus.systems.bundle_adjustment.depth import NOT_APART, DepthUncertainty, depth_uncertainty
from boxplus.systems.bundle_adjustment.doubts.bent import bent_doubt
from boxplus.systems.bundle_adjustment.doubts.ending import unconverged_findings
from boxplus.systems.bundle_adjustment.doubts.focal_lengths import focal_lengths
from boxplus.systems.bundle_adjustment.doubts.lens import lens_finding, lens_of_start
from boxplus.systems.bundle_adjustment.doubts.pixel_origin import pixel_origin
from boxplus.systems.bundle_adjustment.doubts.plausibility import (
    coarse_doubt,
    input_notes,
    mirror_doubt,
    misfit_notes,
    outlier_notes,
    point_notes,
    sigma_doubt,
    sigma_notes,
    structure_notes,
    unit_doubt,
)
from boxplus.systems.bundle_adjustment.doubts.readings import reading_doubt, refuse_other_columns
from boxplus.systems.bundle_adjustment.examination import Watch
from boxplus.systems.bundle_adjustment.reconstruction_problem import (
    add_reconstruction,
    adjusted_reconstruction,
    pixel_errors,
    refuse_focal_lengths,
    start_values,
    turned_lenses,
)
from boxplus.systems.bundle_adjustment.strays import stray_notes, stray_points

_ROUNDS = 3  # of looking for points that have a lower minimum elsewhere
_MOST = 0.5  # share of the observations that a robust loss may silence
_BAD_SHARE = 0.005  # of observations behind their cameras or left out for it, above which a result is not to be trusted


@dataclass(frozen=True, slots=True)
class BundleAdjustmentResult:
    """An adjusted reconstruction.

    Attributes:
        reconstruction: of the same kind as the input, with adjusted cameras and points.
        errors_start, errors: (k,) distance of every observation from its projection [px], NaN where it cannot be projected.
            k leaves out those of COLMAP's observations that belong to no point.
        camera_of, point_of: (k,) the camera (of COLMAP the image) and the point of each.
        cheirality: points behind cameras, before and after, and what was done about them. What was left out is in none of the
            arrays above, and its points stay where they were.
        depth: how well the distance of each point is determined.
        notes: what a user should know of the structure, one sentence each.
        doubt: why the result is not to be trusted; None where nothing speaks against it.
        solution: with history, covariance, and why it stopped.
        cameras, points: the variables of `solution`.
        time_s: seconds, set-up included.

    Example:
        >>> result = bp.adjust_bundle(bp.read_reconstruction("scene.txt.bz2"))
        >>> result.errors.shape == result.errors_start.shape, result.doubt
        (True, None)
    """

    reconstruction: Reconstruction
    errors_start: NDArray[np.float64]
    errors: NDArray[np.float64]
    camera_of: NDArray[np.int64]
    point_of: NDArray[np.int64]
    cheirality: Cheirality
    depth: DepthUncertainty
    notes: tuple[str, ...]
    doubt: str | None
    solution: Solution
    cameras: Variables
    points: Variables
    time_s: float


def adjust_bundle(
    reconstruction: Reconstruction,
    config: BundleAdjustmentConfig | None = None,
    *,
    loss: Loss | None = None,
    callback: Callback | None = None,
) -> BundleAdjustmentResult:
    """Minimise ½ Σ ρ(‖e/σ‖²) over cameras and points, with the reprojection errors e.

    A redescending loss starts from the minimum under Huber's (`solve_from_convex`): it does not see what is far off.

    The callback sees the steps that lead to the result, then those of the solves that examine it, with their `purpose`; where it
    stops one of these, the result stays and a note says what was not examined.

    Nothing is held: Levenberg-Marquardt stays near the start along the seven directions that move the whole scene.

    Raises:
        InputError: a camera model without a counterpart here; a focal length that is not positive; no observation; more than
            half of the observations of points behind their cameras, beyond repair; a method without damping.

    Example:
        >>> result = bp.adjust_bundle(bp.read_reconstruction("scene.txt.bz2"), bp.BundleAdjustmentConfig(intrinsics="refined"))
        >>> result.solution.status, bool(np.median(result.errors) < np.median(result.errors_start))
        ('converged', True)
    """
    require(reconstruction, get_args(Reconstruction), "a reconstruction", "read one with read_reconstruction")
    config = as_settings(BundleAdjustmentConfig, config)
    if config.solver.method == "gauss_newton":
        raise InputError(
            "a method that damps its steps",
            "gauss_newton, though images do not tell where the whole scene lies, how it is turned and how large it is",
            "use levenberg_marquardt or dogleg",
        )
    begin = time.perf_counter()
    if not np.any(reconstruction.point_of >= 0):
        raise InputError(
            "images that see points",
            f"not a single observation of a point ({getattr(reconstruction, 'source', 'reconstruction')})",
            "triangulate first",
        )
    if isinstance(reconstruction, BalProblem):
        refuse_other_columns(reconstruction)
    refuse_focal_lengths(reconstruction)
    is_lens_held = not isinstance(reconstruction, BalProblem) and config.intrinsics == "held"
    other_axes = reading_doubt(reconstruction, is_lens_held=is_lens_held)
    problem = Problem()
    sound = make_sound(reconstruction)
    cameras, points = add_reconstruction(problem, reconstruction, sound.used, config, loss)
    problem.fix(points[sound.cheirality.dropped])
    start = [block.values for block in problem.blocks]
    errors_start = pixel_errors(problem, start)
    start[cameras.number], start[points.number] = start_values(sound.reconstruction)
    solution = solve_from_convex(problem, config.solver, start=start, callback=callback)
    camera_of, point_of = (
        np.concatenate([group.connections[slot].rows for group in problem.groups]).astype(np.int64) for slot in (0, 1)
    )
    _refuse_turned_lenses(reconstruction, config, problem, solution, cameras, other_axes)
    watch = Watch(callback)
    strayed: list[NDArray[np.int64]] = []
    are_late = False  # the last ones, for which no steps are left
    while True:
        errors = pixel_errors(problem, list(solution.values))
        adjusted = adjusted_reconstruction(reconstruction, config, problem, solution, cameras, points, errors, point_of)
        depth = depth_uncertainty(problem, solution, points, adjusted, sound.used, config, loss, watch)
        is_out = solution.limit == "steps"
        left = 0 if is_out else config.solver.max_iterations - solution.iterations
        is_stopped = solution.status == "stopped" and not is_out  # by somebody, who does not wait for more
        if len(strayed) == _ROUNDS or are_late or is_stopped:
            break
        numbers, places = stray_points(adjusted, sound.used, depth.ratio, config, loss, watch)
        if watch.is_stopped or not len(numbers):
            break
        values = [array.copy() for array in solution.values]
        values[points.number][numbers] = places
        again = _continued(problem, solution, config, values, left, callback)
        if not again.cost < solution.cost:
            break
        _refuse_turned_lenses(reconstruction, config, problem, again, cameras, other_axes)
        solution, are_late = again, left <= 0
        strayed.append(numbers)
    cheirality = count_behind(sound, adjusted)
    left = _redundancy(problem, points, point_of)
    notes = [*input_notes(reconstruction), *cheirality.notes(reconstruction), *depth.notes(reconstruction)]
    ids = getattr(reconstruction, "point_ids", None)
    by_start = None if other_axes else lens_of_start(sound.reconstruction, sound.used, config, solution, watch)
    if by_start is not None:
        notes.append(by_start)
    notes += stray_notes(strayed, ids, are_late=are_late)
    notes += point_notes(errors, point_of, _weights(problem, solution, loss), ids)
    is_given = "sigma_px" in config.model_fields_set
    gross = outlier_notes(errors, loss)
    notes += [*gross, *sigma_notes(errors, config.sigma_px, left, is_given=is_given)]
    notes += misfit_notes(solution.cost, left, config.sigma_px, loss, is_given=is_given)
    seen = np.unique(point_of)
    origin = pixel_origin(reconstruction, config, loss, errors, solution, left, watch)
    if origin.note is not None:
        notes.append(origin.note)
    is_explained = origin.note is not None or origin.doubt is not None
    lens = (
        None
        if is_explained
        else lens_finding(adjusted, sound.used, sound.cheirality.dropped, config, loss, solution, left, watch)
    )
    if lens is not None and not lens.is_grave:
        notes.append(lens.sentence)
    lengths = None
    if depth.cameras_move_apart:
        lengths = focal_lengths(adjusted, sound.used, sound.cheirality.dropped, config, loss, errors, solution, left)
    if lengths is not None and lengths.sentence is not None and not lengths.is_grave:
        notes.append(lengths.sentence)
    unconverged, late = unconverged_findings(solution, points, depth.undetermined, ids)
    notes += late
    said = [
        other_axes,
        unit_doubt(reconstruction) if is_lens_held and other_axes is None else None,
        bent_doubt(adjusted, sound.used, sound.cheirality.dropped, config, errors, solution, watch) if gross else None,
        sigma_doubt(solution.cost, left, config.sigma_px, loss, is_given=is_given),
        coarse_doubt(errors, left, adjusted, config.sigma_px, is_given=is_given),
        mirror_doubt(reconstruction.points[seen], adjusted.points[seen]),
        None if lens is None or not lens.is_grave else lens.sentence,
        origin.doubt,
        None if lengths is None or not lengths.is_grave else lengths.sentence,
    ]
    return BundleAdjustmentResult(
        reconstruction=adjusted,
        errors_start=errors_start,
        errors=errors,
        camera_of=camera_of,
        point_of=point_of,
        cheirality=cheirality,
        depth=depth,
        notes=(*notes, *watch.notes, *structure_notes(len(points), camera_of, point_of, solution)),
        doubt=_doubt(cheirality, depth, solution, left, unconverged, said),
        solution=solution,
        cameras=cameras,
        points=points,
        time_s=time.perf_counter() - begin,
    )


def _refuse_turned_lenses(
    reconstruction: Reconstruction,
    config: BundleAdjustmentConfig,
    problem: Problem,
    solution: Solution,
    cameras: Variables,
    other_axes: str | None,
) -> None:
    """Focal lengths that are variables nothing but the images keeps positive.

    Args:
        other_axes: what the start says of the axes of the pixels.
    """
    bad, lenses = turned_lenses(reconstruction, config, problem, solution, cameras)
    if not len(bad):
        return
    name, focal_length = bad[0]
    if other_axes is not None:
        advice = other_axes
    elif 2 * len(bad) < lenses:
        advice = "too few observations or wrong matches there: leave such cameras out, or use a robust loss"
    elif isinstance(reconstruction, BalProblem):
        advice = "are the pixels turned by half a turn (BAL counts x to the right and y upwards), or is the start wrong?"
    else:
        advice = "are axes of the pixels flipped or swapped, or is the start wrong? Held intrinsics show more"
    raise InputError(
        "images that keep the focal lengths positive",
        f"{len(bad)} of {lenses} that came out negative, that of camera {name} as {focal_length:.4g} px",
        advice,
    )


def _continued(
    problem: Problem,
    before: Solution,
    config: BundleAdjustmentConfig,
    values: list[NDArray[np.float64]],
    left: int,
    callback: Callback | None,
) -> Solution:
    """The minimum from other values, with the history of how these came about."""
    count = before.iterations

    def watch(iteration: Iteration) -> bool:
        return callback is not None and bool(callback(replace(iteration, number=count + iteration.number)))

    found = problem.solve(config.solver.model_copy(update={"max_iterations": max(left, 0)}), start=values, callback=watch)
    limit = config.solver.max_iterations
    reason = f"iteration limit of {limit} reached" if found.limit == "steps" else found.reason  # of both together
    time_s = before.history[-1].time_s
    later = (replace(step, number=count + step.number, time_s=time_s + step.time_s) for step in found.history[1:])
    history = (*before.history, replace(found.history[0], number=count, time_s=time_s), *later)
    return replace(found, cost_initial=before.cost_initial, reason=reason, history=history, descent=len(before.history))


def _weights(problem: Problem, solution: Solution, loss: Loss | None) -> NDArray[np.float64] | None:
    """(k,) of every observation under a robust loss."""
    return None if loss is None else np.concatenate([group.loss_weights(solution.values) for group in problem.groups])


def _redundancy(problem: Problem, points: Variables, point_of: NDArray[np.int64]) -> int:
    """Measurements less unknowns, but for the seven that images never tell."""
    others = sum(len(block) * block.manifold.dof for block in problem.blocks if block is not points)
    return 2 * len(point_of) + 7 - others - 3 * len(np.unique(point_of))


def _doubt(
    cheirality: Cheirality,
    depth: DepthUncertainty,
    solution: Solution,
    left: int,
    unconverged: str | None,
    said: list[str | None],
) -> str | None:
    """Why the result is not to be trusted, beside what was `said` of it."""
    reasons = [text for text in said if text]
    if left <= 0:
        reasons.append(f"{counted(-left, 'unknown')} more than measurements: small errors are no evidence")
    if not depth.cameras_move_apart:  # no minimum, either, and more steps lead to none
        reasons.append(NOT_APART)
    elif unconverged:
        reasons.append(unconverged)
    if cheirality.bad_share > _BAD_SHARE:
        count = cheirality.behind + cheirality.left_out
        reasons.append(
            f"{count} of {counted(cheirality.count, 'observation')} ({cheirality.bad_share:.1%}) "
            f"{either(count, 'is of a point behind its camera', 'are of points behind their cameras')} at the end, or "
            f"{either(count, 'was', 'were')} left out for it"
        )
    faded = max(solution.faded.values(), default=0.0)
    if faded > _MOST:
        reasons.append(f"{faded:.0%} of the observations hardly count under the robust loss: a wrong start, or a sigma too small")
    return "; ".join(reasons) or None
