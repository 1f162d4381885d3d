"""How long a solve may take that examines the result of another: by its work, so that no verdict depends on the machine."""

from __future__ import annotations

from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.solver_options import SolverOptions
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig

_STEPS, _SETTLED = 25, 1e-3
_LEAST_WORK = 1_200_000  # observations linearised, about a second's; an examination of a solve that took fewer may take so many
_CUBE = 70  # cameras³ that take as long to factorise as one observation to linearise


def examination_options(problem: Problem, cameras: int, solved: Solution, config: BundleAdjustmentConfig) -> SolverOptions | None:
    """For a solve of `problem` that examines `solved`: no more steps than that took, but for small problems, and at most 25.

    Returns:
        None where the adjustment was stopped by somebody, or ran into its time limit: who does that does not wait for more.
    """
    limit_s = config.solver.time_limit_s
    if limit_s is not None:
        limit_s -= solved.history[-1].time_s
    is_at_end = solved.status != "stopped" or solved.reason.startswith("iteration limit")
    if not is_at_end or (limit_s is not None and limit_s <= 0.0):
        return None
    work = sum(group.residual.count for group in problem.groups) + cameras**3 // _CUBE
    steps = min(_STEPS, max(solved.iterations, _LEAST_WORK // max(work, 1), 1))
    return config.solver.model_copy(update={"max_iterations": steps, "cost_tolerance": _SETTLED, "time_limit_s": limit_s})
