"""Blocks of variables that grow, and where they are linearised."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.manifolds.manifold import Manifold
from boxplus.optimization.incremental.growing import grown
from boxplus.optimization.terms.variables import Variables

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class GrowingVariables(Variables):
    """A block of variables on one manifold that more are added to, made by `IncrementalProblem.add_variables`.

    `block[rows]` selects variables for `add_residuals`, `estimate` and `covariance`; rows may repeat.

    Attributes:
        manifold, name, number: as of `Variables`.
        points: (capacity, size) where the variables are linearised; rows from `len(block)` on mean nothing.
        estimates: (capacity, size) points ⊞ δ.
        numbers: (capacity,) number of each variable in the tree, −1 where it is fixed.
    """

    is_all_fixed = False  # not worked out: it spares nothing here

    def __init__(self, number: int, name: str, manifold: Manifold) -> None:
        self.number, self.name, self.manifold = number, name, manifold
        self.points, self.estimates = np.zeros((0, manifold.size)), np.zeros((0, manifold.size))
        self.numbers = np.zeros(0, np.int64)
        self._count = 0
        self.is_held, self.revision = None, 0  # nothing is held in part, and nothing ever removed

    def __len__(self) -> int:
        return self._count

    def append(self, values: NDArray[np.float64], first: int | None) -> None:
        """More variables, with numbers in the tree from `first` on; None for fixed ones."""
        begin, end = self._count, self._count + len(values)
        self.points, self.estimates = grown(self.points, end), grown(self.estimates, end)
        self.numbers = grown(self.numbers, end)
        self.points[begin:end] = self.estimates[begin:end] = values
        self.numbers[begin:end] = -1 if first is None else first + np.arange(len(values))
        self._count = end

    @property
    def values(self) -> NDArray[np.float64]:  # type: ignore[override]
        """(n, size) after the last update, a copy; what is new is as it was added."""
        return self.estimates[: self._count].copy()

    @property
    def is_fixed(self) -> NDArray[Any]:  # type: ignore[override]
        """(n,) bool."""
        return np.asarray(self.numbers[: self._count] < 0)

    @property
    def ids(self) -> NDArray[np.int64]:  # type: ignore[override]
        """(n,) from 0 on, as nothing is ever removed."""
        return np.arange(self._count)

    @property
    def next_id(self) -> int:  # type: ignore[override]
        """The id of the next variable."""
        return self._count

    def rows_of(self, ids: NDArray[np.int64]) -> NDArray[np.uint32]:
        """At which row each variable stands: its id."""
        return ids.astype(np.uint32)

    def has_first_estimate(self, rows: NDArray[np.uint32]) -> bool:
        """None has: the tree is linearised at `points` as a whole."""
        return False


@kernel
def gather_points(
    variables: Indices, row_of: Indices, points: Array, start: Indices, delta: Array, x: Array, own_delta: Array
) -> None:
    """Points (n, size) and δ (n, dof) of variables of one block; `row_of` and `start` of every variable of the tree."""
    for k in range(np.uint64(len(variables))):
        v = variables[k]
        row, at = np.uint64(row_of[v]), np.uint64(start[v])
        for c in range(np.uint64(x.shape[1])):
            x[k, c] = points[row, c]
        for c in range(np.uint64(own_delta.shape[1])):
            own_delta[k, c] = delta[at + c]


@kernel
def scatter_points(variables: Indices, row_of: Indices, x: Array, estimates: Array) -> None:
    """estimates[row] = x for the variables of one block."""
    for k in range(np.uint64(len(variables))):
        row = np.uint64(row_of[variables[k]])
        for c in range(np.uint64(x.shape[1])):
            estimates[row, c] = x[k, c]
