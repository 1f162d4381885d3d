"""Covariance of variables at a solution: blocks of H⁻¹, in their tangents.

Where H is singular, H⁻¹ does not exist, but the blocks of variables that no unobservable direction moves do: they are the same in
every generalised inverse of H (Rao and Mitra 1971). Holding one tangent for each direction gives one of these.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError, SingularProblemError
from boxplus.optimization.linear_systems.least_squares import LeastSquares, Values
from boxplus.optimization.observability.null_space import NullSpace, find_null_space
from boxplus.optimization.observability.singularity import explain_singularity
from boxplus.optimization.observability.variable_names import variable_names
from boxplus.optimization.terms.tangents import to_own_tangent
from boxplus.optimization.terms.variables import VariableRows
from boxplus.sparse.cholesky import NotPositiveDefinite
from boxplus.sparse.inverse_blocks import split_blocks


class Covariances:
    """H⁻¹ of a problem at one point. The first question linearises, looks for unobservable directions and factorises.

    Args:
        problem: may have been moved elsewhere since; it is then brought back.
        values: the point.
    """

    def __init__(self, problem: LeastSquares, values: Values) -> None:
        self._problem, self._values = problem, values
        self._weighting = [group.weighting for group in problem.groups]
        self._space: NullSpace | None = None
        self._factorization = -1  # of the problem, when it was that of H here

    def blocks(self, first: VariableRows, second: VariableRows, is_determined: bool = False) -> NDArray[np.float64]:
        """Blocks (k, dof of first, dof of second) of H⁻¹ for pairs of variables; zero where one of them is fixed.

        Args:
            is_determined: no direction is free, and none is looked for.

        Raises:
            InputError: `first` and `second` differ in length.
            SingularProblemError: an unobservable direction moves one of them.
        """
        if len(first) != len(second):
            raise InputError("as many second variables as first ones", f"{len(first)} and {len(second)}", "pair them")
        i, j = self._problem.layout.numbers(first), self._problem.layout.numbers(second)
        free = np.flatnonzero((i >= 0) & (j >= 0))
        self._prepare(np.concatenate([i[free], j[free]]), is_determined)
        shape = (-1, first.block.manifold.dof, second.block.manifold.dof)
        blocks = self._problem.system.inverse_values(i[free], j[free]).reshape(shape)
        if len(free) < len(first):
            known, blocks = blocks, np.zeros((len(first), *shape[1:]))
            blocks[free] = known
        to_first, to_second = self._to_own(first), self._to_own(second)
        if to_first is not None:
            blocks = to_first @ blocks
        if to_second is not None:
            blocks = blocks @ np.swapaxes(to_second, 1, 2)
        if first.block.is_held is not None or second.block.is_held is not None:
            blocks *= self._moving(first)[:, :, None] * self._moving(second)[:, None, :]
        return blocks

    def _moving(self, rows: VariableRows) -> NDArray[np.float64]:
        """(k, dof) 0 for components that are held, which are known, else 1."""
        if rows.block.is_held is None:
            return np.ones((len(rows), rows.block.manifold.dof))
        return (~rows.block.is_held[rows.rows]).astype(np.float64)

    def _to_own(self, rows: VariableRows) -> NDArray[np.float64] | None:
        number = rows.block.number
        return to_own_tangent(self._problem.layout, number, self._values[number][self._problem.layout.rows(rows)])

    def response(self, slopes: Sequence[NDArray[np.float64]], is_determined: bool = False) -> list[NDArray[np.float64]]:
        """H⁻¹ g for a gradient g with (n, dof) of every block; zero where fixed or held.

        Args:
            is_determined: no direction is free, and none is looked for.

        Raises:
            SingularProblemError: an unobservable direction moves a variable.
        """
        layout = self._problem.layout
        self._prepare(np.arange(len(layout.sizes)), is_determined)
        g, changes = np.zeros(layout.dof), []
        for block, own, number in zip(layout.blocks, slopes, layout.number, strict=True):
            rows = block[block.ids[number >= 0]]
            change, moving = self._to_own(rows), self._moving(rows)
            part = own[number >= 0] * moving
            at = layout.start[number[number >= 0], None] + np.arange(block.manifold.dof)
            g[at] = part if change is None else np.einsum("nij,ni->nj", change, part)
            changes.append((change, moving, at))
        delta = self._problem.system.solve(g)
        moved = []
        for own, number, (change, moving, at) in zip(slopes, layout.number, changes, strict=True):
            step = np.zeros(np.shape(own))
            part = delta[at] if change is None else np.einsum("nij,nj->ni", change, delta[at])
            step[number >= 0] = part * moving
            moved.append(step)
        return moved

    def joint(self, selected: Sequence[VariableRows], is_determined: bool = False) -> NDArray[np.float64]:
        """The covariance (D, D) of all selected variables together, tangent after tangent in the order given.

        Args:
            is_determined: no direction is free, and none is looked for.

        Raises:
            InputError: nothing is selected.
            SingularProblemError: an unobservable direction moves one of them.
        """
        if not selected:
            raise InputError("at least one selection of variables", "none", "give rows of a block, such as poses[[0, 3]]")
        number = np.concatenate([self._problem.layout.numbers(rows) for rows in selected])
        dof = np.concatenate([np.full(len(rows), rows.block.manifold.dof) for rows in selected])
        start = np.concatenate([[0], np.cumsum(dof)])
        free = np.flatnonzero(number >= 0)
        self._prepare(number[free], is_determined)
        matrix = np.zeros((int(start[-1]), int(start[-1])))
        a, b = (free[k] for k in np.tril_indices(len(free)))
        values = self._problem.system.inverse_values(number[a], number[b])
        for p, q, block in zip(a, b, split_blocks(values, dof[a], dof[b]), strict=True):
            matrix[start[p] : start[p + 1], start[q] : start[q + 1]] = block
            matrix[start[q] : start[q + 1], start[p] : start[p + 1]] = block.T
        first = 0
        for rows in selected:
            to_own = self._to_own(rows)
            for k, change in enumerate(to_own if to_own is not None else ()):
                here = slice(int(start[first + k]), int(start[first + k + 1]))
                matrix[here] = change @ matrix[here]
                matrix[:, here] = matrix[:, here] @ change.T
            first += len(rows)
        moving = np.concatenate([self._moving(rows).reshape(-1) for rows in selected])
        matrix *= moving[:, None] * moving
        return 0.5 * (matrix + matrix.T)

    def _prepare(self, wanted: NDArray[np.int64], is_determined: bool = False) -> None:
        """Factorise at the point, and refuse where one of the free variables `wanted` has no covariance."""
        problem = self._problem
        for group, weighting in zip(problem.groups, self._weighting, strict=True):
            if not group.is_weighed_as(*weighting):
                raise InputError(
                    "the losses and weights that the problem was solved with",
                    f"others of {group.name!r} since",
                    "ask for covariances before these are changed, or solve again, with max_iterations=0 where it is",
                )
        if is_determined and self._space is None and self._is_where_it_was_solved():
            if self._factorization == problem.factorization:
                return
            try:
                problem.factorize(None)
                self._factorization = problem.factorization
                return
            except NotPositiveDefinite:  # it is not: see why
                pass
        if problem.values is not self._values:
            problem.start(self._values)
        if self._space is None:
            self._space = find_null_space(problem)
        moved = np.unique(wanted[self._space.moves[wanted]])
        if len(moved):
            raise SingularProblemError(
                f"no covariance of {variable_names(problem.layout, moved)}: " + explain_singularity(problem, space=self._space)
            )
        if self._factorization == problem.factorization:
            return
        held = np.zeros(problem.layout.dof)
        own = problem.system.diagonal[self._space.pivots]
        held[self._space.pivots] = np.where(own > 0.0, own, 1.0)
        try:
            problem.factorize(held if len(self._space.pivots) else None)
        except NotPositiveDefinite as error:
            raise SingularProblemError(explain_singularity(problem, error, self._space)) from error
        self._factorization = problem.factorization

    def _is_where_it_was_solved(self) -> bool:
        """Whether nothing was linearised elsewhere since."""
        self._problem.require_current()
        return all(now is then for now, then in zip(self._problem.values, self._values, strict=True))
