"""How long a solve may take that examines the result of another: by its work, so that no verdict depends on the machine.

Whoever sees and stops the adjustment sees and stops these solves as well.
"""

from __future__ import annotations

from dataclasses import replace

from boxplus.optimization.minimizers.minimize import Callback
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Iteration, Solution
from boxplus.optimization.solver_options import SolverOptions
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig

_STEPS, _SETTLED = 25, 1e-3
_LEAST_WORK = 1_200_000  # observations linearised, about a second's; an examination of a solve that took fewer may take so many
_CUBE = 70  # cameras³ that take as long to factorise as one observation to linearise


class Watch:
    """Shows the steps of examinations to the callback of the adjustment, which may stop them."""

    def __init__(self, callback: Callback | None) -> None:
        self._callback = callback
        self.stopped_at = ""
        """The purpose of the one that was stopped; empty where none was."""

    def of(self, purpose: str) -> Callback:
        """The callback of a solve with this purpose; where an earlier one was stopped, it stops at once."""

        def show(step: Iteration) -> bool:
            if not self.stopped_at and self._callback is not None and self._callback(replace(step, purpose=purpose)):
                self.stopped_at = purpose
            return self.is_stopped

        return show

    @property
    def is_stopped(self) -> bool:
        """Whether somebody stopped one: there is no verdict of that and of later ones."""
        return bool(self.stopped_at)

    @property
    def notes(self) -> list[str]:
        """A sentence, where they were stopped."""
        if not self.is_stopped:
            return []
        return [f"stopped while the result was examined ({self.stopped_at}): what that and later examinations find is not known"]


UNWATCHED = Watch(None)
"""Nobody sees or stops it."""


def examination_options(
    problem: Problem, cameras: int, solved: Solution, config: BundleAdjustmentConfig, watch: Watch = UNWATCHED
) -> SolverOptions | None:
    """For a solve of `problem` that examines `solved`: no more steps than that took, but for small problems, and at most 25.

    Returns:
        None where somebody stopped the adjustment or an examination, or it ran into its time limit: who does that does not wait
        for more.
    """
    limit_s = config.solver.time_limit_s
    if limit_s is not None:
        limit_s -= solved.history[-1].time_s
    if watch.is_stopped or solved.is_broken_off or (limit_s is not None and limit_s <= 0.0):
        return None
    work = sum(group.residual.count for group in problem.groups) + cameras**3 // _CUBE
    steps = min(_STEPS, max(solved.iterations, _LEAST_WORK // max(work, 1), 1))
    return config.solver.model_copy(update={"max_iterations": steps, "cost_tolerance": _SETTLED, "time_limit_s": limit_s})
