"""Gauss-Newton: H δ = −g (docs/least_squares.md)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.linear_systems.least_squares import LeastSquares, inner
from boxplus.optimization.minimizers.strategy import Step, Strategy
from boxplus.optimization.observability.singularity import refuse_free_step, refuse_singular

_HALVINGS = 20


class GaussNewton(Strategy):
    """Takes every full step; one that makes a residual invalid is halved."""

    name = "Gauss-Newton"

    def __init__(self) -> None:
        self.parameter = 1.0
        self._full: NDArray[np.float64] | None = None
        self._is_tested = False

    def propose(self, problem: LeastSquares) -> Step | None:
        """See `Strategy.propose`.

        Raises:
            SingularProblemError: a direction is not measured by anything.
        """
        if self._full is None:
            full = problem.solve(None)
            if not self._is_tested:
                refuse_singular(problem)
                self._is_tested = True
            refuse_free_step(problem, full)
            self._full = full
            self.parameter = 1.0
        if self.parameter < 0.5**_HALVINGS:
            return None
        a = self.parameter
        # The model falls by −a gᵀδ − a²/2 δᵀHδ, and Hδ = −g.
        slope = inner(problem.system.gradient, self._full)
        return Step(a * self._full, -slope * (a - 0.5 * a * a))

    def judge(self, ratio: float | None) -> bool:
        """See `Strategy.judge`."""
        if ratio is None:
            self.parameter *= 0.5
            return False
        self._full = None
        return True
