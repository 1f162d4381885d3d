"""H = JᵀJ and g = Jᵀr of whitened residual groups, as the blocks of a sparse symmetric matrix (docs/least_squares.md).

Every block of H gathers the residuals that touch it, in the order of the residuals, so that threads never share a block and
the bits do not depend on their number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel, run_chunks
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.layout import Layout, connected_numbers
from boxplus.sparse.block_matrix import BlockPattern
from boxplus.sparse.counting_sort import gather_by
from boxplus.sparse.product_tiles import add_sums, tile_of

# Pieces for every thread, so that one with more work does not hold up the others; more cost more calls than they even out.
_PIECES = 4
_WORTH_THREADS = 500_000  # multiplications; to wake a thread for fewer takes as long as it saves
_MANY, _AT_ONCE = 4, 256  # variables of a residual, and of all of a group, whose products are not worth a call each


def piece(items: int, threads: int) -> int:
    """How many of `items` a thread takes in one go, where the results do not depend on it."""
    return max(1, items if threads == 1 else -(-items // (_PIECES * threads)))


@dataclass(frozen=True, slots=True)
class Gather:
    """Which residuals of a group add Jₐᵀ J_b to which places.

    Attributes:
        group, a, b: Jacobians `group.jacobians[a]` and `[b]`.
        target: (m,) places, ascending.
        begin: (m + 1,) where the residuals of each place begin in `residual`.
        residual: rows of the group, ascending within a place.
    """

    group: Group
    a: int
    b: int
    target: NDArray[np.int64]
    begin: NDArray[np.int64]
    residual: NDArray[np.uint32]

    @classmethod
    def sorted_by(
        cls, group: Group, a: int, b: int, item: NDArray[np.int64], place: NDArray[np.int64], residual: NDArray[np.intp]
    ) -> Gather:
        """From the item that each of the residuals adds to, and the place of every item."""
        touched, begin, ordered = gather_by(item, len(place), residual)
        return cls(group, a, b, place[touched], begin, ordered)


@kernel
def _accumulate_gradient(
    first: int,
    last: int,
    target: NDArray[np.int64],
    begin: NDArray[np.int64],
    residual: NDArray[np.uint32],
    J: NDArray[np.float64],
    r: NDArray[np.float64],
    gradient: NDArray[np.float64],
) -> None:
    """gradient[target[k]:] += Σ Jᵀ r over the residuals of each place k in [first, last)."""
    for k in range(first, last):
        at = np.uint64(target[k])
        for e in range(begin[k], begin[k + 1]):
            n = np.uint64(residual[e])
            for i in range(np.uint64(J.shape[1])):
                factor = r[n, i]
                for q in range(np.uint64(J.shape[2])):
                    gradient[at + q] += J[n, i, q] * factor


@dataclass(frozen=True, slots=True)
class Joint:
    """A group of few residuals of many variables, such as a marginal prior: all its products JₐᵀJ_b in one go.

    Attributes:
        group: of N residuals.
        column: (slots + 1,) where the Jacobian of each variable begins among all columns.
        start: (N, slots) where each variable begins in the tangent vector; −1 where it is fixed.
        place: (N, slots, slots) where the values of block (a, b) begin; −1 where it is not in the lower triangle, or fixed.
    """

    group: Group
    column: NDArray[np.int64]
    start: NDArray[np.int64]
    place: NDArray[np.int64]

    def add(self, values: NDArray[np.float64], gradient: NDArray[np.float64]) -> None:
        """Add JᵀJ and Jᵀr of the current linearisation."""
        Jt = np.ascontiguousarray(np.concatenate(self.group.jacobians, axis=2).transpose(0, 2, 1))
        _add_joint(Jt, self.group.r, self.column, self.start, self.place, values, gradient)


@kernel(fastmath=True)
def _add_joint(
    Jt: NDArray[np.float64],
    r: NDArray[np.float64],
    column: NDArray[np.int64],
    start: NDArray[np.int64],
    place: NDArray[np.int64],
    values: NDArray[np.float64],
    gradient: NDArray[np.float64],
) -> None:
    depth = np.uint64(Jt.shape[2])
    for n in range(Jt.shape[0]):
        for a in range(start.shape[1]):
            if start[n, a] < 0:
                continue
            for i in range(column[a], column[a + 1]):
                total = 0.0
                for k in range(depth):
                    total += Jt[n, i, k] * r[n, k]
                gradient[start[n, a] + i - column[a]] += total
            for b in range(start.shape[1]):
                at = place[n, a, b]
                if at < 0:
                    continue
                for i in range(column[a], column[a + 1]):
                    for j in range(column[b], column[b + 1]):
                        total = 0.0
                        for k in range(depth):
                            total += Jt[n, i, k] * Jt[n, j, k]
                        values[at] += total
                        at += 1


def add_products(gather: Gather, values: NDArray[np.float64], threads: int) -> None:
    """values[place:] += Σ Jₐᵀ J_b, row-major, for every place of `gather`."""
    Ja, Jb = gather.group.jacobians[gather.a], gather.group.jacobians[gather.b]
    tile = tile_of(Ja.shape[1], Ja.shape[2], Jb.shape[2])
    if len(gather.residual) * Ja.shape[1] * Ja.shape[2] * Jb.shape[2] < _WORTH_THREADS:
        threads = 1

    def work(_: int, first: int, last: int) -> None:
        add_sums(tile, 1.0, first, last, gather.target, gather.begin, gather.residual, gather.residual, Ja, Jb, values)

    run_chunks(work, len(gather.target), piece(len(gather.target), threads), threads)


def add_gradient(gather: Gather, gradient: NDArray[np.float64], threads: int) -> None:
    """gradient[place:] += Σ Jₐᵀ r for every place of `gather`."""
    group = gather.group
    J = group.jacobians[gather.a]
    if len(gather.residual) * J.shape[1] * J.shape[2] < _WORTH_THREADS:
        threads = 1

    def work(_: int, first: int, last: int) -> None:
        _accumulate_gradient(first, last, gather.target, gather.begin, gather.residual, J, group.r, gradient)

    run_chunks(work, len(gather.target), piece(len(gather.target), threads), threads)


class NormalEquations:
    """H and g of `groups` over the free variables of `layout`.

    Attributes:
        pattern: of the lower triangle of H, a block for each variable.
        values: of H's blocks, in the order of `pattern`.
        gradient: g (dof,).
    """

    def __init__(
        self, layout: Layout, groups: Sequence[Group], connected: Sequence[list[NDArray[np.int64]]] | None = None
    ) -> None:
        """`connected`: for every group what `connected_numbers` gives, where that is known."""
        rows: list[NDArray[np.int64]] = []
        columns: list[NDArray[np.int64]] = []
        joint_rows: list[NDArray[np.int64]] = []
        joint_columns: list[NDArray[np.int64]] = []
        parts: list[tuple[Group, int, int, NDArray[np.int64]]] = []
        self._gradients: list[Gather] = []
        joint: list[tuple[Group, NDArray[np.int64], int]] = []
        for k, group in enumerate(groups):
            numbers = connected_numbers(layout, group) if connected is None else connected[k]
            count = group.residual.count
            if len(numbers) >= _MANY and (count == 1 or 0 < count * len(numbers) <= _AT_ONCE):
                number = np.stack(numbers, axis=1)
                row, column = (np.empty(number.size * len(numbers), dtype=np.int64) for _ in range(2))
                lower = _joint_pairs(number, row, column)
                joint.append((group, number, lower))
                joint_rows.append(row[:lower])
                joint_columns.append(column[:lower])
                continue
            moving = [(a, number) for a, number in enumerate(numbers) if (number >= 0).any()]
            for a, number_a in moving:
                for b, number_b in moving:
                    selected, row, column = _lower_pairs(number_a, number_b)
                    if b == a:
                        self._gradients.append(Gather.sorted_by(group, a, a, row, layout.start[:-1], selected))
                    if len(selected):
                        rows.append(row)
                        columns.append(column)
                        parts.append((group, a, b, selected))
        ends = np.cumsum([len(selected) for *_, selected in parts], dtype=np.int64)
        rows, columns = rows + joint_rows, columns + joint_columns
        none = [np.zeros(0, dtype=np.int64)]
        self.pattern, pairs = BlockPattern.from_pairs(layout.sizes, np.concatenate(rows or none), np.concatenate(columns or none))
        self._joint = []
        end = int(ends[-1]) if len(ends) else 0
        for group, number, lower in joint:
            place = np.empty((*number.shape, number.shape[1]), dtype=np.int64)
            _joint_places(number, self.pattern.value_start, pairs.block[end : end + lower], place)
            end += lower
            column = np.cumsum([0, *(J.shape[2] for J in group.jacobians)])
            self._joint.append(Joint(group, column, np.where(number >= 0, layout.start[number], -1), place))
        self._products = [
            Gather.sorted_by(group, a, b, pairs.block[end - len(selected) : end], self.pattern.value_start[:-1], selected)
            for (group, a, b, selected), end in zip(parts, ends, strict=True)
        ]
        self.values = np.zeros(int(self.pattern.value_start[-1]))
        self.gradient = np.zeros(layout.dof)
        self._diagonal = _diagonal_places(self.pattern)

    def assemble(self, threads: int) -> None:
        """Take `values` and `gradient` from the current linearisation of the groups."""
        self.values[:] = 0.0
        self.gradient[:] = 0.0
        for gather in self._products:
            add_products(gather, self.values, threads)
        for gather in self._gradients:
            add_gradient(gather, self.gradient, threads)
        for group in self._joint:
            group.add(self.values, self.gradient)

    @property
    def diagonal(self) -> NDArray[np.float64]:
        """Diagonal of H (dof,)."""
        return self.values[self._diagonal]


@kernel
def _lower_pairs(
    number_a: NDArray[np.int64], number_b: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Residuals whose pair of free variables lies in the lower triangle, and the two variables (−1 where fixed).

    A residual connected to the same variable twice adds both its cross products.
    """
    n = len(number_a)
    residual, row, column = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    count = 0
    for k in range(n):
        if number_b[k] >= 0 and number_a[k] >= number_b[k]:
            residual[count], row[count], column[count] = k, number_a[k], number_b[k]
            count += 1
    return residual[:count], row[:count], column[:count]


@kernel
def _joint_pairs(number: NDArray[np.int64], row: NDArray[np.int64], column: NDArray[np.int64]) -> int:
    """The pairs (a, b) of free variables of each residual that lie in the lower triangle, one residual after the other."""
    count = 0
    for n in range(number.shape[0]):
        for a in range(number.shape[1]):
            for b in range(number.shape[1]):
                if number[n, a] >= number[n, b] >= 0:
                    row[count], column[count] = number[n, a], number[n, b]
                    count += 1
    return count


@kernel
def _joint_places(
    number: NDArray[np.int64], value_start: NDArray[np.int64], block: NDArray[np.int64], place: NDArray[np.int64]
) -> None:
    """Where the values of the block of each pair begin, in the order of `_joint_pairs`; −1 for all others."""
    count = 0
    for n in range(number.shape[0]):
        for a in range(number.shape[1]):
            for b in range(number.shape[1]):
                place[n, a, b] = -1
                if number[n, a] >= number[n, b] >= 0:
                    place[n, a, b] = value_start[block[count]]
                    count += 1


def _diagonal_places(pattern: BlockPattern) -> NDArray[np.int64]:
    """Where the diagonal entries of the matrix lie among its values (dof,)."""
    first = pattern.value_start[pattern.col_start[:-1]]
    variable = np.repeat(np.arange(len(pattern.sizes)), pattern.sizes)
    within = np.arange(int(pattern.start[-1])) - pattern.start[variable]
    places: NDArray[Any] = first[variable] + within * (pattern.sizes[variable] + 1)
    return places.astype(np.int64)
