"""The numeric multifrontal factorisation over the fronts of `supernodes`.

Duff and Reid, "The multifrontal solution of indefinite sparse symmetric linear equations" (1983); Liu, "The multifrontal
method for sparse matrix solution" (1992).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.optimization.dense_kernels import Buffer, factor_panel
from boxplus.optimization.supernodes import DIAGONAL, STORED
from boxplus.optimization.vector_tiles import add

Table = NDArray[np.void]
Indices = NDArray[np.uint64]

SINGULAR = 1e-13
"""A pivot that has lost all but this share of its diagonal entry is rounding error: the matrix is singular. Scaling a matrix
does not change the share; it is above 1e-8 on the usual pose graphs."""

_ZERO = np.uint64(0)
_STORED, _DIAGONAL = np.uint64(STORED), np.uint64(DIAGONAL)


@kernel(inline=True)
def _fill_panel(first: np.uint64, last: np.uint64, ld: np.uint64, entries: Table, values: Buffer, factor: Buffer) -> None:
    """Write the blocks of the matrix that belong to a front."""
    for e in range(first, last):
        entry = entries[e]
        source, target, rows, columns, kind = entry["source"], entry["target"], entry["rows"], entry["columns"], entry["kind"]
        if kind == _STORED:
            for i in range(rows):
                for j in range(columns):
                    factor[target + i + j * ld] = values[source + i * columns + j]
        elif kind == _DIAGONAL:
            for i in range(rows):
                for j in range(i + np.uint64(1)):
                    factor[target + i + j * ld] = values[source + i * columns + j]
        else:
            for i in range(rows):
                for j in range(columns):
                    factor[target + j + i * ld] = values[source + i * columns + j]


@kernel(inline=True)
def _add_child(front: Table, child: Table, first: np.uint64, split: np.uint64, last: np.uint64, runs: Table, stack: Buffer,
               target: Buffer, target_at: np.uint64, ld: np.uint64, shift: np.uint64) -> None:  # fmt: skip
    """Add the columns `first … split` of runs of a child's update matrix, down to its last run, to a part of the front.

    Row and column `shift` of the front is the first element of that part.
    """
    source_at, source_ld = child["update_at"], child["update_ld"]
    for a in range(first, split):
        column, there, length = runs[a]["child"], runs[a]["parent"], runs[a]["length"]
        for j in range(length):
            source = source_at + (column + j) * source_ld
            to = target_at + (there + j - shift) * ld
            add(target, to + there + j - shift, stack, source + column + j, length - j)
            for b in range(a + np.uint64(1), last):
                add(target, to + runs[b]["parent"] - shift, stack, source + runs[b]["child"], runs[b]["length"])


@kernel
def factorize(sequence: Indices, begin: np.uint64, end: np.uint64, table: Table, children: Indices, runs: Table, entries: Table,
              scalar_order: Indices, values: Buffer, diagonal: Buffer, factor: Buffer, stack: Buffer, inverse: Buffer,
              pivots: Buffer, entries_of_diagonal: Buffer) -> np.uint64:  # fmt: skip
    """Factorise the fronts `sequence[begin:end]`, whose children come before them or are done.

    Args:
        diagonal: (N,) added to the diagonal, in the order of the matrix.
        factor: receives the panels of L.
        inverse, pivots: (N,) receive the reciprocals of L's diagonal and the pivots, in elimination order.
        entries_of_diagonal: (N,) receives the diagonal before elimination, in elimination order.

    Returns:
        The scalar position whose pivot is not positive and finite, or only so by rounding, or N.
    """
    for place in range(begin, end):
        g = sequence[place]
        front, following = table[g], table[g + np.uint64(1)]
        column, width, below = front["column"], front["width"], front["below"]
        at, ld = front["panel_at"], front["panel_ld"]
        for k in range(at, at + width * ld):
            factor[k] = 0.0
        _fill_panel(front["entry_start"], following["entry_start"], ld, entries, values, factor)
        for k in range(width):
            entry = factor[at + k + k * ld] + diagonal[scalar_order[column + k]]
            factor[at + k + k * ld] = entry
            entries_of_diagonal[column + k] = entry
        for c in range(front["child_start"], following["child_start"]):
            child, behind = table[children[c]], table[children[c] + np.uint64(1)]
            _add_child(
                front, child, child["run_start"], child["run_split"], behind["run_start"], runs, stack, factor, at, ld, _ZERO
            )
        update_at, update_ld = front["update_at"], front["update_ld"]
        failed = factor_panel(factor, at, ld, width + below, width, inverse, pivots, column, stack, update_at, update_ld)
        if failed < width:
            return np.uint64(column + failed)
        for k in range(column, column + width):
            if pivots[k] <= SINGULAR * entries_of_diagonal[k]:
                return np.uint64(k)
        for c in range(front["child_start"], following["child_start"]):
            child, behind = table[children[c]], table[children[c] + np.uint64(1)]
            split, last = child["run_split"], behind["run_start"]
            _add_child(front, child, split, last, last, runs, stack, stack, update_at, update_ld, width)
    return np.uint64(len(inverse))
