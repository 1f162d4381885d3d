"""Pose-graph optimisation: the poses that agree best with the relative poses measured between them.

Derivation: docs/residuals/relative_pose.md.
Two objectives: `logarithm`, Σ eᵀ Ω e with e = Log(Z⁻¹ T_i⁻¹ T_j), the statistically right one; and `chordal`, that of SE-Sync
(Rosen et al., IJRR 2019), κ ‖R_j − R_i R_ij‖² + τ ‖t_j − t_i − R_i t_ij‖², to compare with its certified optima.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from boxplus._arguments import as_settings, require
from boxplus._settings import Settings
from boxplus.errors import InputError
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.optimization.losses import Loss
from boxplus.optimization.minimizers.minimize import Callback
from boxplus.optimization.outliers.convex_start import convex_cost
from boxplus.optimization.solution import Solution
from boxplus.optimization.solver_options import SolverOptions
from boxplus.optimization.terms.variables import Variables
from boxplus.systems.pose_graph.certificate import Certificate, certify
from boxplus.systems.pose_graph.doubts.contradictions import contradictions
from boxplus.systems.pose_graph.doubts.fit import (
    Fit,
    disagree,
    drifted_doubt,
    local_notes,
    misfit,
    poor_fit_sentence,
    repetition_notes,
    silent_notes,
    slack_sentence,
    standing_out,
    structure_notes,
    undetermined_notes,
    without_information,
)
from boxplus.systems.pose_graph.doubts.fixed_poses import fixed_poses_doubt
from boxplus.systems.pose_graph.doubts.information_readings import information_doubt, slack_part_notes
from boxplus.systems.pose_graph.doubts.readings import misreading
from boxplus.systems.pose_graph.doubts.reliability import Reliability
from boxplus.systems.pose_graph.doubts.suspicions import suspicions
from boxplus.systems.pose_graph.doubts.wide_rotations import are_wide, wide_notes
from boxplus.systems.pose_graph.doubts.witnesses import held_against_each_other, lone_joints
from boxplus.systems.pose_graph.loops import LoopVerdict, judge_loops
from boxplus.systems.pose_graph.problem import (
    Objective,
    consecutive_edges,
    pose_graph_problem,
    squared_errors,
    turns,
    with_edges,
)
from boxplus.systems.pose_graph.start import held_poses
from boxplus.systems.pose_graph.starts import Start, Starts, Wanted

# Almost Gauss-Newton: long chains are so badly conditioned that more damping than this costs iterations. Less would soon be below
# what a pivot is told from rounding by, and have to grow again where edges leave something free.
_DAMPING = 1e-11
_LOUD = 0.2  # [rad] root mean square of the errors in rotation from which on local minima fit their information, too
_COUNTS = 0.5  # weight from which on an edge is expected to fit its information


class PoseGraphConfig(Settings):
    """Options of `optimize_pose_graph`.

    Example:
        >>> bp.PoseGraphConfig(robust="gnc").start
        'auto'
    """

    start: Wanted = Field(
        "auto",
        description="where to start; auto: the cheapest of the file's poses and the chordal relaxation, and further starts where "
        "the residuals do not fit their information",
    )
    objective: Objective = Field(
        "logarithm", description="logarithm: Σ eᵀ Ω e with e = Log(Z⁻¹ T_i⁻¹ T_j); chordal: the objective of SE-Sync"
    )
    robust: Literal["none", "gnc"] = Field(
        "none", description="gnc: false loop closures are told from true ones by graduated non-convexity and refused"
    )
    examine: bool = Field(
        True,
        description="look for single edges that all others contradict, for odometry that is off as a whole and for information "
        "that is wrong in parts; takes about as long as the optimisation",
    )
    certify: bool = Field(False, description="whether the optimum is the global one, by SE-Sync's dual; chordal objective only")
    solver: SolverOptions = Field(
        SolverOptions(initial_damping=_DAMPING), description="see SolverOptions; Levenberg-Marquardt, hardly damped"
    )


@dataclass(frozen=True, slots=True)
class PoseGraphResult:
    """An optimised pose graph.

    Attributes:
        graph: the input with the optimised poses.
        start: which start was taken, and `start_reason` why, in a sentence.
        poses_start: the poses there.
        start_costs: the cost at every start that was compared, with Huber in place of a loss that forgets.
        chi2_start, chi2: the objective over the edges without any robust loss, twice the cost of a problem without one.
        errors_start, errors: (m,) √ of what every edge adds to chi2: its error in standard deviations.
        errors_before: the same at the poses of the input; at the start, where it has none.
        weights: (m,) weight of every edge at the end, 0 to 1: refused, or silenced by a robust loss.
        fit: χ² of the edges that count against what their information promises.
        checks: how large an error of a single edge has to be to show; None where that was not examined.
        minima: the objective at the end of every start that was followed; several after a misfit or with noisy rotations.
        loops: the verdict on the loop closures, with `robust="gnc"`; None otherwise.
        certificate: with `certify`; None otherwise.
        held: indices of the poses that were held: those the file fixes, and the first of every component without any.
        notes: what a user should know of structure and result, one sentence each.
        doubt: why the result is not to be trusted, where it is known not to be what it claims: a file that means something else
            than it was read as, edges that contradict each other or a minimum that is likely local, not certified though that was
            asked for, or what speaks against the verdict on the loops; None otherwise.
        solution: with history, covariance, and why it stopped.
        poses: the variables of `solution`.
        timing_s: seconds of checking and building the problem, of the initialisation, of the optimisation, of the examination.

    Example:
        >>> result = bp.optimize_pose_graph(bp.read_pose_graph("loops.g2o"))
        >>> result.start, bool(result.chi2 < result.chi2_start), result.errors.shape
        ('chordal', True, (35,))
    """

    graph: PoseGraph
    start: Start
    start_reason: str
    poses_start: NDArray[np.float64]
    start_costs: dict[Start, float]
    chi2_start: float
    chi2: float
    errors_start: NDArray[np.float64]
    errors: NDArray[np.float64]
    errors_before: NDArray[np.float64]
    weights: NDArray[np.float64]
    fit: Fit
    checks: str | None
    minima: dict[Start, float]
    loops: LoopVerdict | None
    certificate: Certificate | None
    held: NDArray[np.int64]
    notes: tuple[str, ...]
    doubt: str | None
    solution: Solution
    poses: Variables
    timing_s: dict[str, float]


def optimize_pose_graph(
    graph: PoseGraph, config: PoseGraphConfig | None = None, *, loss: Loss | None = None, callback: Callback | None = None
) -> PoseGraphResult:
    """Minimise ½ Σ ρ(eᵀ Ω e) with e = Log(Z⁻¹ T_i⁻¹ T_j), or the chordal objective, over the poses.

    Edges without information are left out and named. A loss that forgets (`Loss.is_redescending`) starts from the poses that
    graduated non-convexity finds, as it settles on anything otherwise.

    Raises:
        InputError: no edge with information; the start asked for is not in the file; a robust loss together with `robust`, the
            chordal objective with `robust`, another one with `certify`.
        SingularProblemError: see `Problem.solve`.

    Example:
        >>> result = bp.optimize_pose_graph(bp.read_pose_graph("loops.g2o"))
        >>> result.solution.status, result.graph.poses.shape
        ('converged', (24, 7))
    """
    require(graph, PoseGraph, "a PoseGraph", "read one with read_pose_graph, or make one from arrays")
    config = as_settings(PoseGraphConfig, config)
    _check(graph, config, loss)
    options = config.solver
    if "initial_damping" not in options.model_fields_set:
        options = options.model_copy(update={"initial_damping": _DAMPING})
    begin = time.perf_counter()
    silent = without_information(graph)
    whole, graph = graph, with_edges(graph, ~silent)
    held = held_poses(graph)
    problem, poses = pose_graph_problem(graph, held=held, loss=loss, objective=config.objective)
    follow = consecutive_edges(graph)
    starts = Starts(graph, problem, follow, held, config.start, options, callback)
    built = time.perf_counter()
    known = starts.candidates(loss, is_robust=config.robust == "gnc")
    costs = {name: convex_cost(problem, [start]) for name, start in known.items()}
    chosen = min(known, key=lambda name: costs[name])
    prepared = time.perf_counter()
    residual = problem.groups[0].residual
    verdict, is_loud = None, False
    if config.robust == "gnc" and starts.is_loop.any():
        verdict = judge_loops(graph, starts.is_loop, known[chosen], options, callback)
        if config.start == "auto" and not verdict.solution.is_broken_off and verdict.refuses_more_than_noise:
            chosen, verdict = starts.all_together(chosen, verdict, known)
            costs[chosen] = convex_cost(problem, [known[chosen]])
        poses = verdict.poses
        solution, minima = verdict.solution, {chosen: 2.0 * verdict.solution.cost}
        weights = verdict.is_kept.astype(np.float64)
        squared = squared_errors(residual, graph, solution.values[0])
    else:
        solution = problem.solve(options, start=[known[chosen]], callback=callback)
        minima = {chosen: 2.0 * solution.cost}
        squared = squared_errors(residual, graph, solution.values[0])
        first = _fit(graph, squared, None, config, len(held))
        is_loud = config.objective == "logarithm" and turns(residual, graph, solution.values[0]) > _LOUD
        if config.examine and config.objective == "logarithm" and loss is None and not solution.is_broken_off:
            is_loud = is_loud or are_wide(solution, poses, first)
        if loss is None and config.start == "auto" and (first.is_doubtful or is_loud):
            enough = first.enough if first.is_doubtful else None
            chosen, solution = starts.further(chosen, solution, known, minima, enough, is_loud=is_loud)
            squared = squared_errors(residual, graph, solution.values[0])
        weights = np.ones(len(squared)) if loss is None else problem.groups[0].loss_weights(solution.values)
    solved = time.perf_counter()
    poses_end = solution.values[0]
    squared_start = squared_errors(residual, graph, known[chosen])
    squared_before = squared_start if graph.poses is None else squared_errors(residual, graph, graph.poses)
    fit = _fit(graph, squared, weights, config, len(held))
    certificate = certify(replace(graph, poses=poses_end)) if config.certify else None
    notes = [*silent_notes(whole, silent), *repetition_notes(graph), *structure_notes(graph, held), *solution.notes]
    free = undetermined_notes(graph, solution)
    notes += free
    if fit.is_slack:
        notes.append(slack_sentence(fit))
    notes += local_notes(fit, minima)
    drifted = drifted_doubt(graph, poses_end) if free else None
    reasons = [text for text in (solution.unconverged(), misreading(graph, follow), drifted) if text]
    if verdict is not None:
        if fit.is_poor and not fit.is_contradiction:
            notes.append(f"{misfit(fit)}: information that is too optimistic, or false loop closures among those that were kept")
        unsure, against = contradictions(graph, verdict, starts.bridges)
        notes += unsure
        reasons += _verdict_doubts(fit, verdict) + against
    else:
        joints = lone_joints(graph, follow)
        reasons += [one.sentence for one in joints if one.is_grave]
        notes += [one.sentence for one in joints if not one.is_grave]
    if verdict is None and loss is not None and starts.verdict is not None:
        unsure, against = contradictions(graph, starts.verdict, starts.bridges)
        notes += unsure
        reasons += against
    if verdict is None and fit.is_poor:
        told = poor_fit_sentence(fit, minima, len(graph.fixed))
        is_local = disagree(minima) and (is_loud or fit.is_contradiction)
        bent = is_local or (fit.is_contradiction and standing_out(squared, graph.information.shape[1]).any())
        (reasons if bent else notes).append(told)
    examined = time.perf_counter()
    reliability, found = None, []
    if config.examine and not solution.is_broken_off:
        if loss is not None or config.objective == "chordal":
            found = held_against_each_other(
                graph, poses_end, options, loss, None if starts.verdict is None else starts.verdict.is_kept
            )
        elif solution.status != "stopped":
            kept = np.ones(len(graph.edges), dtype=np.bool_) if verdict is None else verdict.is_kept
            reliability = Reliability.of(with_edges(graph, kept), solution, poses)
            if reliability is not None:
                found = suspicions(reliability, solution, follow[kept])
                notes += wide_notes(graph, reliability, fit)
    is_at_end = solution.status == "converged" or solution.limit == "steps"  # a small χ² is none of a start
    if config.examine and verdict is None and loss is None and config.objective == "logarithm" and is_at_end:
        meant = information_doubt(graph, solution, poses, held, options, reliability, callback)
        if meant is not None:
            reasons.append(meant)
        elif reliability is not None:
            notes += slack_part_notes(reliability)
    if config.examine and is_at_end and len(graph.fixed) > 1:
        judged = verdict if loss is None else starts.verdict
        kept = np.ones(len(graph.edges), dtype=np.bool_) if judged is None else judged.is_kept
        is_loop = None if verdict is None else starts.is_loop
        elsewhere = fixed_poses_doubt(graph, poses_end, kept, options, loss, callback, is_loop)
        reasons += [elsewhere] if elsewhere else []
    for one in found:
        (reasons if one.is_grave else notes).append(one.sentence)
    examination = time.perf_counter() - examined
    if certificate is not None and not certificate.is_certified:
        reasons.append(certificate.sentence)
    return PoseGraphResult(
        graph=replace(whole, poses=poses_end),
        start=chosen,
        start_reason=_reason(config.start, chosen, costs, minima),
        poses_start=known[chosen],
        start_costs=costs,
        chi2_start=float(squared_start.sum()),
        chi2=float(squared.sum()),
        errors_start=_spread(np.sqrt(squared_start), ~silent),
        errors=_spread(np.sqrt(squared), ~silent),
        errors_before=_spread(np.sqrt(squared_before), ~silent),
        weights=_spread(weights, ~silent),
        fit=fit,
        checks=None if reliability is None else reliability.sentence,
        minima=minima,
        loops=verdict,
        certificate=certificate,
        held=held,
        notes=tuple(notes),
        doubt="; ".join(reasons) or None,
        solution=solution,
        poses=poses,
        timing_s={
            "set-up": built - begin,
            "start": prepared - built,
            "optimisation": solved - prepared,
            "examination": examination,
        },
    )


def _check(graph: PoseGraph, config: PoseGraphConfig, loss: Loss | None) -> None:
    if not graph.information.any():
        raise InputError(
            "a graph with edges that carry information",
            f"{len(graph.ids)} poses and none ({graph.source})",
            "measure relative poses first",
        )
    if config.robust == "gnc" and (loss is not None or config.objective != "logarithm"):
        raise InputError(
            "graduated non-convexity with the logarithmic error and no other robust loss",
            f"loss {loss!r}, objective {config.objective}",
            "leave the other out",
        )
    if config.certify and (loss is not None or config.objective != "chordal" or config.robust != "none"):
        raise InputError(
            "the chordal objective without a robust loss, of which alone optimality can be certified",
            f"objective {config.objective}, loss {loss!r}, robust {config.robust}",
            'set objective="chordal"',
        )


def _verdict_doubts(fit: Fit, verdict: LoopVerdict) -> list[str]:
    if not fit.is_contradiction:
        return []
    return [
        f"odometry and the loop closures that were kept contradict each other: {misfit(fit)}; the odometry claims more than "
        "it can, or false loop closures were kept"
    ]


def _fit(
    graph: PoseGraph, squared: NDArray[np.float64], weights: NDArray[np.float64] | None, config: PoseGraphConfig, held: int
) -> Fit:
    """Of the edges that count; the chordal objective has no distribution to compare with."""
    counted = np.ones(len(squared), dtype=np.bool_) if weights is None else weights > _COUNTS
    return Fit.of(graph, squared, counted, held) if config.objective == "logarithm" else Fit(float(squared[counted].sum()), 0)


def _spread(values: NDArray[np.float64], rows: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Values of some edges among all; zero for the others."""
    spread = np.zeros(len(rows))
    spread[rows] = values
    return spread


def _reason(wanted: str, chosen: Start, costs: dict[Start, float], minima: dict[Start, float]) -> str:
    """Why a start was taken."""
    name = chosen.replace("_", " ")
    if len(minima) > 1:
        first = next(iter(minima))
        ends = ", ".join(f"{value:.6g} ({other.replace('_', ' ')})" for other, value in minima.items())
        why = _reason(wanted, first, costs, {first: minima[first]}) if chosen == first else f"{name}, which ends lowest"
        return f"{why}; further starts were followed, as residuals do not fit their information or rotations are noisy: χ² {ends}"
    if chosen == "graduated":
        return "graduated: the minimum over the loop closures that graduated non-convexity believes, as the loss forgets"
    if wanted != "auto":
        return f"{name}, as asked for; cost {costs[chosen]:.6g}"
    if chosen == "spanning_tree":
        return f"spanning tree, along the odometry, where no loop closure is believed yet; cost {costs[chosen]:.6g}"
    if "spanning_tree" in costs:
        return (
            f"{name}, from where nearly all loop closures agree with each other and with the odometry, which by itself leads too "
            f"far astray to judge them; cost {costs[chosen]:.6g}"
        )
    if len(costs) == 1:
        return f"{name}, as the graph has no poses of its own; cost {costs[chosen]:.6g}"
    others = ", ".join(f"{cost:.6g} ({other})" for other, cost in costs.items() if other != chosen)
    return f"{name}, with cost {costs[chosen]:.6g} cheaper than {others}"
