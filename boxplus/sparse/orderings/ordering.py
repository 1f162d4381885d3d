"""Fill-reducing elimination orders of block-sparse symmetric matrices, and the exact cost of a factorisation in an order.

The graph has one node per block, so ordering costs the same for poses of six scalars as for single scalars. Two orders
are computed where it pays, approximate minimum degree and nested dissection, and the cheaper one is kept: what
each costs is counted exactly without factorising (Gilbert, Ng, Peyton, "An efficient algorithm to compute row and column
counts for sparse Cholesky factorization", SIAM J. Matrix Anal. Appl. 15(4), 1994), weighted by block sizes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.sparse.orderings.dissection.nested_dissection import nested_dissection
from boxplus.sparse.orderings.minimum_degree import minimum_degree

Method = Literal["auto", "minimum_degree", "nested_dissection", "natural"]

DISSECTION_FLOPS = 10_000.0
"""`auto` tries nested dissection where minimum degree costs more than this many operations per node and edge: below, even
an order for nothing would not pay for the time that it takes."""

_MOST_TRIES = 8

_ONE = np.uint32(1)
_NONE = np.uint32(0xFFFFFFFF)


@dataclass(frozen=True, slots=True, eq=False)
class Ordering:
    """An elimination order and what a Cholesky factorisation costs in it.

    Attributes:
        permutation: (n,) int64, new position k holds block `permutation[k]`; a postorder of the elimination tree, so that
            blocks that share a supernode are neighbours.
        fill: scalar nonzeros of the lower factor, diagonal included.
        flops: Σ c² over the scalar columns with c nonzeros each, multiplications and additions.
        method: what computed it.
    """

    permutation: NDArray[np.int64]
    fill: int
    flops: float
    method: Literal["minimum_degree", "nested_dissection", "natural"]


def order(col_start: ArrayLike, row: ArrayLike, sizes: ArrayLike, method: Method = "auto") -> Ordering:
    """Order the blocks of a symmetric matrix for a sparse Cholesky factorisation.

    Args:
        col_start: (n + 1,) integers, block column j has the block rows `row[col_start[j]:col_start[j + 1]]`.
        row: (m,) integers, block rows of the lower triangle, in any order; the diagonal may be there or not.
        sizes: (n,) positive integers, scalar rows of each block.
        method: one of the two orders, the better of the two (`auto`), or the order as given up to a postorder (`natural`).

    Raises:
        InputError: arrays that do not describe a lower triangle, sizes that are not positive, an unknown method.
    """
    starts, rows, weights = _checked(col_start, row, sizes)
    start = np.empty(len(weights) + 1, np.int64)
    neighbours = np.empty(2 * len(rows), np.int32)
    used = _symmetrise(starts, rows, start, neighbours)
    neighbours = neighbours[:used]
    if method == "natural":
        return _evaluate(start, neighbours, weights, np.arange(len(weights)), "natural")
    if method == "minimum_degree":
        return _evaluate(start, neighbours, weights, minimum_degree(start, neighbours, weights), "minimum_degree")
    if method == "nested_dissection":
        return _evaluate(
            start, neighbours, weights, nested_dissection(start, neighbours, weights, _MOST_TRIES), "nested_dissection"
        )
    if method != "auto":
        raise InputError("method auto, minimum_degree, nested_dissection or natural", repr(method), "choose one of them")
    degree = _evaluate(start, neighbours, weights, minimum_degree(start, neighbours, weights), "minimum_degree")
    worth = degree.flops / (DISSECTION_FLOPS * max(len(weights) + len(neighbours), 1))
    if worth <= 1.0:
        return degree
    tries = min(max(int(worth**0.5 / 2.5), 1), _MOST_TRIES)  # more time where more is to be gained
    dissection = _evaluate(start, neighbours, weights, nested_dissection(start, neighbours, weights, tries), "nested_dissection")
    return dissection if dissection.flops < degree.flops else degree


def _checked(
    col_start: ArrayLike, row: ArrayLike, sizes: ArrayLike
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    arrays = {"col_start": np.asarray(col_start), "row": np.asarray(row), "sizes": np.asarray(sizes)}
    for name, array in arrays.items():
        if array.ndim != 1 or (array.dtype.kind not in "iu" and array.size):
            raise InputError(f"{name} as a vector of integers", f"{array.dtype} of shape {array.shape}", "convert it")
    starts, rows, weights = (np.ascontiguousarray(array, np.int64) for array in arrays.values())
    count = len(weights)
    if len(starts) != count + 1 or starts[0] != 0 or starts[-1] != len(rows) or (np.diff(starts) < 0).any():
        raise InputError(
            f"col_start with {count + 1} entries rising from 0 to {len(rows)}, one more than sizes",
            f"{len(starts)} entries" + (f" from {starts[0]} to {starts[-1]}" if len(starts) else ""),
            "pass the column pointers of a block CSC matrix",
        )
    columns = np.repeat(np.arange(count), np.diff(starts))
    bad = np.flatnonzero((rows < columns) | (rows >= count))
    if bad.size:
        raise InputError(
            f"block rows of the lower triangle, at least their column and below {count}",
            f"row {rows[bad[0]]} in column {columns[bad[0]]}",
            "pass the lower triangle only",
        )
    if (weights <= 0).any():
        raise InputError("positive block sizes", f"{weights.min()} (block {weights.argmin()})", "leave empty blocks out")
    return starts, rows, weights


@kernel
def _symmetrise(
    col_start: NDArray[np.int64], row: NDArray[np.int64], start: NDArray[np.int64], neighbours: NDArray[np.int32]
) -> np.int64:
    """Both triangles of a lower triangle as adjacency lists without loops and repetitions; returns their length."""
    count = np.uint64(len(start) - 1)
    cursor, seen = np.empty(count, np.int64), np.empty(count, np.int64)
    for j in range(count):
        cursor[j], seen[j] = 0, -1
    for j in range(count):
        for k in range(np.uint64(col_start[j]), np.uint64(col_start[j + _ONE])):
            i = np.uint64(row[k])
            if i != j:
                cursor[i] += 1
                cursor[j] += 1
    total = np.int64(0)
    for j in range(count):
        degree = cursor[j]
        cursor[j] = start[j] = total
        total += degree
    start[count] = total
    for j in range(count):
        for k in range(np.uint64(col_start[j]), np.uint64(col_start[j + _ONE])):
            i = np.uint64(row[k])
            if i != j:
                neighbours[np.uint64(cursor[i])] = np.int32(j)
                cursor[i] += 1
                neighbours[np.uint64(cursor[j])] = np.int32(i)
                cursor[j] += 1
    # A repeated entry is one edge.
    out = np.uint64(0)
    for j in range(count):
        begin, end = np.uint64(start[j]), np.uint64(start[j + _ONE])
        start[j] = np.int64(out)
        for k in range(begin, end):
            i = np.uint64(neighbours[k])
            if seen[i] != np.int64(j):
                seen[i] = np.int64(j)
                neighbours[out] = np.int32(i)
                out += _ONE
    start[count] = np.int64(out)
    return np.int64(out)


@kernel
def _elimination_tree(
    start: NDArray[np.int64], neighbours: NDArray[np.int32], permutation: NDArray[np.int64], parent: NDArray[np.uint32]
) -> None:
    """Parents, as positions, of the positions in an elimination order (Liu 1990, with path compression)."""
    count = np.uint64(len(permutation))
    position = np.empty(count, np.uint32)
    for k in range(count):
        position[np.uint64(permutation[k])] = np.uint32(k)
    ancestor = np.empty(count, np.uint32)
    for k in range(count):
        parent[k] = ancestor[k] = _NONE
        node = np.uint64(permutation[k])
        for m in range(np.uint64(start[node]), np.uint64(start[node + _ONE])):
            j = position[np.uint64(neighbours[m])]
            while j < k:
                above = ancestor[j]
                ancestor[j] = np.uint32(k)
                if above == _NONE:
                    parent[j] = np.uint32(k)
                    break
                j = above


@kernel
def _postorder(parent: NDArray[np.uint32], permutation: NDArray[np.int64]) -> None:
    """Relabel positions by a postorder of the tree, in place: children before parents, subtrees without gaps."""
    count = np.uint64(len(parent))
    child = np.empty(count + _ONE, np.uint32)  # first child; the last entry collects the roots
    sibling = np.empty(count, np.uint32)
    before, tree = np.empty(count, np.int64), np.empty(count, np.uint32)
    child[count] = _NONE
    for old in range(count):
        child[old] = _NONE
        before[old], tree[old] = permutation[old], parent[old]
    for step in range(count):
        k = count - _ONE - step
        slot = count if parent[k] == _NONE else np.uint64(parent[k])
        sibling[k] = child[slot]
        child[slot] = np.uint32(k)
    label = np.empty(count, np.uint32)
    placed = np.uint64(0)
    root = child[count]
    while root != _NONE:
        k = root
        while True:
            while child[k] != _NONE:  # walk down, taking each child off its parent's list
                below = child[k]
                child[k] = sibling[below]
                k = below
            label[k] = np.uint32(placed)
            placed += _ONE
            if k == root:
                break
            k = parent[k]
        root = sibling[root]
    for old in range(count):
        permutation[label[old]] = before[old]
        parent[label[old]] = _NONE if tree[old] == _NONE else label[tree[old]]


@kernel
def _column_counts(
    start: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    sizes: NDArray[np.int64],
    permutation: NDArray[np.int64],
    parent: NDArray[np.uint32],
    counts: NDArray[np.int64],
) -> None:
    """Scalar rows of each block column of the factor, diagonal block included, for a postordered elimination order.

    Row i of the factor is the subtree of the elimination tree that hangs at i and whose leaves are entries of row i of
    the matrix. Each leaf adds the rows of block i to all its ancestors, the least common ancestor of two successive
    leaves takes one of them back, and so does the parent of i, where the subtree ends.
    """
    count = np.uint64(len(permutation))
    position = np.empty(count, np.uint32)
    ancestor = np.empty(count, np.uint32)
    first = np.empty(count, np.uint32)  # first descendant
    last_leaf = np.empty(count, np.uint32)
    for k in range(count):
        first[k] = last_leaf[k] = _NONE
    for k in range(count):
        position[np.uint64(permutation[k])] = np.uint32(k)
        counts[k] = 0
        ancestor[k] = np.uint32(k)
        if first[k] == _NONE:
            first[k] = np.uint32(k)
        above = parent[k]
        if above != _NONE and first[above] == _NONE:
            first[above] = first[k]
    for k in range(count):
        node = np.uint64(permutation[k])
        for m in range(np.uint64(start[node]), np.uint64(start[node + _ONE])):
            i = position[np.uint64(neighbours[m])]
            if i <= k:
                continue
            previous = last_leaf[i]
            if previous == _NONE or first[k] > previous:
                size = sizes[np.uint64(permutation[i])]
                counts[k] += size
                if previous != _NONE:
                    root = previous
                    while ancestor[root] != root:
                        root = ancestor[root]
                    while previous != root:
                        above = ancestor[previous]
                        ancestor[previous] = root
                        previous = above
                    counts[root] -= size
                last_leaf[i] = np.uint32(k)
        own = sizes[node]
        if last_leaf[k] == _NONE:  # no entry to the left: the row is its diagonal
            counts[k] += own
        above = parent[k]
        if above != _NONE:
            counts[above] -= own
            ancestor[k] = above
    for k in range(count):
        above = parent[k]
        if above != _NONE:
            counts[above] += counts[k]


def _evaluate(
    start: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    sizes: NDArray[np.int64],
    permutation: NDArray[np.int64],
    method: Literal["minimum_degree", "nested_dissection", "natural"],
) -> Ordering:
    """Postorder `permutation` in place and count what the factorisation costs."""
    parent = np.empty(len(sizes), np.uint32)
    counts = np.empty(len(sizes), np.int64)
    _elimination_tree(start, neighbours, permutation, parent)
    _postorder(parent, permutation)
    _column_counts(start, neighbours, sizes, permutation, parent, counts)
    width, rows = sizes[permutation], counts.astype(np.float64)
    fill = int((counts * width - width * (width - 1) // 2).sum())
    # Σ (c - k)² for k = 0 … width - 1
    last = width - 1.0
    flops = float((width * rows**2 - rows * last * width + last * width * (2.0 * last + 1.0) / 6.0).sum())
    return Ordering(permutation, fill, flops, method)
