"""How far from its minimum a solve ended that a limit stopped, or that found no step down.

Where the steps are those of Gauss-Newton, the next one δ tells: its model falls by ½ gᵀH⁻¹g, and √(gᵀH⁻¹g) is the distance to the
minimum in standard deviations of the variables, all together. Where the cost does not follow the model, as along the depths of
points that are as good as infinitely far, the step is damped until it does. Where residuals are large the steps shrink by the
same factor again and again, and are each a small part of the way: then the fall of the cost over the last ones tells more, if
there were some.

All together, many variables are far off where each of them is as good as at the minimum. So each is asked by itself, and each
residual what it sees: relative poses, say, which are known better than the poses. With the columns A of a variable or a residual,
it is √(uᵀ (AᵀH⁻¹A)⁻¹ u) standard deviations off, u = Aᵀδ, in the direction of its own in which that is most. No covariance is
computed for that: H⁻¹Jᵀz of a normal z has the covariance H⁻¹, and some of these show those of all variables at once, each but
for the scatter of a χ² (Papandreou and Yuille, NIPS 2010). Those that seem farthest off are then looked at exactly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.linear_systems.least_squares import LeastSquares, inner
from boxplus.optimization.minimizers.strategy import step_scale
from boxplus.optimization.terms.variables import VariableRows
from boxplus.sparse.cholesky import NotPositiveDefinite

AWAY = 1.0  # standard deviations
_DAMPING = (1e-8, 1e-6, 1e-4, 1e-2, 1.0)  # share of diag(H): directions that nothing measures have no way to go
_FOLLOWS = 0.5  # least share of its model's fall by which the cost falls where it follows it
_SHORTEST, _WINDOW = 2, 5  # steps, whose fall of the cost is compared with that of as many before
_LEAST = 3  # of them that twice as many steps must allow, to see a sequence
_SLOWEST = 0.98  # of the fall from one window to the next; a slower one would sum up to anything
_NOISE = 0.1  # of the standard deviations that were given: less noise than that is not presumed
_SAMPLES = 30  # of H⁻¹
_EXACT, _CERTAIN = 2, 3.0  # variables of a block, and residuals of a group, that are looked at exactly; from where samples do
_FLAT = 1e-12  # share of the variances, for a direction without any
_SEES_NOTHING = 1e-9  # standard deviation of a whitened residual's prediction that is rounding


@dataclass(frozen=True, slots=True)
class Remainder:
    """What lies between a point and the minimum.

    Attributes:
        cost: by how much the cost would still fall.
        total: distance in standard deviations, all variables together: it grows with their number.
        variables: for every block (n,) the distance of each in standard deviations of its own, with the noise that the errors
            have; zero where fixed. From one to three those that are farthest are exact, the others scatter by a fifth.
        residuals: for every group (N,) the same of what each residual sees.
    """

    cost: float
    total: float
    variables: tuple[NDArray[np.float64], ...]
    residuals: tuple[NDArray[np.float64], ...]


def find_remainder(problem: LeastSquares, costs: Sequence[float]) -> Remainder | None:
    """None where the minimum is nearer than noise puts it itself.

    Args:
        problem: linearised at the accepted point.
        costs: at the accepted point after every step of the descent that led there, the start's first.
    """
    trend = _trend(costs)
    step = _next_step(problem)
    remaining = max(step.fall, trend)
    total = math.sqrt(2.0 * remaining / _variance(problem, remaining))
    if not total > AWAY:
        return None
    if step.delta is None or not step.fall > 0.0:
        everywhere = [np.where(number >= 0, total, 0.0) for number in problem.layout.number]
        return Remainder(remaining, total, tuple(everywhere), tuple(np.zeros(len(group.r)) for group in problem.groups))
    way = step.delta * math.sqrt(remaining / (step.fall * _variance(problem, remaining)))
    distances = _Distances(problem, way, step.damping)
    return Remainder(remaining, total, distances.of_variables(), distances.of_residuals())


def _variance(problem: LeastSquares, remaining: float) -> float:
    """Of the whitened errors, at a minimum that is by `remaining` lower."""
    redundancy = sum(group.residual.dim * int(np.count_nonzero(group.counted)) for group in problem.groups) - problem.layout.dof
    return max(2.0 * (problem.cost.cost - remaining) / redundancy if redundancy > 0 else 1.0, _NOISE**2)


def leave_out(problem: LeastSquares, remainder: Remainder, rows: VariableRows) -> Remainder:
    """The same without some variables, and what residuals see of them."""
    number = problem.layout.numbers(rows)
    is_out = np.zeros(len(problem.layout.sizes) + 1, dtype=np.bool_)  # the last stands for fixed ones, −1
    is_out[number[number >= 0]] = True
    return replace(
        remainder,
        variables=tuple(
            np.where(is_out[own], 0.0, away) for own, away in zip(problem.layout.number, remainder.variables, strict=True)
        ),
        residuals=tuple(
            np.where(np.any([is_out[problem.layout.numbers(c)] for c in group.connections], axis=0), 0.0, away)
            for group, away in zip(problem.groups, remainder.residuals, strict=True)
        ),
    )


def unconverged_sentence(problem: LeastSquares, reason: str, cost: float, remainder: Remainder) -> str | None:
    """What it means that a solve ended before its minimum; None where no variable and no residual sees it.

    Args:
        reason: why it ended. cost: there.
    """
    told = []
    for block, ids, away in zip(problem.layout.blocks, problem.layout.ids, remainder.variables, strict=True):
        if away.max(initial=0.0) > AWAY:
            told.append(f"{block.name}[{ids[np.argmax(away)]}] is {_far(away)}")
    if not told:
        for group, away in zip(problem.groups, remainder.residuals, strict=True):
            if away.max(initial=0.0) > AWAY:
                worst = int(np.argmax(away))
                ends = " and ".join(f"{c.block.name}[{c.ids[worst]}]" for c in group.connections)
                told.append(f"what {group.name}[{worst}] sees of {ends} is {_far(away)}")
    if not told:
        return None
    return (
        f"no minimum was reached ({reason}): the cost of {cost:.6g} would still fall by about {remainder.cost:.3g}, and "
        f"{', '.join(told)} from there"
    )


def _far(away: NDArray[np.float64]) -> str:
    count = int(np.count_nonzero(away > AWAY))
    others = "" if count == 1 else f", and {count - 1} more of {len(away)} more than one,"
    return f"{away.max():.2g} standard deviations of its own or more away{others}"


@dataclass(frozen=True, slots=True)
class _Step:
    """A step, None where no system could be solved, by how much its model falls, and what damped it."""

    delta: NDArray[np.float64] | None
    fall: float
    damping: NDArray[np.float64]


def _next_step(problem: LeastSquares) -> _Step:
    """The least damped step that the cost follows; where it follows none, the least damped one: what is not known to be near is
    far."""
    scale, first = step_scale(problem), None
    for share in _DAMPING:
        D = share * scale
        try:
            delta = problem.solve(D)
        except NotPositiveDefinite:
            continue
        step = _Step(delta, 0.5 * inner(delta, D * delta - problem.system.gradient), D)
        first = step if first is None else first
        if 2.0 * step.fall <= AWAY**2 * _variance(problem, step.fall):  # near, whether the cost follows so far or not
            return step
        tried = problem.linearize(problem.moved(delta))
        follows = tried.lost == 0 and problem.cost.cost - tried.common >= _FOLLOWS * step.fall
        problem.linearize(problem.values)
        if follows:
            return step
    if first is None:
        return _Step(None, math.inf, scale)
    problem.factorize(first.damping)
    return first


class _Distances:
    """How far variables, and what residuals see, are from where `way` (dof,) leads, in standard deviations at unit variance.

    Args:
        problem: linearised at the accepted point, with H + diag(damping) factorised.
    """

    def __init__(self, problem: LeastSquares, way: NDArray[np.float64], damping: NDArray[np.float64]) -> None:
        self._problem, self._way = problem, way
        self._seen = problem.product(way)
        layout = problem.layout
        self._own = []
        for block, number in zip(layout.blocks, layout.number, strict=True):
            free = number[number >= 0]
            first = int(layout.start[free[0]]) if len(free) else 0
            self._own.append((number >= 0, first, len(free), block.manifold.dof))
        self._blocks = [np.zeros((count, dof, dof)) for _, _, count, dof in self._own]
        self._squares = np.zeros(len(self._seen))
        self._weak = [
            _of_the_damping(H, damping[first : first + H.shape[0] * H.shape[1]].reshape(H.shape[:2]))
            for H, (_, first, _, _) in zip(problem.own_curvatures(), self._own, strict=True)
        ]
        rng = np.random.default_rng(0)
        for _ in range(_SAMPLES):
            x = problem.system.solve(problem.transposed_product(rng.standard_normal(len(self._seen))))
            for covariance, (_, first, count, dof) in zip(self._blocks, self._own, strict=True):
                mine = x[first : first + count * dof].reshape(count, dof)
                covariance += mine[:, :, None] * mine[:, None, :]
            self._squares += problem.product(x) ** 2

    def of_variables(self) -> tuple[NDArray[np.float64], ...]:
        """See `Remainder.variables`."""
        found = []
        for sums, weak, (is_free, first, count, dof) in zip(self._blocks, self._weak, self._own, strict=True):
            u = self._way[first : first + count * dof].reshape(count, dof)
            # Of K samples, uᵀ S⁻¹ u K is that of the covariance over a χ² of K − dof + 1 over K.
            away = _distance(sums / (_SAMPLES - dof + 1) + weak, u)
            self._look_closer(away, partial(self._exact, first, weak))
            all_of_them = np.zeros(len(is_free))
            all_of_them[is_free] = away
            found.append(all_of_them)
        return tuple(found)

    def of_residuals(self) -> tuple[NDArray[np.float64], ...]:
        """See `Remainder.residuals`; each row of a residual by itself."""
        found, begin = [], 0
        for group in self._problem.groups:
            rows = slice(begin, begin + group.r.size)
            sigma, u = np.sqrt(self._squares[rows] / _SAMPLES), np.abs(self._seen[rows])
            away = np.divide(u, sigma, out=np.zeros(len(u)), where=sigma > _SEES_NOTHING)
            self._look_closer(away, partial(self._exact_row, begin))
            found.append(away.reshape(group.r.shape).max(axis=1, initial=0.0))
            begin = rows.stop
        return tuple(found)

    def _look_closer(self, away: NDArray[np.float64], exact: Callable[[int], float]) -> None:
        """Replace what is farthest by what it is exactly, until that is the farthest; nothing is told to be farther than that."""
        looked = np.zeros(len(away), dtype=np.bool_)
        for _ in range(min(_EXACT, len(away))):
            worst = int(np.argmax(away))
            if looked[worst] or not AWAY < away[worst] < _CERTAIN:
                return
            away[worst], looked[worst] = exact(worst), True
        np.minimum(away, away[looked].max(initial=0.0), out=away)

    def _exact(self, first: int, weak: NDArray[np.float64], number: int) -> float:
        """Of the free variable `number` of the block whose tangents begin at `first`."""
        dof = weak.shape[1]
        places = first + number * dof + np.arange(dof)
        seen = []
        for place in places:
            unit = np.zeros(len(self._way))
            unit[place] = 1.0
            seen.append(self._problem.product(self._problem.system.solve(unit)))
        covariance = np.array([[inner(a, b) for b in seen] for a in seen]) + weak[number]
        return float(_distance(covariance[None], self._way[None, places])[0])

    def _exact_row(self, first: int, number: int) -> float:
        """Of row `number` of the group whose rows begin at `first`."""
        unit = np.zeros(len(self._seen))
        unit[first + number] = 1.0
        sigma = math.sqrt(self._problem.curvature(self._problem.system.solve(self._problem.transposed_product(unit))))
        return float(abs(self._seen[first + number])) / sigma if sigma > _SEES_NOTHING else 0.0


def _of_the_damping(H: NDArray[np.float64], D: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H + D)⁻¹ D (H + D)⁻¹ of blocks H (n, d, d) and D (n, d): variance where the damping holds more than residuals measure.

    Such directions have no way to go, and would seem known, as samples do not move along them.
    """
    scale = 1.0 / np.sqrt(np.einsum("kii->ki", H) + D)
    weight, axes = np.linalg.eigh((H + np.eye(D.shape[1]) * D[:, :, None]) * scale[:, :, None] * scale[:, None, :])
    inverse = np.einsum("kij,kj,klj->kil", axes, 1.0 / np.maximum(weight, _FLAT), axes) * scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.einsum("kij,kj,klj->kil", inverse, D, inverse))


def _distance(covariance: NDArray[np.float64], u: NDArray[np.float64]) -> NDArray[np.float64]:
    """√(uᵀ C⁻¹ u) (n,) of C (n, d, d) and u (n, d); directions of no variance, which are known, lie at no distance."""
    scale = np.sqrt(np.einsum("kii->ki", covariance))
    inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0.0)
    weight, axes = np.linalg.eigh(covariance * inverse[:, :, None] * inverse[:, None, :])
    along = np.einsum("kij,ki->kj", axes, u * inverse)
    squares = np.divide(along**2, weight, out=np.zeros_like(along), where=weight > _FLAT)
    return np.asarray(np.sqrt(squares.sum(axis=1)))


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
