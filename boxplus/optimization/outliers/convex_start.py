"""A robust minimum from a start that may be far: the losses that forget come second.

A redescending loss (Cauchy, Tukey, Geman-McClure, Welsch, truncated) does not see residuals far beyond its scale. From a start
where good residuals are large it settles on whatever it finds, converged and wrong, and its cost is no judge of starts: it is low
where most residuals are beyond the scale. Huber's loss is convex in the residual and never saturates. Its minimum comes first,
and starts are compared by it (Maronna, Martin and Yohai, Robust Statistics, 2006, section 2.7: a monotone estimate starts a
redescending one). Convex in the residual is not convex in the variables: a pose graph that false loops fold stays folded under
Huber too, and wants `graduate`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_settings
from boxplus.optimization.losses import Huber
from boxplus.optimization.minimizers.minimize import Callback
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Iteration, Solution
from boxplus.optimization.solver_options import SolverOptions
from boxplus.optimization.terms.group import Group

CONVEX_SCALE = 1.345
"""Scale of the Huber loss that stands in, in standard deviations: 95 % as good as least squares where all errors are Gaussian."""
_TOLERANCE = 1e-4  # relative decrease of the cost that ends the convex stage; its minimum is only a start


@contextmanager
def convex_losses(problem: Problem) -> Iterator[list[Group]]:
    """Huber in place of every redescending loss, within the block; yields the groups concerned."""
    own = {group.name: group.loss for group in problem.groups if group.loss.is_redescending}
    groups = [group for group in problem.groups if group.name in own]
    for group in groups:
        group.set_loss(Huber(CONVEX_SCALE))
    try:
        yield groups
    finally:
        for group in groups:
            group.set_loss(own[group.name])


def convex_cost(problem: Problem, values: Solution | Sequence[NDArray[np.float64]] | None = None) -> float:
    """½ Σ ρ(‖W r‖²) with Huber in place of redescending losses: compares starts, as no residual is ever too large to count.

    Args:
        values: as for `Problem.cost`.
    """
    with convex_losses(problem):
        return problem.cost(values)


def solve_from_convex(
    problem: Problem,
    options: SolverOptions | None = None,
    *,
    start: Solution | Sequence[NDArray[np.float64]] | None = None,
    callback: Callback | None = None,
) -> Solution:
    """`Problem.solve`, with the minimum under convex losses as the start of redescending ones; without any of these the same.

    Args:
        options, start, callback: as for `Problem.solve`. The callback sees the steps of both stages; limits hold for both
            together.

    Returns:
        The solution under the problem's own losses, with the history of the second stage. `faded`, and `notes` where it is large,
        tell which share of every group hardly counts in the end.

    Raises:
        InputError, NotFiniteError, SingularProblemError: as `Problem.solve`.

    Example:
        `solution = solve_from_convex(problem)` after `problem.add_residuals(..., loss=bp.losses.Tukey(4.685))`
    """
    options = as_settings(SolverOptions, options)
    begin = time.perf_counter()
    stopped = False

    def watch(iteration: Iteration) -> bool:
        nonlocal stopped
        stopped = callback is not None and bool(callback(iteration))
        return stopped

    with convex_losses(problem) as groups:
        if groups:
            early = options.model_copy(update={"cost_tolerance": max(options.cost_tolerance, _TOLERANCE)})
            convex = problem.solve(early, start=start, callback=watch)
    if not groups:
        return problem.solve(options, start=start, callback=callback)
    left = options.max_iterations - convex.iterations
    limits: dict[str, object] = {"max_iterations": 0 if stopped else left}
    if options.time_limit_s is not None:
        limits["time_limit_s"] = max(options.time_limit_s - (time.perf_counter() - begin), 1e-3)
    solution = problem.solve(options.model_copy(update=limits), start=convex, callback=callback)
    return replace(solution, reason=convex.reason) if stopped else solution
