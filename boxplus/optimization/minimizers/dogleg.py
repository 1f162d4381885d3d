"""Powell's dogleg: between the steepest descent and the Gauss-Newton step, within a trust region.

Powell 1970; Nocedal and Wright, Numerical optimization, section 4.1. Lengths are measured in tangents scaled by √diag(H), so
that the region does not depend on units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.linear_systems.least_squares import LeastSquares, inner
from boxplus.optimization.minimizers.strategy import Step, Strategy, step_scale
from boxplus.sparse.cholesky import NotPositiveDefinite

_LEAST_RADIUS = 1e-12
# Where H is singular the Gauss-Newton step is taken with this share of the diagonal added, then ten times more, and so on.
_FIRST_REGULARIZATION, _LARGEST_REGULARIZATION = 1e-14, 1.0


class Dogleg(Strategy):
    """Solves for Gauss-Newton once a linearisation; rejected steps cost no further solve."""

    name = "dogleg"

    def __init__(self, initial_radius: float) -> None:
        self.parameter = initial_radius
        self._legs: _Legs | None = None
        self._length = 0.0

    def propose(self, problem: LeastSquares) -> Step | None:
        """See `Strategy.propose`."""
        if self._legs is None:
            self._legs = _legs(problem)
        if self._legs is None or self.parameter < _LEAST_RADIUS:
            return None
        legs = self._legs
        a, b = legs.within(self.parameter)
        delta = a * legs.cauchy + b * legs.newton
        self._length = _length(delta * legs.scale)
        # The model −gᵀδ − ½ δᵀHδ, from the products of the two legs.
        slope = a * legs.slope[0] + b * legs.slope[1]
        bend = a * a * legs.curvature[0] + 2.0 * a * b * legs.curvature[1] + b * b * legs.curvature[2]
        return Step(delta, -slope - 0.5 * bend)

    def judge(self, ratio: float | None) -> bool:
        """See `Strategy.judge`."""
        if ratio is None or not ratio > 0.0:
            self.parameter = 0.5 * min(self.parameter, self._length)
            return False
        if ratio < 0.25:
            self.parameter *= 0.5
        elif ratio > 0.75:
            self.parameter = max(self.parameter, 3.0 * self._length)
        self._legs = None
        return True


@dataclass(frozen=True, slots=True)
class _Legs:
    """The two ends of the path, δ_c and δ_n, with gᵀδ of each and δ_cᵀHδ_c, δ_cᵀHδ_n, δ_nᵀHδ_n."""

    scale: NDArray[np.float64]
    cauchy: NDArray[np.float64]
    newton: NDArray[np.float64]
    slope: tuple[float, float]
    curvature: tuple[float, float, float]

    def within(self, radius: float) -> tuple[float, float]:
        """Shares of δ_c and δ_n at the point of 0 → δ_c → δ_n on the border of the region, or at its end."""
        cauchy, newton = self.cauchy * self.scale, self.newton * self.scale
        if _length(newton) <= radius:
            return 0.0, 1.0
        length = _length(cauchy)
        if length >= radius:
            return radius / length, 0.0
        leg = newton - cauchy
        a, b, c = inner(leg, leg), inner(cauchy, leg), length * length - radius * radius
        # Of the two forms of the root, the one without cancellation.
        root = math.sqrt(max(b * b - a * c, 0.0))
        share = -c / (b + root) if b > 0.0 else (root - b) / a
        return 1.0 - share, share


def _length(vector: NDArray[np.float64]) -> float:
    return math.sqrt(inner(vector, vector))


def _legs(problem: LeastSquares) -> _Legs | None:
    gradient = problem.system.gradient
    squared = step_scale(problem)
    descent = -gradient / squared
    along = problem.curvature(descent)
    share = 0.0
    while share <= _LARGEST_REGULARIZATION:
        try:
            newton = problem.solve(share * squared if share else None)
            break
        except NotPositiveDefinite:
            share = max(_FIRST_REGULARIZATION, 10.0 * share)
    else:
        return None
    length = -inner(gradient, descent) / along if along > 0.0 else 1.0
    cauchy = length * descent
    # H δ_n = −g − share·diag(H) δ_n spares further products with H.
    pulled = -gradient - share * squared * newton
    return _Legs(
        scale=np.sqrt(squared),
        cauchy=cauchy,
        newton=newton,
        slope=(inner(gradient, cauchy), inner(gradient, newton)),
        curvature=(length * length * along, inner(cauchy, pulled), inner(newton, pulled)),
    )
