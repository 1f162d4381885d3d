"""Blocks of variables that grow, and where they are linearised."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds.manifold import Manifold
from boxplus.optimization.incremental.growing import grown
from boxplus.optimization.variables import Variables


class GrowingVariables(Variables):
    """A block of variables on one manifold that more are added to, made by `IncrementalProblem.add_variables`.

    `block[rows]` selects variables for `add_residuals`, `estimate` and `covariance`; rows may repeat.

    Attributes:
        manifold, name, number: as of `Variables`.
        points: (capacity, size) where the variables are linearised; rows from `len(block)` on mean nothing.
        estimates: (capacity, size) points ⊞ δ.
        ids: (capacity,) number of each variable in the tree, −1 where it is fixed.
    """

    def __init__(self, number: int, name: str, manifold: Manifold) -> None:
        self.number, self.name, self.manifold = number, name, manifold
        self.points, self.estimates = np.zeros((0, manifold.size)), np.zeros((0, manifold.size))
        self.ids = np.zeros(0, np.int64)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, values: NDArray[np.float64], first: int | None) -> None:
        """More variables, with numbers in the tree from `first` on; None for fixed ones."""
        begin, end = self._count, self._count + len(values)
        self.points, self.estimates = grown(self.points, end), grown(self.estimates, end)
        self.ids = grown(self.ids, end)
        self.points[begin:end] = self.estimates[begin:end] = values
        self.ids[begin:end] = -1 if first is None else first + np.arange(len(values))
        self._count = end

    @property
    def values(self) -> NDArray[np.float64]:  # type: ignore[override]
        """(n, size) after the last update, a copy; what is new is as it was added."""
        return self.estimates[: self._count].copy()

    @property
    def is_fixed(self) -> NDArray[Any]:  # type: ignore[override]
        """(n,) bool."""
        return np.asarray(self.ids[: self._count] < 0)
