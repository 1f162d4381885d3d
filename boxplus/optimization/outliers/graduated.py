"""Graduated non-convexity: outliers are told from inliers without a good start (Yang, Antonante, Tzoumas and Carlone, RA-L 2020).

The residuals get fixed weights, the weighted least-squares problem is solved, and its residuals give the next weights, for a loss
that begins almost convex and becomes the one that is meant, width by width. With r in standard deviations and the threshold c,

    truncated:       w = [c √(μ(μ+1))/‖r‖ − μ] clipped to 0 … 1,  μ from c²/(2 r²_max − c²) upwards    (eqs. 13, 14)
    Geman-McClure:   w = (μ c²/(r² + μ c²))²,                     μ from 2 r²_max/c² downwards to 1    (eqs. 11, 12)

Every width is solved from the start that was given, so that a minimum in which false residuals have folded everything is left
behind with the weights that made it. Where the last minimum is lower under the new weights, for want of a good start, it is taken
up again instead.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._arguments import as_settings, choice, require, shown
from boxplus._chi_square import chi_square_quantile
from boxplus._numbers import as_floats, is_finite
from boxplus.errors import InputError
from boxplus.optimization.losses import GemanMcClure, Squared, Truncated
from boxplus.optimization.minimizers.minimize import Callback
from boxplus.optimization.outliers.inlier_report import InlierReport, inlier_report
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Iteration, Solution
from boxplus.optimization.solver_options import SolverOptions
from boxplus.optimization.terms.group import Group

GraduatedLoss = Literal["geman_mcclure", "truncated"]

_PROBABILITY = 0.99  # of an inlier to lie within the threshold, where none is given
_STEPS = 10  # tried at each width but the last; the minimum of a width only gives the next weights
_TOLERANCE = 1e-3  # relative decrease of the cost at which the next width begins
_WIDTHS = 200  # at most; with a narrowing of 1.4, for residuals of 1e14 thresholds
_WHOLE = 1.0 - 1e-3  # weights from here on count as one
_LOWER = 1.0 - 1e-3  # of the cost reached: below it the last minimum is taken up again


@dataclass(frozen=True, slots=True)
class Level:
    """One width of the loss.

    Attributes:
        mu: width; see the formulas above.
        cost: at its end, with the weights of this width.
        inliers: residuals within the threshold then, all groups together.
        undecided: residuals whose weight was neither 0 nor 1.
    """

    mu: float
    cost: float
    inliers: int
    undecided: int


@dataclass(frozen=True, slots=True)
class GraduatedSolution:
    """Result of `graduate`.

    Attributes:
        solution: the minimum under the narrowest loss; `solution[block]` gives values.
        weights: for every graduated group, by name, (N,) weights ρ′ from 0 to 1; 0 where a residual could not be evaluated.
        inliers: (N,) bool for each, residuals within the threshold.
        thresholds: for each, the length of a whitened residual that counts as an inlier at most.
        levels: the widths, from the widest on.
        reports: for each, how clear the decision was.
    """

    solution: Solution
    weights: dict[str, NDArray[np.float64]]
    inliers: dict[str, NDArray[np.bool_]]
    thresholds: dict[str, float]
    levels: tuple[Level, ...]
    reports: dict[str, InlierReport]


def graduate(
    problem: Problem,
    groups: Group | Sequence[Group],
    *,
    loss: GraduatedLoss = "geman_mcclure",
    inlier_threshold: float | None = None,
    weights: Mapping[str, ArrayLike] | None = None,
    narrowing: float = 1.4,
    options: SolverOptions | None = None,
    start: Solution | Sequence[NDArray[np.float64]] | None = None,
    callback: Callback | None = None,
    **settings: Any,
) -> GraduatedSolution:
    """Minimise with outliers among the residuals of some groups.

    The groups keep the narrowest loss, `GemanMcClure(threshold)` or `Truncated(threshold)`: later costs and covariances are those
    of the solution.

    Args:
        groups: those that may hold outliers; the others keep their losses. What is never an outlier, such as the odometry among
            the edges of a graph, belongs into a group of its own that is not given here.
        loss: what the weights come from; `truncated` takes a residual whole or not at all in the end.
        inlier_threshold: largest length of an inlier's whitened residual, in standard deviations; by default such that 99 % of
            inliers lie within, √(χ²(dim) at 0.99), which trusts the sigmas that were given.
        weights: for groups by name, (N,) from 0 to 1, of the first minimum; ones where left out. Zeros let the other groups,
            which hold no outliers, speak first: the safer way where these determine the variables, as odometry does. What begins
            with zero is taken up as soon as it fits.
        narrowing: factor between one width and the next, above 1; 1.4 in the paper. Nearer to 1 is slower and safer.
        options, settings, start: as for `Problem.solve`; the options hold for the last width, those before end early.
        callback: called with every `Iteration` of every width; returns True to stop.

    Raises:
        InputError: no group, a group of another problem, a threshold that is not positive, a narrowing that does not narrow,
            weights of another length or group; and what `Problem.solve` raises.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> measured = np.append(rng.normal(2.0, 0.1, 20), [50.0, 60.0])  # the last two are wrong
        >>> problem = bp.Problem()
        >>> x = problem.add_variables(bp.Euclidean(1), [0.0], name="x")
        >>> prior = bp.residuals.Prior(bp.Euclidean(1), measured[:, None], sigma=0.1)
        >>> group = problem.add_residuals(prior, x[np.zeros(22, int)], name="x")
        >>> np.flatnonzero(~bp.graduate(problem, group).inliers["x"])
        array([20, 21])
    """
    require(problem, Problem, "a Problem", "make one with boxplus.Problem()")
    chosen = [groups] if isinstance(groups, Group) else list(groups) if isinstance(groups, Iterable) else []
    if not chosen or not all(any(group is own for own in problem.groups) for group in chosen):
        raise InputError("groups of this problem", shown(groups), "give what `add_residuals` returned")
    if not (is_finite(narrowing) and narrowing > 1.0):
        raise InputError("a narrowing above 1", shown(narrowing), "leave it at 1.4")
    choice(loss, ("geman_mcclure", "truncated"), "the loss")
    last = as_settings(SolverOptions, options, settings)
    first = _first_weights(chosen, weights)
    widths = _Widths(problem, chosen, inlier_threshold, last, problem.values_at(start), callback)
    try:
        levels = widths.narrow(loss, first, narrowing)
    finally:
        for group in chosen:
            problem.set_weights(group, None)
    make = Truncated if loss == "truncated" else GemanMcClure
    for group in chosen:
        group.set_loss(make(widths.thresholds[group.name]))
    final = last.model_copy(update={"max_iterations": 0}) if widths.is_stopped else last
    solution = problem.solve(final, start=widths.solution, callback=callback)
    squares = {group.name: group.squares(solution.values) for group in chosen}
    inliers = {name: s <= widths.thresholds[name] ** 2 for name, s in squares.items()}
    if levels:  # the last width ends at the minimum
        within = sum(int(np.count_nonzero(own)) for own in inliers.values())
        levels[-1] = replace(levels[-1], cost=solution.cost, inliers=within)
    return GraduatedSolution(
        solution,
        {group.name: group.loss_weights(solution.values) for group in chosen},
        inliers,
        widths.thresholds,
        tuple(levels),
        {g.name: inlier_report(squares[g.name], g.residual.dim, widths.thresholds[g.name]) for g in chosen},
    )


class _Widths:
    """Solves the weighted problems of one graduation; residuals of all its groups stand one after the other."""

    def __init__(
        self,
        problem: Problem,
        groups: list[Group],
        threshold: float | None,
        options: SolverOptions,
        start: list[NDArray[np.float64]],
        callback: Callback | None,
    ) -> None:
        self.thresholds = {group.name: _threshold(group, threshold) for group in groups}
        self.solution: Solution | None = None
        self.is_stopped = False
        self._problem, self._groups, self._start, self._callback = problem, groups, start, callback
        self._ends = np.cumsum([group.residual.count for group in groups])[:-1]
        limits = {
            "max_iterations": min(_STEPS, options.max_iterations),
            "cost_tolerance": max(_TOLERANCE, options.cost_tolerance),
        }
        self._early = options.model_copy(update=limits)

    def narrow(self, loss: GraduatedLoss, first: NDArray[np.float64], narrowing: float) -> list[Level]:
        """Width after width until all weights are decided (truncated), or the loss is that which is meant (Geman-McClure)."""
        truncated = loss == "truncated"
        for group in self._groups:
            group.set_loss(Squared())
        before = self._ratios(self._start)
        ratios, cost = self._solve(first)
        worst = max(float(r[np.isfinite(r)].max(initial=0.0)) for r in (before, ratios))
        if truncated and worst <= 1.0:
            return []  # no outlier to look for
        mu = 1.0 / (2.0 * worst - 1.0) if truncated else max(2.0 * worst, 1.0)
        levels: list[Level] = []
        while len(levels) < _WIDTHS and not self.is_stopped:
            if truncated:
                with np.errstate(divide="ignore"):
                    weights = np.clip(math.sqrt(mu * (mu + 1.0)) / np.sqrt(ratios) - mu, 0.0, 1.0)
            else:
                weights = (mu / (mu + ratios)) ** 2
            ratios, cost = self._solve(weights)
            # At the widest, all weights are small, but those of far residuals alone are zero.
            undecided = int(np.count_nonzero((weights > 0.0) & (weights < _WHOLE)))
            levels.append(Level(mu, cost, int(np.count_nonzero(ratios <= 1.0)), undecided))
            if undecided == 0 if truncated else mu == 1.0:
                break
            mu = mu * narrowing if truncated else max(mu / narrowing, 1.0)
        return levels

    def _solve(self, weights: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        """‖W r‖²/c² (N,) of all residuals at the minimum with these weights, and its cost."""
        for group, own in zip(self._groups, np.split(weights, self._ends), strict=True):
            self._problem.set_weights(group, own)
        found = self._problem.solve(self._early, start=self._start, callback=self._watch)
        if self.solution is not None and not self.is_stopped and self._problem.cost(self.solution) < _LOWER * found.cost:
            again = self._problem.solve(self._early, start=self.solution, callback=self._watch)
            found = again if again.cost < found.cost else found
        self.solution = found
        return self._ratios(found.values), found.cost

    def _ratios(self, values: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        """‖W r‖²/c² (N,) of all residuals at a point."""
        return np.concatenate([g.squares(values) / self.thresholds[g.name] ** 2 for g in self._groups])

    def _watch(self, iteration: Iteration) -> bool:
        self.is_stopped = self.is_stopped or (self._callback is not None and bool(self._callback(iteration)))
        return self.is_stopped


def _first_weights(groups: list[Group], given: Mapping[str, ArrayLike] | None) -> NDArray[np.float64]:
    given = given if given is not None else {}
    require(given, Mapping, "weights by the name of their group", 'write e.g. {"loops": np.zeros(12)}')
    foreign = set(given) - {group.name for group in groups}
    if foreign:
        raise InputError("weights of graduated groups", f"{sorted(foreign)}", "name groups that are graduated")
    parts = []
    for group in groups:
        own = as_floats(given.get(group.name, np.ones(group.residual.count)), f"weights of {group.name}")
        if own.shape != (group.residual.count,) or not ((own >= 0.0) & (own <= 1.0)).all():
            raise InputError(f"weights ({group.residual.count},) from 0 to 1 of {group.name}", f"shape {own.shape}", "scale them")
        parts.append(own)
    return np.concatenate(parts)


def _threshold(group: Group, given: float | None) -> float:
    if given is None:
        return math.sqrt(chi_square_quantile(_PROBABILITY, group.residual.dim))
    if not (is_finite(given) and given > 0.0):
        raise InputError(
            "a positive inlier threshold", shown(given), "give it in standard deviations of the residual, such as 3.0"
        )
    return float(given)
