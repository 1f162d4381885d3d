"""Graduated non-convexity: outliers are told from inliers without a good start (Yang, Antonante, Tzoumas and Carlone, RA-L 2020).

The loss of Geman and McClure is first made so wide that the cost is almost least squares, ρ_μ = μ c² s/(μ c² + s) with μ ≫ 1, and
then narrowed step by step to μ = 1, each minimum being the start of the next. ρ_μ is the same loss with the scale √μ c.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.optimization.group import Group
from boxplus.optimization.losses import GemanMcClure, Squared
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.solver_options import SolverOptions

_PROBABILITY = 0.99  # of an inlier to lie within the threshold, where none is given
_STEPS = 10  # tried at each width but the last; the minimum of a width is only the start of the next
_TOLERANCE = 1e-4  # relative decrease of the cost at which the next width begins


@dataclass(frozen=True, slots=True)
class Level:
    """One width of the loss.

    Attributes:
        mu: width; the scale of the loss is √μ times the threshold.
        cost: at its end, under this loss.
        inliers: residuals within the threshold then, all groups together.
    """

    mu: float
    cost: float
    inliers: int


@dataclass(frozen=True, slots=True)
class GraduatedSolution:
    """Result of `graduate`.

    Attributes:
        solution: the minimum under the narrowest loss; `solution[block]` gives values.
        weights: for every graduated group, by name, (N,) weights ρ′ from 0 to 1; 0 where a residual could not be evaluated.
        inliers: (N,) bool for each, residuals within the threshold.
        thresholds: for each, the length of a whitened residual that counts as an inlier at most.
        levels: the widths, from the widest on.
    """

    solution: Solution
    weights: dict[str, NDArray[np.float64]]
    inliers: dict[str, NDArray[np.bool_]]
    thresholds: dict[str, float]
    levels: tuple[Level, ...]


def graduate(
    problem: Problem,
    groups: Group | Sequence[Group],
    *,
    inlier_threshold: float | None = None,
    narrowing: float = 1.4,
    options: SolverOptions | None = None,
    start: Solution | Sequence[NDArray[np.float64]] | None = None,
    **settings: Any,
) -> GraduatedSolution:
    """Minimise with outliers among the residuals of some groups.

    The groups keep the loss of the last width, `GemanMcClure(threshold)`: later costs and covariances are those of the solution.

    Args:
        groups: those that may hold outliers; the others keep their losses.
        inlier_threshold: largest length of an inlier's whitened residual, in standard deviations; by default such that 99 % of
            inliers lie within, √(χ²(dim) at 0.99), which trusts the sigmas that were given.
        narrowing: factor between one width and the next, above 1; 1.4 in the paper. Nearer to 1 is slower and safer.
        options, settings, start: as for `Problem.solve`; the options hold for the last width, those before end early.

    Raises:
        InputError: no group, a group of another problem, a threshold that is not positive, a narrowing that does not narrow;
            and what `Problem.solve` raises.
    """
    chosen = [groups] if isinstance(groups, Group) else list(groups)
    if not chosen or not all(any(group is own for own in problem.groups) for group in chosen):
        raise InputError("groups of this problem", f"{chosen}", "give what `add_residuals` returned")
    if not (math.isfinite(narrowing) and narrowing > 1.0):
        raise InputError("a narrowing above 1", f"{narrowing}", "leave it at 1.4")
    if options is not None and settings:
        raise InputError("options or single settings", "both", "put the settings into the options")
    thresholds = {group.name: _threshold(group, inlier_threshold) for group in chosen}
    last = options if options is not None else SolverOptions(**settings)
    early = last.model_copy(
        update={"max_iterations": min(_STEPS, last.max_iterations), "cost_tolerance": max(_TOLERANCE, last.cost_tolerance)}
    )
    for group in chosen:
        group.set_loss(Squared())
    solution = problem.solve(early, start=start)
    squares = _squares(chosen, solution)
    ratios = np.concatenate([squares[group.name] / thresholds[group.name] ** 2 for group in chosen])
    mu = max(2.0 * float(ratios[np.isfinite(ratios)].max(initial=0.0)), 1.0)
    levels = []
    while True:
        for group in chosen:
            group.set_loss(GemanMcClure(math.sqrt(mu) * thresholds[group.name]))
        solution = problem.solve(last if mu == 1.0 else early, start=solution)
        squares = _squares(chosen, solution)
        within = sum(int((squares[g.name] <= thresholds[g.name] ** 2).sum()) for g in chosen)
        levels.append(Level(mu, solution.cost, within))
        if mu == 1.0:
            break
        mu = max(mu / narrowing, 1.0)
    weights, inliers = {}, {}
    for group in chosen:
        s, c2 = squares[group.name], thresholds[group.name] ** 2
        weights[group.name] = np.where(np.isfinite(s), (c2 / (c2 + s)) ** 2, 0.0)
        inliers[group.name] = s <= c2
    return GraduatedSolution(solution, weights, inliers, thresholds, tuple(levels))


def _threshold(group: Group, given: float | None) -> float:
    from scipy.stats import chi2

    if given is None:
        return math.sqrt(float(chi2.ppf(_PROBABILITY, group.residual.dim)))
    if not (math.isfinite(given) and given > 0.0):
        raise InputError("a positive inlier threshold", f"{given}", "give it in standard deviations of the residual, such as 3.0")
    return float(given)


def _squares(groups: Sequence[Group], at: Solution) -> dict[str, NDArray[np.float64]]:
    """‖W r‖² (N,) of every group, infinite where a residual cannot be evaluated."""
    found = {}
    for group in groups:
        loss = group.loss
        group.set_loss(Squared())
        group.evaluate(at.values, 1)
        found[group.name] = np.where(group.valid, (group.r**2).sum(axis=1), np.inf)
        group.set_loss(loss)
    return found
