"""How far each variable, and what each residual sees, is from where a step leads, in standard deviations of its own.

With the columns A of a variable or of a row of a residual it is √(uᵀ (Aᵀ C A)⁻¹ u), u = Aᵀδ, in the direction of its own in which
that is most; C is the covariance of the variables. No covariance is computed for that: (H + D)⁻¹ Jᵀz of a normal z has the
covariance (H + D)⁻¹ H (H + D)⁻¹, which is H⁻¹ where the damping D is far below H, and some of these show that of all variables at
once, each but for the scatter of a χ² (Papandreou and Yuille, NIPS 2010). Where D is not, as along directions that nothing
measures, samples hardly move: a variable's own curvature tells which of its directions these are; they count as unknown.

Samples are drawn until few are left of which it is open on which side of one they lie, and those that seem farthest off are
looked at exactly, with a solve for each of their degrees of freedom.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.linear_systems.least_squares import LeastSquares
from boxplus.optimization.minimizers.gauge import find_gauge

AWAY = 1.0  # standard deviations
_SAMPLES, _ROUNDS = 30, 4  # of C, beyond the degrees of freedom of the largest variable; how many times as many at most
_SURE = 3.0  # standard deviations of an estimate, by which it has to be beyond one
_LOOKS = 16  # variables and residuals that are looked at exactly: of all blocks, and of all groups, together
_FLAT = 1e-12  # share of the variances, for a direction without any
_SEES_NOTHING = 1e-9  # standard deviation of a whitened residual's prediction that is rounding


@dataclass(slots=True, eq=False)
class _Part:
    """The free variables of a block, or the rows of a group as variables of one degree of freedom.

    Attributes:
        first: where they begin in the tangents, or in the rows of all groups.
        u: (n, dof) along the step.
        unknown: (n, dof, dof) covariance of directions that are not measured.
        is_asked: (n,).
        sums: (n, dof, dof) of the samples' products.
        away: (n,) distances. is_exact: (n,).
    """

    is_rows: bool
    first: int
    u: NDArray[np.float64]
    unknown: NDArray[np.float64]
    is_asked: NDArray[np.bool_]
    sums: NDArray[np.float64]
    away: NDArray[np.float64]
    is_exact: NDArray[np.bool_]

    @property
    def places(self) -> slice:
        """Of all of them."""
        return slice(self.first, self.first + self.u.size)


class Distances:
    """Distances to where `way` (dof,) leads, in standard deviations at unit variance.

    Args:
        problem: linearised at the accepted point, with H + diag(damping) factorised.
        total: distance of all variables together; none is farther.
        left_out: (free variables,) which are not asked, nor what residuals see of them.

    Attributes:
        variables: for every block (n,); zero where fixed or left out.
        residuals: for every group (N,); each row of a residual by itself, and the farthest.
        worst_variable: block and row of the farthest, whose distance is exact; None where that is within one.
        worst_residual: group and residual of the farthest, where no variable is farther than one.
    """

    def __init__(
        self,
        problem: LeastSquares,
        way: NDArray[np.float64],
        damping: NDArray[np.float64],
        total: float,
        left_out: NDArray[np.bool_],
    ) -> None:
        self._problem, self._total = problem, total
        curvatures = problem.own_curvatures()
        self._gauge = find_gauge(problem, curvatures)
        layout = problem.layout
        moved, seen = self._gauge.remove(way), problem.product(way)
        blocks, groups, begin = [], [], 0
        for block, number, H in zip(layout.blocks, layout.number, curvatures, strict=True):
            free, dof = number[number >= 0], block.manifold.dof
            first = int(layout.start[free[0]]) if len(free) else 0
            own = slice(first, first + len(free) * dof)
            unknown = _of_the_damping(H, damping[own].reshape(-1, dof))
            blocks.append(_part(False, first, moved[own].reshape(-1, dof), unknown, ~left_out[free]))
        is_out = np.append(left_out, False)  # the last stands for fixed ones, −1
        for group in problem.groups:
            asked = ~np.any([is_out[layout.numbers(c)] for c in group.connections], axis=0)
            u = seen[begin : begin + group.r.size, None]
            groups.append(_part(True, begin, u, np.zeros((len(u), 1, 1)), np.repeat(asked, group.residual.dim)))
            begin += group.r.size
        self._sample([*blocks, *groups], len(seen))
        worst = self._look(blocks)
        self.worst_variable = None if worst is None else (worst[0], int(np.flatnonzero(layout.number[worst[0]] >= 0)[worst[1]]))
        worst = self._look(groups) if worst is None else None
        self.worst_residual = None if worst is None else (worst[0], worst[1] // problem.groups[worst[0]].residual.dim)
        self.variables = tuple(np.zeros(len(number)) for number in layout.number)
        for away, number, part in zip(self.variables, layout.number, blocks, strict=True):
            away[number >= 0] = part.away
        self.residuals = tuple(
            part.away.reshape(group.r.shape).max(axis=1, initial=0.0) for group, part in zip(problem.groups, groups, strict=True)
        )

    def _sample(self, parts: Sequence[_Part], rows: int) -> None:
        rng, drawn = np.random.default_rng(0), 0
        for count in [_SAMPLES + max(part.u.shape[1] for part in parts)] + [_SAMPLES] * (_ROUNDS - 1):
            for _ in range(count):
                x = self._problem.system.solve(self._problem.transposed_product(rng.standard_normal(rows)))
                sampled = (self._gauge.remove(x), self._problem.product(x))
                for part in parts:
                    mine = sampled[part.is_rows][part.places].reshape(part.u.shape)
                    part.sums += mine[:, :, None] * mine[:, None, :]
            drawn += count
            is_open = 0
            for part in parts:
                # Of K samples, uᵀ S⁻¹ u K is that of the covariance over a χ² of K − dof + 1 over K.
                freedom = drawn - part.u.shape[1] + 1
                away = _distance(part.sums / freedom + part.unknown, part.u, _SEES_NOTHING if part.is_rows else 0.0)
                away = part.away[:] = np.where(part.is_asked, np.minimum(away, self._total), 0.0)
                sure = away / (1.0 + _SURE / math.sqrt(2.0 * freedom)) > AWAY
                is_open += int(np.count_nonzero((away > AWAY) & ~sure))
            if is_open <= _LOOKS:
                return

    def _look(self, parts: Sequence[_Part]) -> tuple[int, int] | None:
        """Replace what seems farthest by what it is, until that is the farthest, or enough was looked at: part and number."""
        for _ in range(_LOOKS):
            worst = _farthest([part.away for part in parts])
            if worst is None or parts[worst[0]].is_exact[worst[1]]:
                return worst
            part, number = parts[worst[0]], worst[1]
            part.away[number], part.is_exact[number] = min(self._exact(part, number), self._total), True
        return _farthest([np.where(part.is_exact, part.away, 0.0) for part in parts])

    def _exact(self, part: _Part, number: int) -> float:
        seen, dof = [], part.u.shape[1]
        for place in part.first + number * dof + np.arange(dof):
            unit = np.zeros(sum(group.r.size for group in self._problem.groups) if part.is_rows else self._problem.layout.dof)
            unit[place] = 1.0
            unit = self._problem.transposed_product(unit) if part.is_rows else self._gauge.transposed(unit)
            seen.append(self._problem.product(self._problem.system.solve(unit)))
        covariance = np.einsum("ik,jk->ij", seen, seen) + part.unknown[number]
        return float(_distance(covariance[None], part.u[None, number], _SEES_NOTHING if part.is_rows else 0.0)[0])


def _part(is_rows: bool, first: int, u: NDArray[np.float64], unknown: NDArray[np.float64], is_asked: NDArray[np.bool_]) -> _Part:
    return _Part(is_rows, first, u, unknown, is_asked, np.zeros_like(unknown), np.zeros(len(u)), np.zeros(len(u), dtype=np.bool_))


def _farthest(away: Sequence[NDArray[np.float64]]) -> tuple[int, int] | None:
    """Part and number; None where it is within one."""
    farthest = [float(one.max(initial=0.0)) for one in away]
    worst = int(np.argmax(farthest))
    return (worst, int(np.argmax(away[worst]))) if farthest[worst] > AWAY else None


def _of_the_damping(H: NDArray[np.float64], D: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H + D)⁻¹ D (H + D)⁻¹ of blocks H (n, d, d) and D (n, d): variance where the damping holds more than residuals measure.

    Such directions have no way to go, and would seem known, as samples do not move along them.
    """
    scale = 1.0 / np.sqrt(np.einsum("kii->ki", H) + D)
    weight, axes = np.linalg.eigh((H + np.eye(D.shape[1]) * D[:, :, None]) * scale[:, :, None] * scale[:, None, :])
    inverse = np.einsum("kij,kj,klj->kil", axes, 1.0 / np.maximum(weight, _FLAT), axes) * scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.einsum("kij,kj,klj->kil", inverse, D, inverse))


def _distance(covariance: NDArray[np.float64], u: NDArray[np.float64], least: float) -> NDArray[np.float64]:
    """√(uᵀ C⁻¹ u) (n,) of C (n, d, d) and u (n, d); what deviates by `least`, or not at all, is known and at no distance."""
    scale = np.sqrt(np.einsum("kii->ki", covariance))
    inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > least)
    weight, axes = np.linalg.eigh(covariance * inverse[:, :, None] * inverse[:, None, :])
    along = np.einsum("kij,ki->kj", axes, u * inverse)
    squares = np.divide(along**2, weight, out=np.zeros_like(along), where=weight > _FLAT)
    return np.asarray(np.sqrt(squares.sum(axis=1)))
