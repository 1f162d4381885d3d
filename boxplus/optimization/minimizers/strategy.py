"""How a step is chosen and judged: what Gauss-Newton, Levenberg-Marquardt and the dogleg share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.linear_systems.least_squares import LeastSquares


@dataclass(frozen=True, slots=True)
class Step:
    """A step and the decrease of the cost that the linear model predicts for it."""

    delta: NDArray[np.float64]
    predicted: float


# Smaller entries of diag(H), as a share of the largest of their kind, do not scale steps: what has no information is damped too.
_LEAST_DIAGONAL = 1e-14


def step_scale(problem: LeastSquares) -> NDArray[np.float64]:
    """diag(H) (dof,), positive also where nothing is measured."""
    diagonal = problem.system.diagonal
    largest = problem.layout.largest_of_kind(diagonal)
    overall = float(largest.max(initial=0.0)) or 1.0
    return np.maximum(diagonal, _LEAST_DIAGONAL * np.where(largest > 0.0, largest, overall))


class Strategy(ABC):
    """Proposes steps from the accepted point and learns from their fate.

    Attributes:
        name: for reports.
        parameter: what the strategy regulates (λ, radius, step length), for the history.
    """

    name: str
    parameter: float

    @abstractmethod
    def propose(self, problem: LeastSquares) -> Step | None:
        """A step from the accepted point; None when none can be computed any more.

        Raises:
            NotPositiveDefinite: the strategy has no damping and H is singular.
        """

    @abstractmethod
    def judge(self, ratio: float | None) -> bool:
        """Whether to take the last step, with actual over predicted decrease; None: it lost a residual or is not finite."""
