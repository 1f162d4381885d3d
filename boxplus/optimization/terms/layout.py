"""Where the free variables of a problem lie in its tangent vector."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.manifold import Manifold
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.variables import VariableRows, Variables

_POINTS = (Euclidean(2), Euclidean(3))


class Layout:
    """Numbers the free variables, block after block, and places each in the tangent vector of the problem.

    Attributes:
        blocks: the blocks of the problem.
        ids: of the variables of every block when the layout was made.
        number: for every block (n,) int64, the number of each of its variables, −1 where it is fixed.
        sizes: (free variables,) int64 degrees of freedom of each.
        start: (free variables + 1,) int64, where each begins in the tangent vector; the last is its length.
        tangents: for every block the manifold by whose ⊞ the solver moves it; its own, or another one that stores the same
            points (`tangents.best_tangents`).
    """

    def __init__(self, blocks: Sequence[Variables], without: Variables | None = None) -> None:
        self.blocks = tuple(blocks)
        self.tangents: tuple[Manifold, ...] = tuple(block.manifold for block in self.blocks)
        self.ids = tuple(block.ids for block in self.blocks)
        self._revisions = tuple(block.revision for block in self.blocks)
        self.number: list[NDArray[np.int64]] = []
        count = 0
        sizes = []
        for block in self.blocks:
            free = None if block is without or block.is_all_fixed else ~block.is_fixed
            own = 0 if free is None else int(np.count_nonzero(free))
            if own == len(block):
                number = np.arange(count, count + own)
            else:
                number = np.full(len(block), -1, dtype=np.int64)
                if free is not None:
                    number[free] = np.arange(count, count + own)
            sizes.append(np.full(own, block.manifold.dof, dtype=np.int64))
            count += own
            self.number.append(number)
        self.sizes = np.concatenate(sizes) if sizes else np.zeros(0, dtype=np.int64)
        self.start = np.zeros(len(self.sizes) + 1, dtype=np.int64)
        np.cumsum(self.sizes, out=self.start[1:])

    def without(self, block: Variables) -> Layout:
        """The layout of all variables but those of `block`, which count as fixed."""
        return Layout(self.blocks, block)

    @property
    def dof(self) -> int:
        """Length of the tangent vector."""
        return int(self.start[-1])

    @property
    def is_current(self) -> bool:
        """Whether all variables of the layout are still there, and held and linearised as they were."""
        return all(block.revision == then for block, then in zip(self.blocks, self._revisions, strict=True))

    def rows(self, selected: VariableRows) -> NDArray[np.uint32]:
        """Where the selected variables stand in the values of the layout.

        Raises:
            InputError: a variable was removed before the layout was made, or added since.
        """
        ids, known = selected.ids, self.ids[selected.block.number]
        if known is selected.block.ids:
            return selected.rows
        rows = np.minimum(np.searchsorted(known, ids), max(len(known) - 1, 0))
        other = known[rows] != ids if len(known) else np.ones(len(ids), dtype=np.bool_)
        if other.any():
            raise InputError(
                "variables that were there when the problem was solved",
                f"{selected.block.name}[{ids[np.argmax(other)]}]",
                "solve again",
            )
        return rows.astype(np.uint32)

    def numbers(self, rows: VariableRows) -> NDArray[np.int64]:
        """Numbers of the selected variables, −1 where fixed."""
        return self.number[rows.block.number][self.rows(rows)]

    def starts(self, rows: VariableRows) -> NDArray[np.int64]:
        """Where the selected variables begin in the tangent vector, −1 where fixed."""
        number = self.numbers(rows)
        return np.where(number >= 0, self.start[number], -1)

    def boxplus(self, values: Sequence[NDArray[np.float64]], delta: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """values ⊞ δ, block by block; fixed variables stay."""
        moved = []
        for tangent, number, x in zip(self.tangents, self.number, values, strict=True):
            free = np.flatnonzero(number >= 0)
            if not len(free):
                moved.append(x)
                continue
            first, last = int(free[0]), int(free[-1]) + 1
            begin = int(self.start[number[first]])
            step = delta[begin : begin + len(free) * tangent.dof].reshape(len(free), tangent.dof)
            if len(free) == len(x):
                moved.append(tangent.boxplus(x, step))
                continue
            y = x.copy()
            own = slice(first, last) if last - first == len(free) else free
            y[own] = tangent.boxplus(x[own], step)
            moved.append(y)
        return moved

    def largest_of_kind(self, diagonal: NDArray[np.float64]) -> NDArray[np.float64]:
        """For every tangent the largest entry among those of its kind, the same axis of all variables of the block.

        Entries of one kind have one unit and compare, whatever the units of the problem. The axes of points are of one kind.

        Args:
            diagonal: (dof,) not negative.
        """
        largest = np.empty_like(diagonal)
        for tangent, number in zip(self.tangents, self.number, strict=True):
            free = number[number >= 0]
            if len(free):
                own = slice(int(self.start[free[0]]), int(self.start[free[-1] + 1]))
                _spread_largest(diagonal[own].reshape(len(free), tangent.dof), tangent in _POINTS, largest[own])
        return largest

    def describe(self, number: int) -> str:
        """Name of a free variable, such as `poses[12]`."""
        for block, numbers, ids in zip(self.blocks, self.number, self.ids, strict=True):
            row = np.flatnonzero(numbers == number)
            if len(row):
                return f"{block.name}[{ids[row[0]]}]"
        return f"variable {number}"


def connected_numbers(layout: Layout, group: Group) -> list[NDArray[np.int64]]:
    """For every connection of a group, the numbers of its variables, −1 where fixed or the residual is left out or removed."""
    numbers = [layout.numbers(connection) for connection in group.connections]
    absent = group.absent
    if absent is not None:
        numbers = [np.where(absent, -1, number) for number in numbers]
    return numbers


@kernel
def _spread_largest(kinds: NDArray[np.float64], is_one_kind: bool, largest: NDArray[np.float64]) -> None:
    """Every entry of kinds (n, dof) becomes the largest of its column, or of all, in largest (n dof,)."""
    dof = np.uint64(kinds.shape[1])
    most = kinds[0].copy()
    for n in range(np.uint64(kinds.shape[0])):
        for c in range(dof):
            most[c] = max(most[c], kinds[n, c])
    if is_one_kind:
        most[:] = most.max()
    for n in range(np.uint64(kinds.shape[0])):
        for c in range(dof):
            largest[n * dof + c] = most[c]
