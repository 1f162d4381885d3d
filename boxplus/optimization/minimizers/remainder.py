"""How far from its minimum a solve ended that a limit stopped, or that found no step down.

Where the steps are those of Gauss-Newton, the next one tells: its model falls by ½ gᵀH⁻¹g, and √(gᵀH⁻¹g) is the distance to the
minimum in standard deviations of the variables, all together. Where residuals are large the steps shrink by the same factor again
and again, and are each a small part of the way: then the fall of the cost over the last ones tells more, if there were some.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from boxplus.optimization.linear_systems.least_squares import LeastSquares, inner
from boxplus.optimization.minimizers.strategy import step_scale
from boxplus.sparse.cholesky import NotPositiveDefinite

_DAMPING, _GROWTH, _MOST = 1e-8, 10.0, 1.0  # share of diag(H): directions that nothing measures have no way to go
_WINDOW, _LEAST = 5, 3  # steps, whose fall of the cost is compared with that of as many before: at most, and at least
_SLOWEST = 0.98  # of the fall from one window to the next; a slower one would sum up to anything
_NOISE = 0.1  # of the standard deviations that were given: less noise than that is not presumed
_AWAY = 1.0  # standard deviations


def remaining_cost(problem: LeastSquares, costs: Sequence[float]) -> float:
    """By how much the cost would still fall from the accepted point of `problem`.

    Args:
        costs: at the accepted point after every step that was tried, the start's first.
    """
    return max(_next_fall(problem), _trend(costs))


def unconverged_sentence(reason: str, cost: float, remaining: float, redundancy: int) -> str | None:
    """What it means that a solve ended before its minimum; None where that is nearer than noise puts the minimum itself.

    Args:
        reason: why it ended. cost: there. remaining: by how much it would still fall.
        redundancy: residuals less degrees of freedom.
    """
    variance = max(2.0 * (cost - remaining) / redundancy if redundancy > 0 else 1.0, _NOISE**2)
    away = math.sqrt(2.0 * remaining / variance)
    if not away > _AWAY:
        return None
    return (
        f"no minimum was reached ({reason}): the cost of {cost:.6g} would still fall by about {remaining:.3g}, and all variables "
        f"together are {away:.2g} standard deviations or more away from there"
    )


def _next_fall(problem: LeastSquares) -> float:
    """By the model of the undamped step, whether that is too long for it or not: what is not known to be near is far."""
    scale, share = step_scale(problem), _DAMPING
    while share <= _MOST:
        D = share * scale
        try:
            delta = problem.solve(D)
        except NotPositiveDefinite:
            share *= _GROWTH
            continue
        return 0.5 * inner(delta, D * delta - problem.system.gradient)
    return math.inf


def _trend(costs: Sequence[float]) -> float:
    """The sum of a geometric sequence of falls, of which the last two windows are known."""
    window = min(_WINDOW, (len(costs) - 1) // 2)
    if window < _LEAST:
        return 0.0
    before, middle, now = (costs[-1 - 2 * window], costs[-1 - window], costs[-1])
    early, late = before - middle, middle - now
    if not (np.isfinite(early) and 0.0 < late < early):  # falls that grow are no sequence: the way has only begun
        return 0.0
    shrinks = min(late / early, _SLOWEST)
    return late * shrinks / (1.0 - shrinks)
