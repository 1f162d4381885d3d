"""Levenberg-Marquardt with Nielsen's damping (docs/least_squares.md; Madsen, Nielsen, Tingleff 2004, section 3.2)."""

from __future__ import annotations

from typing import Literal

import numpy as np

from boxplus.optimization.linear_systems.least_squares import LeastSquares, inner
from boxplus.optimization.minimizers.strategy import Step, Strategy, step_scale
from boxplus.sparse.cholesky import NotPositiveDefinite

_LEAST_DAMPING, _LARGEST_DAMPING = 1e-16, 1e16


class LevenbergMarquardt(Strategy):
    """(H + λ D) δ = −g with D = diag(H) or I; the accepted cost never rises."""

    name = "Levenberg-Marquardt"

    def __init__(self, damping: Literal["diagonal", "identity"], initial: float) -> None:
        self._damping, self._initial = damping, initial
        self.parameter = 0.0
        self._growth = 2.0

    def propose(self, problem: LeastSquares) -> Step | None:
        """See `Strategy.propose`."""
        diagonal = problem.system.diagonal
        if self.parameter == 0.0:
            largest = float(diagonal.max(initial=0.0))
            self.parameter = self._initial * (1.0 if self._damping == "diagonal" else (largest or 1.0))
        scale = step_scale(problem) if self._damping == "diagonal" else np.ones_like(diagonal)
        while self.parameter <= _LARGEST_DAMPING * max(1.0, float(diagonal.max(initial=0.0))):
            D = self.parameter * scale
            try:
                delta = problem.solve(D)
            except NotPositiveDefinite:
                self._grow()
                continue
            return Step(delta, 0.5 * inner(delta, D * delta - problem.system.gradient))
        return None

    def _grow(self) -> None:
        self.parameter *= self._growth
        self._growth *= 2.0

    def judge(self, ratio: float | None) -> bool:
        """See `Strategy.judge`."""
        if ratio is None or not ratio > 0.0:
            self._grow()
            return False
        self.parameter = max(self.parameter * max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3), _LEAST_DAMPING)
        self._growth = 2.0
        return True
