"""How far each variable, and what each residual sees, is from where a step leads, in standard deviations of its own.

With the columns A of a variable or of a row of a residual it is √(uᵀ (Aᵀ C A)⁻¹ u), u = Aᵀδ, in the direction of its own in which
that is most; C is the covariance of the variables. No covariance is computed for that: (H + D)⁻¹ Jᵀz of a normal z has the
covariance (H + D)⁻¹ H (H + D)⁻¹, which is H⁻¹ where the damping D is far below H, and some of these show that of all variables at
once, each but for the scatter of a χ² (Papandreou and Yuille, NIPS 2010). What a variable scatters by where all others are known
need not be sampled: it is the inverse of its own block of H + D, and b = Jᵀz tells how much of a sample is that (Sidén et al.,
JCGS 2018). Along directions that nothing measures D makes that inverse large: they count as unknown.

A solve that was ended early is mostly far off, and that takes little to see: after a few samples the variables that seem to be
farthest are looked at exactly, with a solve for each of their degrees of freedom. One beyond a standard deviation decides. Else
samples are drawn until few are left of which it is open on which side of one they lie, and more are looked at.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_quantile
from boxplus.optimization.linear_systems.least_squares import LeastSquares
from boxplus.optimization.minimizers.gauge import find_gauge

AWAY = 1.0  # standard deviations
_SAMPLES = (10, 20, 30, 30, 30)  # of C, round by round; the first, beyond the degrees of freedom of the largest variable
_AT_ONCE = 8  # samples that are solved for together
_SURE = 3.0  # standard deviations of an estimate, by which it has to be beyond one
_CHANCE = 1e-4  # that an estimate scatters by as much, for one that is counted
_GLANCES, _LOOKS = 2, 16  # variables that are looked at exactly in a round; variables, and residuals, at the end
_SEEN = 3  # that are looked at once one is known to be far, to name one that is among the farthest
_FLAT = 1e-12  # share of the variances, for a direction without any
_SEES_NOTHING = 1e-9  # standard deviation of a whitened residual's prediction that is rounding


@dataclass(slots=True, eq=False)
class _Part:
    """The free variables of a block, or the rows of a group as variables of one degree of freedom.

    Attributes:
        first: where they begin in the tangents, or in the rows of all groups.
        u: (n, dof) along the step.
        gain: (n, dof, dof) times b is what a variable of a sample would be were the others at zero; of rows zero.
        alone: (n, dof, dof) its covariance were the others known; of rows zero.
        damping: (n, dof); of rows zero.
        is_asked: (n,).
        sums: (n, dof, dof) of the products of what is left of samples.
        away: (n,) distances. is_exact: (n,). is_far: (n,) which are farther than one whatever the samples scatter.
    """

    is_rows: bool
    first: int
    u: NDArray[np.float64]
    gain: NDArray[np.float64]
    alone: NDArray[np.float64]
    damping: NDArray[np.float64]
    is_asked: NDArray[np.bool_]
    sums: NDArray[np.float64]
    away: NDArray[np.float64]
    is_exact: NDArray[np.bool_]
    is_far: NDArray[np.bool_]

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
        far_variables, far_residuals: how many of each are farther than one whatever the samples scatter.
        worst_variable: block and row of the farthest that was looked at, whose distance is exact; None where that is within one.
        worst_residual: group and residual likewise, where no variable is farther than one.
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
            u, D, kept = moved[own].reshape(-1, dof), damping[own].reshape(-1, dof), self._gauge.kept(own, dof)
            gain = kept @ _inverse(H, D)
            blocks.append(_part(False, first, u, gain, gain @ kept.transpose(0, 2, 1), D, ~left_out[free]))
        is_out = np.append(left_out, False)  # the last stands for fixed ones, −1
        for group in problem.groups:
            asked = ~np.any([is_out[layout.numbers(c)] for c in group.connections], axis=0)
            u = seen[begin : begin + group.r.size, None]
            none = np.zeros((len(u), 1, 1))
            groups.append(_part(True, begin, u, none, none, none[:, 0], np.repeat(asked, group.residual.dim)))
            begin += group.r.size
        worst = self._search(blocks, groups, len(seen))
        self.worst_variable = None if worst is None else (worst[0], int(np.flatnonzero(layout.number[worst[0]] >= 0)[worst[1]]))
        worst = self._look(groups, _LOOKS) if worst is None else None
        self.worst_residual = None if worst is None else (worst[0], worst[1] // problem.groups[worst[0]].residual.dim)
        self.variables = tuple(np.zeros(len(number)) for number in layout.number)
        for away, number, part in zip(self.variables, layout.number, blocks, strict=True):
            away[number >= 0] = part.away
        self.far_variables = tuple(int(np.count_nonzero(part.is_far)) for part in blocks)
        self.far_residuals = tuple(
            int(np.count_nonzero(part.is_far.reshape(group.r.shape).any(axis=1)))
            for group, part in zip(problem.groups, groups, strict=True)
        )
        self.residuals = tuple(
            part.away.reshape(group.r.shape).max(axis=1, initial=0.0) for group, part in zip(problem.groups, groups, strict=True)
        )

    def _search(self, blocks: Sequence[_Part], groups: Sequence[_Part], rows: int) -> tuple[int, int] | None:
        """Draw samples until one variable is known to be far, or hardly any can be: block and number of that."""
        rng, drawn, parts = np.random.default_rng(0), 0, [*blocks, *groups]
        for number, count in enumerate(_SAMPLES):
            more = count if number else count + max(part.u.shape[1] for part in parts)
            for first in range(0, more, _AT_ONCE):
                self._draw(parts, rng.standard_normal((min(_AT_ONCE, more - first), rows)))
            drawn += more
            is_open = sum(self._estimate(part, drawn) for part in parts)
            worst = self._look(blocks, _GLANCES)
            if worst is not None:
                return worst
            if number and is_open <= _LOOKS:
                break
        return self._look(blocks, _LOOKS)

    def _draw(self, parts: Sequence[_Part], z: NDArray[np.float64]) -> None:
        """Add the samples of z (k, rows of all groups) to the sums."""
        sides = np.stack([self._problem.transposed_product(one) for one in z])
        for b, x in zip(sides, np.ascontiguousarray(self._problem.system.solve_many(sides.T).T), strict=True):
            moved, seen = self._gauge.remove(x), self._problem.product(x)
            for part in parts:
                if part.is_rows:
                    mine = seen[part.places].reshape(part.u.shape)
                else:
                    own = b[part.places].reshape(part.u.shape)
                    mine = moved[part.places].reshape(part.u.shape) - np.einsum("nij,nj->ni", part.gain, own)
                part.sums += mine[:, :, None] * mine[:, None, :]

    def _estimate(self, part: _Part, drawn: int) -> int:
        """Distances by so many samples, but those that are exact; how many of them may lie on either side of one."""
        # Of K samples, uᵀ S⁻¹ u K is that of the covariance over a χ² of K − dof + 1 over K.
        freedom = drawn - part.u.shape[1] + 1
        away = np.minimum(_distance(part.sums / freedom + part.alone, part.u, _least(part)), self._total)
        part.away[:] = np.where(part.is_exact, part.away, np.where(part.is_asked, away, 0.0))
        most = math.sqrt(freedom / chi_square_quantile(_CHANCE, freedom))
        part.is_far[:] = part.away > AWAY * np.where(part.is_exact, 1.0, most)
        sure = part.is_exact | (part.away / (1.0 + _SURE / math.sqrt(2.0 * freedom)) > AWAY)
        return int(np.count_nonzero((part.away > AWAY) & ~sure))

    def _look(self, parts: Sequence[_Part], most: int) -> tuple[int, int] | None:
        """Replace what seems farthest by what it is, until that is the farthest, or enough was looked at.

        Returns:
            Part and number of the farthest whose distance is exact; None where that is within one.
        """
        for look in range(most):
            seems = _farthest([part.away for part in parts])
            known = _farthest([np.where(part.is_exact, part.away, 0.0) for part in parts])
            if seems is None or seems == known or (known is not None and look >= _SEEN):
                return known
            part, number = parts[seems[0]], seems[1]
            part.away[number], part.is_exact[number] = min(self._exact(part, number), self._total), True
            part.is_far[number] = part.away[number] > AWAY
        return _farthest([np.where(part.is_exact, part.away, 0.0) for part in parts])

    def _exact(self, part: _Part, number: int) -> float:
        dof, gain = part.u.shape[1], part.gain[number]
        rows = sum(group.r.size for group in self._problem.groups)
        units = np.zeros((dof, rows if part.is_rows else self._problem.layout.dof))
        units[np.arange(dof), part.first + number * dof + np.arange(dof)] = 1.0
        read = self._problem.transposed_product if part.is_rows else self._gauge.transposed
        moved = self._problem.system.solve_many(np.stack([read(unit) for unit in units], axis=1))
        seen = [self._problem.product(x) for x in np.ascontiguousarray(moved.T)]
        covariance = np.einsum("ik,jk->ij", seen, seen) + gain * part.damping[number] @ gain.T
        return float(_distance(covariance[None], part.u[None, number], _least(part))[0])


def _part(
    is_rows: bool,
    first: int,
    u: NDArray[np.float64],
    gain: NDArray[np.float64],
    alone: NDArray[np.float64],
    damping: NDArray[np.float64],
    is_asked: NDArray[np.bool_],
) -> _Part:
    known = np.zeros(len(u)), np.zeros(len(u), dtype=np.bool_), np.zeros(len(u), dtype=np.bool_)
    return _Part(is_rows, first, u, gain, alone, damping, is_asked, np.zeros_like(alone), *known)


def _least(part: _Part) -> float:
    """Standard deviation below which something is known."""
    return _SEES_NOTHING if part.is_rows else 0.0


def _farthest(away: Sequence[NDArray[np.float64]]) -> tuple[int, int] | None:
    """Part and number; None where it is within one."""
    farthest = [float(one.max(initial=0.0)) for one in away]
    worst = int(np.argmax(farthest))
    return (worst, int(np.argmax(away[worst]))) if farthest[worst] > AWAY else None


def _inverse(H: NDArray[np.float64], D: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H + D)⁻¹ of blocks H (n, d, d) and D (n, d)."""
    scale = 1.0 / np.sqrt(np.einsum("kii->ki", H) + D)
    weight, axes = np.linalg.eigh((H + np.eye(D.shape[1]) * D[:, :, None]) * scale[:, :, None] * scale[:, None, :])
    return np.asarray(
        np.einsum("kij,kj,klj->kil", axes, 1.0 / np.maximum(weight, _FLAT), axes) * scale[:, :, None] * scale[:, None, :]
    )


def _distance(covariance: NDArray[np.float64], u: NDArray[np.float64], least: float) -> NDArray[np.float64]:
    """√(uᵀ C⁻¹ u) (n,) of C (n, d, d) and u (n, d); what deviates by `least`, or not at all, is known and at no distance."""
    scale = np.sqrt(np.einsum("kii->ki", covariance))
    inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > least)
    if u.shape[1] == 1:
        return np.asarray(np.abs(u * inverse)[:, 0])
    weight, axes = np.linalg.eigh(covariance * inverse[:, :, None] * inverse[:, None, :])
    along = np.einsum("kij,ki->kj", axes, u * inverse)
    squares = np.divide(along**2, weight, out=np.zeros_like(along), where=weight > _FLAT)
    return np.asarray(np.sqrt(squares.sum(axis=1)))
