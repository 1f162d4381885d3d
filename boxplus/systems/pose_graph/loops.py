"""False loop closures: graduated non-convexity over the edges of a pose graph, with what odometry says taken for granted.

Truncated least squares (Yang, Antonante, Tzoumas and Carlone, RA-L 2020) over the loop closures alone; edges between successive
poses are never outliers. The first widths hear odometry almost alone, so that loops come in as they agree with it and with each
other. A true loop that was refused for its noise lies further off than its noise, as the minimum was found without it; it is
judged once more by its innovation, with the covariance of the poses counted in.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_quantile
from boxplus.errors import SingularProblemError
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.optimization.losses import Squared
from boxplus.optimization.minimizers.minimize import Callback
from boxplus.optimization.outliers.graduated import graduate
from boxplus.optimization.outliers.inlier_report import InlierReport, inlier_report
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Iteration, Solution
from boxplus.optimization.solver_options import SolverOptions
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.variables import Variables
from boxplus.systems.pose_graph.named import named
from boxplus.systems.pose_graph.problem import LOOPS, problem_with_loops_apart, with_edges
from boxplus.systems.pose_graph.start import components

_SEARCH = 0.99  # of true loops within the threshold of the search: the narrower it is, the fewer false ones get in on the way
_KEEP = 0.999  # of true loops that the innovation keeps
_JUDGED = 400  # refused loops that are judged by their innovation, the nearest ones
_FAR = 100.0  # thresholds, squared, beyond which none is
_ROUNDS = 3  # of readmission
_TAKEN, _TRIED, _HOPELESS = 5, 20, 2.0  # steps over all loops, and times the verdict's objective, above which they do not agree
_SAME = 1e-3  # relative difference up to which two objectives are one


@dataclass(frozen=True, slots=True)
class LoopVerdict:
    """Which edges are believed.

    Attributes:
        is_loop: (m,) edges that could be outliers; the others are odometry.
        is_kept: (m,) edges that the result rests on, odometry among them.
        innovations: (m,) ‖W e‖ at the result, in standard deviations of the measurement.
        report: how clear the decision was.
        solution: the least-squares minimum over the kept edges.
        poses: the variables of it.
        widths: of the loss that were gone through.
    """

    is_loop: NDArray[np.bool_]
    is_kept: NDArray[np.bool_]
    innovations: NDArray[np.float64]
    report: InlierReport
    solution: Solution
    poses: Variables
    widths: int

    @property
    def refuses_more_than_noise(self) -> bool:
        """Whether more loops were refused than the search loses of true ones."""
        return bool(self.is_kept[self.is_loop].mean() < _SEARCH)


def judge_loops(
    graph: PoseGraph,
    is_loop: NDArray[np.bool_],
    start: NDArray[np.float64],
    options: SolverOptions,
    callback: Callback | None = None,
) -> LoopVerdict:
    """Tell true loops from false, and optimise over the true ones.

    Args:
        is_loop: (m,) edges that may be outliers, one at least.
        start: poses; every width of the loss begins there.

    Raises:
        SingularProblemError: see `Problem.solve`.
    """
    problem, poses = problem_with_loops_apart(graph, is_loop)
    group = problem.groups[-1]
    search = math.sqrt(chi_square_quantile(_SEARCH, group.residual.dim))
    # Odometry that holds everything together speaks first; else the loops are needed from the beginning.
    whole = len(np.unique(components(with_edges(graph, ~is_loop)))) == len(np.unique(components(graph)))
    found = graduate(
        problem,
        group,
        loss="truncated",
        inlier_threshold=search,
        weights={LOOPS: np.zeros(group.residual.count)} if whole else None,
        options=options,
        start=[start],
        callback=named(callback, "telling false loop closures from true ones"),
    )
    group.set_loss(Squared())
    return _settled(problem, poses, is_loop, found.inliers[LOOPS], found.solution, options, callback, len(found.levels))


def judge_all_together(
    graph: PoseGraph,
    verdict: LoopVerdict,
    start: NDArray[np.float64],
    options: SolverOptions,
    callback: Callback | None = None,
) -> LoopVerdict:
    """The verdict that follows from the least-squares minimum over all loops, where it is the better one; else the same.

    Odometry that speaks first may wander so far that true loops fit no longer: long walks with noisy turns. Where nearly all
    loops are true, their minimum is no worse, and truncated least squares says which of the two verdicts has the lower one.

    Args:
        verdict: of `judge_loops`.
        start: poses that owe nothing to the odometry alone.

    Raises:
        SingularProblemError: see `Problem.solve`.
    """
    problem, poses = problem_with_loops_apart(graph, verdict.is_loop)
    group = problem.groups[-1]
    limit = _truncated(verdict, group.residual.dim)
    watch, taken = named(callback, "over all loop closures"), 0

    def is_hopeless(step: Iteration) -> bool:
        nonlocal taken
        taken += step.number > 0 and step.accepted
        is_late = taken >= _TAKEN or step.number >= _TRIED
        return (watch is not None and bool(watch(step))) or (is_late and 2.0 * step.cost > _HOPELESS * limit)

    solution = problem.solve(options, start=[start], callback=is_hopeless)
    if solution.is_broken_off:
        return verdict
    kept = group.squares(solution.values) <= chi_square_quantile(_SEARCH, group.residual.dim)
    other = _settled(problem, poses, verdict.is_loop, kept, solution, options, callback, verdict.widths)
    return other if _truncated(other, group.residual.dim) < (1.0 - _SAME) * limit else verdict


def _truncated(verdict: LoopVerdict, dim: int) -> float:
    """Σ r² of the odometry and Σ min(r², c²) of the loops: what graduated non-convexity minimises."""
    squares = verdict.innovations**2
    loops = np.minimum(squares[verdict.is_loop], chi_square_quantile(_SEARCH, dim))
    return float(squares[~verdict.is_loop].sum() + loops.sum())


def _settled(
    problem: Problem,
    poses: Variables,
    is_loop: NDArray[np.bool_],
    kept: NDArray[np.bool_],
    solution: Solution,
    options: SolverOptions,
    callback: Callback | None,
    widths: int,
) -> LoopVerdict:
    """The verdict that begins with the loops `kept`, and ends with those whose innovation lets them in again."""
    group = problem.groups[-1]
    keep = math.sqrt(chi_square_quantile(_KEEP, group.residual.dim))
    solution = _solve_kept(problem, group, kept, options, solution, callback)
    for _ in range(_ROUNDS):
        if solution.status == "stopped":
            break
        again = _readmitted(group, poses, solution, kept, keep)
        if not again.any():
            break
        kept = kept | again
        solution = _solve_kept(problem, group, kept, options, solution, callback)
    innovations, is_kept = np.zeros(len(is_loop)), ~is_loop
    for own, rows in zip(problem.groups, ([is_loop] if is_loop.all() else [~is_loop, is_loop]), strict=True):
        innovations[rows] = np.sqrt(own.squares(solution.values))
    is_kept[is_loop] = kept
    report = inlier_report(innovations[is_loop] ** 2, group.residual.dim, keep, kept)
    return LoopVerdict(is_loop, is_kept, innovations, report, solution, poses, widths)


def _solve_kept(
    problem: Problem, group: Group, kept: NDArray[np.bool_], options: SolverOptions, start: Solution, callback: Callback | None
) -> Solution:
    problem.set_weights(group, kept.astype(np.float64))
    return problem.solve(options, start=start, callback=callback)


def _readmitted(
    group: Group, poses: Variables, solution: Solution, kept: NDArray[np.bool_], threshold: float
) -> NDArray[np.bool_]:
    """(N,) refused loops whose innovation, measured by its own covariance, is no larger than that of true ones."""
    again = np.zeros(len(kept), dtype=np.bool_)
    squares = group.squares(solution.values)
    nearest = np.argsort(np.where(kept, np.inf, squares), kind="stable")[:_JUDGED]
    near = nearest[~kept[nearest] & (squares[nearest] <= _FAR * threshold**2)]
    if not len(near):
        return again
    i, j = (connection.rows[near] for connection in group.connections)
    residual, x = group.residual, solution[poses]
    # Of all loops, as residuals are linearised a group at a time.
    a, b = (connection.rows for connection in group.connections)
    r, J = np.zeros((residual.count, residual.dim)), tuple(np.zeros((residual.count, residual.dim, residual.dim)) for _ in "ij")
    valid = np.ones(residual.count, dtype=np.bool_)
    residual.linearize_into(0, residual.count, (x, x), (a, b), r, J, valid)
    W = residual.whitening.rows(near).factors
    e, Ji, Jj = (np.matmul(W, part) for part in (r[near, :, None], J[0][near], J[1][near]))
    try:
        Pii, Pjj, Pij = (solution.covariance(poses[p], poses[q]) for p, q in ((i, i), (j, j), (i, j)))
    except SingularProblemError:
        return again  # poses that the kept edges leave loose: nothing to judge by
    across = Ji @ Pij @ np.swapaxes(Jj, 1, 2)
    S = (
        np.eye(residual.dim)
        + Ji @ Pii @ np.swapaxes(Ji, 1, 2)
        + Jj @ Pjj @ np.swapaxes(Jj, 1, 2)
        + across
        + np.swapaxes(across, 1, 2)
    )
    innovation = (e * np.linalg.solve(S, e)).sum(axis=(1, 2))
    again[near[innovation <= threshold**2]] = True
    return again
