"""How far from its minimum a solve ended that a limit stopped, or that found no step down.

Where the cost follows the model of Gauss-Newton, the next step δ tells: it falls by ½ gᵀH⁻¹g, and √(gᵀH⁻¹g) is the way to the
minimum in standard deviations of the variables, all together. Where it does not, as in a curved valley, δ is still as far as the
model says the minimum is; steps that are damped until the cost follows them are short, and say nothing about what comes after.
Where residuals are large the steps shrink by the same factor again and again, and are each a small part of the way: then the fall
of the cost over the last ones tells more, if there were some.

All together, many variables are far off where each of them is as good as at the minimum. So each is asked by itself, and each
residual what it sees: relative poses, say, which are known better than the poses (`Distances`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.linear_systems.least_squares import LeastSquares, inner
from boxplus.optimization.minimizers.distances import AWAY, Distances
from boxplus.optimization.minimizers.strategy import step_scale
from boxplus.optimization.terms.variables import VariableRows
from boxplus.sparse.cholesky import NotPositiveDefinite

# Shares of diag(H): directions that nothing measures have no way to go. The next one is for where rounding hides the last one.
_DAMPING = (1e-8, 1e-6, 1e-4)
_HELD = 1e-2  # share of diag(H), where variables are left out: depths of far points stay, and their directions follow
_SHORTEST, _WINDOW = 2, 5  # steps, whose fall of the cost is compared with that of as many before
_LEAST = 3  # of them that twice as many steps must allow, to see a sequence
_SLOWEST = 0.98  # of the fall from one window to the next; a slower one would sum up to anything
_NOISE = 0.1  # of the standard deviations that were given: less noise than that is not presumed


@dataclass(frozen=True, slots=True)
class Remainder:
    """What lies between a point and the minimum.

    Attributes:
        cost: by how much the cost would still fall; infinite where no step could be computed.
        total: distance in standard deviations, all variables together: it grows with their number.
        variables: for every block (n,) the distance of each in standard deviations of its own, with the noise that the errors
            have; zero where fixed. Some of the farthest are exact; the others scatter by a tenth, or by a fifth where one is
            known to be farther than one, and none is farther than `total`. Where nothing holds the world, without the motion
            that all poses have in common.
        residuals: for every group (N,) the same of what each residual sees.
        far_variables, far_residuals: for every block and group, how many are farther than one whatever the estimates scatter.
        worst_variable: block and row of the farthest that is exact; None where none is farther than one.
        worst_residual: group and residual likewise, where no variable is farther than one.
    """

    cost: float
    total: float
    variables: tuple[NDArray[np.float64], ...]
    residuals: tuple[NDArray[np.float64], ...]
    far_variables: tuple[int, ...]
    far_residuals: tuple[int, ...]
    worst_variable: tuple[int, int] | None
    worst_residual: tuple[int, int] | None


def find_remainder(problem: LeastSquares, costs: Sequence[float], apart_from: VariableRows | None) -> Remainder | None:
    """None where the minimum is nearer than noise puts it itself.

    Args:
        problem: linearised at the accepted point.
        costs: at the accepted point after every step of the descent that led there, the start's first.
        apart_from: see `Solution.remainder`.
    """
    left_out = np.zeros(len(problem.layout.sizes), dtype=np.bool_)
    step = _next_step(problem, left_out)
    slow = max(_trend(costs) / step.fall, 1.0) if step.fall > 0.0 else 1.0
    if apart_from is not None:
        number = problem.layout.numbers(apart_from)
        left_out[number[number >= 0]] = True
        step = _next_step(problem, left_out)
    remaining = slow * step.fall
    variance = _variance(problem, remaining)
    total = math.sqrt(2.0 * remaining / variance)
    if not total > AWAY:
        return None
    if remaining == math.inf:
        everywhere = [np.where(number >= 0, total, 0.0) for number in problem.layout.number]
        nowhere = tuple(np.zeros(len(group.r)) for group in problem.groups)
        far = tuple(int(np.count_nonzero(one)) for one in everywhere), tuple(0 for _ in nowhere)
        return Remainder(remaining, total, tuple(everywhere), nowhere, *far, _first_free(problem), None)
    found = Distances(problem, step.delta * math.sqrt(slow / variance), step.damping, total, left_out)
    far = found.far_variables, found.far_residuals
    return Remainder(remaining, total, found.variables, found.residuals, *far, found.worst_variable, found.worst_residual)


def _first_free(problem: LeastSquares) -> tuple[int, int] | None:
    free = (np.flatnonzero(number >= 0) for number in problem.layout.number)
    return next(((block, int(rows[0])) for block, rows in enumerate(free) if len(rows)), None)


def _variance(problem: LeastSquares, remaining: float) -> float:
    """Of the whitened errors, at a minimum that is by `remaining` lower."""
    redundancy = sum(group.residual.dim * int(np.count_nonzero(group.counted)) for group in problem.groups) - problem.layout.dof
    return max(2.0 * (problem.cost.cost - remaining) / redundancy if redundancy > 0 else 1.0, _NOISE**2)


def unconverged_sentence(problem: LeastSquares, reason: str, cost: float, remainder: Remainder) -> str | None:
    """What it means that a solve ended before its minimum; None where no variable and no residual sees it.

    Args:
        reason: why it ended. cost: there.
    """
    layout = problem.layout
    if remainder.worst_variable is not None:
        number, row = remainder.worst_variable
        what, away = f"{layout.blocks[number].name}[{layout.ids[number][row]}]", remainder.variables
        others = _others(remainder.far_variables, away, number, [block.name for block in layout.blocks])
    elif remainder.worst_residual is not None:
        number, row = remainder.worst_residual
        group, away = problem.groups[number], remainder.residuals
        ends = " and ".join(f"{c.block.name}[{c.ids[row]}]" for c in group.connections)
        what = f"what {group.name}[{row}] sees of {ends}"
        others = _others(remainder.far_residuals, away, number, [one.name for one in problem.groups])
    else:
        return None
    return (
        f"no minimum was reached ({reason}): the cost of {cost:.6g} would still fall by about {remainder.cost:.3g}, and "
        f"{what} is {away[number][row]:.2g} standard deviations of its own away from there{others}"
    )


def _others(far: Sequence[int], away: Sequence[NDArray[np.float64]], worst: int, names: Sequence[str]) -> str:
    """How many more are farther than one, at least: what estimates scatter by is none of it."""
    told = []
    for number, (count, one, name) in enumerate(zip(far, away, names, strict=True)):
        more = count - (number == worst)
        if more:
            told.append(f"{more} {'more ' if number == worst else ''}of {len(one)} {name}")
    return f", and at least {', '.join(told)} more than one" if told else ""


@dataclass(frozen=True, slots=True)
class _Step:
    """A step, by how much its model falls, infinite where there is none, and what damped it."""

    delta: NDArray[np.float64]
    fall: float
    damping: NDArray[np.float64]


def _next_step(problem: LeastSquares, left_out: NDArray[np.bool_]) -> _Step:
    """That of Gauss-Newton, along the directions that are measured.

    Args:
        left_out: (free variables,) those held along what their own residuals hardly measure.
    """
    scale = step_scale(problem)
    held = np.where(np.repeat(left_out, problem.layout.sizes), _HELD, 0.0)
    for share in _DAMPING:
        D = np.maximum(held, share) * scale
        try:
            delta = problem.solve(D)
        except NotPositiveDefinite:
            continue
        fall = 0.5 * inner(delta, D * delta - problem.system.gradient)
        if np.isfinite(fall):
            return _Step(delta, max(fall, 0.0), D)
    return _Step(np.zeros_like(scale), math.inf, scale)


def _trend(costs: Sequence[float]) -> float:
    """The sum of a geometric sequence of falls, of which two windows are known; the least that windows of some lengths say.

    Where falls shrink faster from one to the next, long windows still see the large ones of long ago.
    """
    longest = min(_WINDOW, (len(costs) - 1) // 2)
    if longest < _LEAST:
        return 0.0
    return min(_sum_of_falls(costs, window) for window in range(_SHORTEST, longest + 1))


def _sum_of_falls(costs: Sequence[float], window: int) -> float:
    before, middle, now = (costs[-1 - 2 * window], costs[-1 - window], costs[-1])
    early, late = before - middle, middle - now
    if not (np.isfinite(early) and 0.0 < late < early):  # falls that grow are no sequence: the way has only begun
        return 0.0
    shrinks = min(late / early, _SLOWEST)
    return late * shrinks / (1.0 - shrinks)
