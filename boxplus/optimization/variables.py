"""Variables of a problem: blocks of points of one manifold, and rows of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError
from boxplus.manifolds.manifold import Manifold


class Variables:
    """A block of n variables on one manifold, made by `Problem.add_variables`.

    `block[rows]` selects variables for `add_residuals`, `fix` and `covariance`; rows may repeat.

    Attributes:
        manifold: of every variable of the block.
        name: for messages.
        values: (n, size) as given; a solution has its own.
        is_fixed: (n,) bool, held where they start by the solver; set by `Problem.fix` and `free` only.
        number: of the block in its problem.
    """

    def __init__(self, number: int, name: str, manifold: Manifold, values: NDArray[np.float64]) -> None:
        self.number, self.name, self.manifold, self.values = number, name, manifold, values
        self.is_fixed = np.zeros(len(values), dtype=np.bool_)
        self.is_fixed.flags.writeable = False

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, rows: Any) -> VariableRows:
        return VariableRows(self, rows)

    def __iter__(self) -> Iterator[VariableRows]:
        return (self[row] for row in range(len(self)))

    def __repr__(self) -> str:
        return f"{len(self)} variables {self.name!r} on {self.manifold}"


class VariableRows:
    """Rows of one block: the variables that each residual of a group is connected to.

    Raises:
        InputError: an index is out of range, negative, or not an integer.
    """

    def __init__(self, block: Variables, rows: ArrayLike | slice) -> None:
        self.block = block
        if isinstance(rows, slice):
            rows = np.arange(len(block))[rows]
        given = np.asarray(rows)
        if given.dtype == np.bool_ and given.shape == (len(block),):
            given = np.flatnonzero(given)
        if given.size == 0:
            given = given.astype(np.int64)
        if given.ndim > 1 or not np.issubdtype(given.dtype, np.integer):
            raise InputError(
                f"integer rows of {block.name!r}, one-dimensional",
                f"{given.dtype} of shape {given.shape}",
                "select with integers",
            )
        given = np.atleast_1d(given)
        outside = (given < 0) | (given >= len(block))
        if outside.any():
            at = int(np.argmax(outside))
            raise InputError(
                f"rows of {block.name!r} from 0 to {len(block) - 1}",
                f"{given[at]} at position {at}",
                "the index dangles: repair the association",
            )
        self.rows = given.astype(np.uint32)

    def __len__(self) -> int:
        return len(self.rows)
