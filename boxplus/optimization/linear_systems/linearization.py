"""A problem as matrices: what an algorithm of one's own starts from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError, NotFiniteError
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.layout import Layout
from boxplus.optimization.terms.variables import VariableRows, Variables

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True, slots=True)
class LinearizedProblem:
    """J, r and w at one point: the cost near it is about ½ Σ w (r + J δ)², and its gradient is Jᵀ (w r), exactly.

    Rows are those of the groups one after the other, `dim` for each residual in its order; columns are the tangents of the free
    variables, block after block. Removed residuals and those that cannot be evaluated keep their rows, which are zero.

    Attributes:
        jacobian: (m, n) sparse, ∂(W r)/∂δ, whitened, without the loss.
        residuals: (m,) W r, whitened, without the loss.
        weights: (m,) ρ′ of each residual's loss, repeated for each of its rows; 1 for least squares, 0 where invalid.
        cost: ½ Σ ρ(‖W r‖²).
    """

    jacobian: csr_array
    residuals: NDArray[np.float64]
    weights: NDArray[np.float64]
    cost: float
    _rows: tuple[tuple[Group, slice], ...] = field(repr=False)
    _column: NDArray[np.int64] = field(repr=False)
    _layout: Layout = field(repr=False)

    @property
    def gradient(self) -> NDArray[np.float64]:
        """(n,) Jᵀ (w r): the derivative of the cost."""
        return np.asarray(self.jacobian.T @ (self.weights * self.residuals))

    @property
    def hessian(self) -> csr_array:
        """(n, n) Jᵀ diag(w) J, sparse: Gauss-Newton's, with the losses as weights (iteratively reweighted least squares)."""
        from scipy import sparse

        return sparse.csr_array(self.jacobian.T @ sparse.diags_array(self.weights) @ self.jacobian)

    def rows(self, group: Group) -> slice:
        """Where the residuals of a group stand.

        Raises:
            InputError: a group of another problem, or added since.
        """
        for own, at in self._rows:
            if own is group:
                return at
        raise InputError("a group of this problem", f"{group!r}", "give what `add_residuals` returned, and linearise after that")

    def columns(self, selected: VariableRows | Variables) -> NDArray[np.int64]:
        """(k, dof) columns of the tangents of the selected variables; −1 where they are fixed or held.

        Raises:
            InputError: variables of another problem, or added or removed since.
        """
        rows = selected[:] if isinstance(selected, Variables) else selected
        if not any(rows.block is block for block in self._layout.blocks):
            raise InputError("variables of this problem", f"{rows.block!r} of another one", "use what `add_variables` returned")
        start = self._layout.starts(rows)
        places = start[:, None] + np.arange(rows.block.manifold.dof)
        return np.where(start[:, None] >= 0, self._column[np.maximum(places, 0)], -1)

    def moved(self, delta: NDArray[np.float64], values: Sequence[NDArray[np.float64]]) -> list[NDArray[np.float64]]:
        """`values` (of every block, as `Problem.values_at` returns them) ⊞ δ (n,).

        Raises:
            InputError: δ of another length.
        """
        count = int((self._column >= 0).sum())
        if np.shape(delta) != (count,):
            raise InputError(f"delta of shape ({count},)", f"shape {np.shape(delta)}", "give one number for each column")
        whole = np.zeros(len(self._column))
        whole[self._column >= 0] = delta
        return self._layout.boxplus(values, whole)


def linearize(blocks: Sequence[Variables], groups: Sequence[Group], values: Sequence[NDArray[np.float64]]) -> LinearizedProblem:
    """See `Problem.linearize`."""
    layout = Layout(blocks)
    column = _columns(layout)
    parts, residuals, weights, places, cost, first = [], [], [], [], 0.0, 0
    for group in groups:
        own = group.unweighed()
        own.linearize(values, 1)
        found = own.find_not_finite()
        if found is not None:
            raise NotFiniteError(
                "finite residuals and Jacobians",
                f"NaN or infinity in the {found[1]} of residual {found[0]} of group {group!r}",
                "repair that measurement, or the residual, or linearise elsewhere",
            )
        count, dim = own.r.shape
        residuals.append(np.where(own.valid[:, None], own.r, 0.0).reshape(-1))
        row = first + np.arange(count * dim).reshape(count, dim, 1)
        for connection, J in zip(own.connections, own.jacobians, strict=True):
            start = layout.starts(connection)
            free = column[np.maximum(start, 0)[:, None] + np.arange(J.shape[2])] if layout.dof else np.full(J.shape[::2], -1)
            is_there = np.broadcast_to(((start >= 0) & own.valid)[:, None, None] & (free >= 0)[:, None, :], J.shape)
            parts.append(
                (
                    J[is_there],
                    np.broadcast_to(row, J.shape)[is_there],
                    np.broadcast_to(free[:, None, :], J.shape)[is_there],
                )
            )
        own.set_loss(group.loss)
        cost += own.evaluate(values, 1).cost
        weights.append(np.repeat(np.where(own.valid, own.loss_weights(None), 0.0), dim))
        places.append((group, slice(first, first + count * dim)))
        first += count * dim
    width = int((column >= 0).sum())
    if width == 0:
        raise InputError("at least one free variable", "none", "call `add_variables`, or `free` some of them")
    entries, rows, columns = (np.concatenate([part[k] for part in parts]) if parts else np.zeros(0) for k in range(3))
    from scipy import sparse

    jacobian = sparse.coo_array((entries, (rows.astype(np.int64), columns.astype(np.int64))), shape=(first, width)).tocsr()
    return LinearizedProblem(
        jacobian,
        np.concatenate(residuals) if residuals else np.zeros(0),
        np.concatenate(weights) if weights else np.zeros(0),
        cost,
        tuple(places),
        column,
        layout,
    )


def _columns(layout: Layout) -> NDArray[np.int64]:
    """For every place in the tangent vector of the layout its column, −1 for a held component."""
    held = np.zeros(layout.dof, dtype=np.bool_)
    for block, number in zip(layout.blocks, layout.number, strict=True):
        if block.is_held is not None:
            free = np.flatnonzero(number >= 0)
            places = layout.start[number[free]][:, None] + np.arange(block.manifold.dof)
            held[places[block.is_held[free]]] = True
    column = np.cumsum(~held) - 1
    column[held] = -1
    return column
