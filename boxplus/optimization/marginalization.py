"""Marginalisation: variables leave a problem, what they knew stays as a prior on their neighbours (for sliding windows).

The residuals that touch the leaving variables m are linearised, r + J_m δ_m + J_b δ_b, with their Markov blanket b. Minimising
over δ_m leaves Qᵀ(r + J_b δ_b), Q spanning what J_m cannot reach. Its normal matrix is the Schur complement
H_bb − H_bm H_mm⁺ H_mb, got here from orthogonal factorisations of J, without squaring it (Demmel et al., Square root
marginalization for sliding-window bundle adjustment, ICCV 2021). A direction in which the leaving variables were not determined
takes no information with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.optimization.group import Group
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.variables import VariableRows, Variables
from boxplus.residuals.marginal_prior import MarginalPrior

_RANK = 1e-10  # share of a column's length: what is left of it below this is rounding
_Key = tuple[int, int]  # (block number, row)


@dataclass(frozen=True, slots=True)
class Marginal:
    """What marginalised variables leave behind.

    Attributes:
        residual: the prior; None where nothing is left to know (no neighbours, or no information about them).
        connections: for each of its variables the row of the block it was taken from, as `problem.add_residuals` wants them.
        absorbed: for every group of the problem, by name, (N,) which residuals are in the prior and must not be added again.
    """

    residual: MarginalPrior | None
    connections: tuple[VariableRows, ...]
    absorbed: dict[str, NDArray[np.bool_]]


def marginalize(
    problem: Problem,
    leaving: VariableRows | Variables | Sequence[VariableRows | Variables],
    *,
    at: Solution | Sequence[NDArray[np.float64]] | None = None,
) -> Marginal:
    """Marginalise variables out at a point; the problem stays as it is.

    Put the prior and the residuals that are not `absorbed` into the next problem: for linear residuals its minimum and
    covariances are those of the whole problem, else they are to first order about the point. Robust losses are weighed in as
    they are there. The work is dense in the leaving variables and their neighbours.

    Args:
        leaving: variables to remove. Of fixed ones the prior knows the values they are held at.
        at: where to linearise, normally the solution; the variables' own values otherwise.

    Raises:
        InputError: nothing is selected.
    """
    chosen = [leaving] if isinstance(leaving, (VariableRows, Variables)) else list(leaving)
    rows = [c[:] if isinstance(c, Variables) else c for c in chosen]
    gone = {(c.block.number, int(k)) for c in rows for k in c.rows}
    if not gone:
        raise InputError("variables to marginalise", "none", "select rows of a block, such as poses[[0]]")
    values = problem.values_at(at)
    touched = {group.name: _touches(group, gone) for group in problem.groups}
    system = _Stack(problem, gone, touched, values)
    J, r0 = _eliminate(system.stacked, system.leaving)
    if not len(J):
        return Marginal(None, (), touched)
    names = [f"{problem.blocks[number].name}[{row}]" for number, row in system.blanket]
    residual = MarginalPrior(
        [problem.blocks[number].manifold for number, _ in system.blanket],
        [values[number][row] for number, row in system.blanket],
        J,
        r0,
        roles=names,
        fixes_gauge=system.fixes_gauge,
    )
    return Marginal(residual, tuple(problem.blocks[number][row] for number, row in system.blanket), touched)


class _Stack:
    """The residuals that leave as one dense matrix [J_m, J_b, r].

    Attributes:
        leaving: columns of J_m.
        blanket: variables of J_b, in its order.
        fixes_gauge: whether the residuals tie their variables to the world.
    """

    def __init__(
        self, problem: Problem, gone: set[_Key], touched: dict[str, NDArray[np.bool_]], values: Sequence[NDArray[np.float64]]
    ) -> None:
        met: set[_Key] = set()
        self.fixes_gauge = False
        for group in problem.groups:
            chosen = touched[group.name]
            if not chosen.any():
                continue
            group.linearize(values, 1)
            self.fixes_gauge |= group.residual.fixes_gauge
            for c in group.connections:
                held = c.block.is_fixed[c.rows[chosen]]
                self.fixes_gauge |= bool(held.any())
                met |= {(c.block.number, int(row)) for row in np.unique(c.rows[chosen][~held])}
        self.blanket = sorted(met - gone)
        place: dict[_Key, int] = {}
        end = self.leaving = 0
        for key in [*sorted(met & gone), *self.blanket]:
            place[key] = end
            end += problem.blocks[key[0]].manifold.dof
            if key in gone:
                self.leaving = end
        parts = [_rows_of(group, touched[group.name], place, end) for group in problem.groups if touched[group.name].any()]
        self.stacked = np.concatenate(parts) if parts else np.zeros((0, end + 1))


def _touches(group: Group, gone: set[_Key]) -> NDArray[np.bool_]:
    touched = np.zeros(group.residual.count, dtype=np.bool_)
    for c in group.connections:
        is_gone = np.zeros(len(c.block), dtype=np.bool_)
        is_gone[[row for number, row in sorted(gone) if number == c.block.number]] = True
        touched |= is_gone[c.rows]
    return touched


def _rows_of(group: Group, chosen: NDArray[np.bool_], place: dict[_Key, int], end: int) -> NDArray[np.float64]:
    """[J, r] of the chosen residuals, whitened and weighed; those that could not be evaluated are zero."""
    rows = np.flatnonzero(chosen)
    stacked = np.zeros((len(rows), group.residual.dim, end + 1))
    for c, J in zip(group.connections, group.jacobians, strict=True):
        for n, row in enumerate(rows):
            at = place.get((c.block.number, int(c.rows[row])))
            if at is not None:
                stacked[n, :, at : at + J.shape[2]] += J[row]
    stacked[:, :, -1] = group.r[rows]
    return stacked.reshape(-1, end + 1)


def _eliminate(stacked: NDArray[np.float64], leaving: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(J, r₀) of the blanket after the first `leaving` columns are minimised over; as many rows as it has information."""
    from scipy.linalg import qr

    R: NDArray[np.float64] = np.asarray(
        np.linalg.qr(stacked, mode="r")
    )  # at most as many rows as columns, the same sum of squares
    first = R[:, :leaving]
    length = np.linalg.norm(first, axis=0)
    Q, triangle, _ = (np.asarray(a) for a in qr(first / np.where(length > 0.0, length, 1.0), pivoting=True))
    rest = Q[:, _rank(triangle) :].T @ R[:, leaving:]
    J, r0 = rest[:, :-1], rest[:, -1]
    # Against what was known before, so that what cancelled does not come back as information.
    length = np.linalg.norm(R[:, leaving:-1], axis=0)
    Q, triangle, order = (np.asarray(a) for a in qr(J / np.where(length > 0.0, length, 1.0), mode="economic", pivoting=True))
    rank = _rank(triangle)
    kept = np.zeros((rank, J.shape[1]))
    kept[:, order] = triangle[:rank]
    return kept * length, Q[:, :rank].T @ r0


def _rank(triangle: NDArray[np.float64]) -> int:
    return int((np.abs(np.diagonal(triangle)) > _RANK).sum())
