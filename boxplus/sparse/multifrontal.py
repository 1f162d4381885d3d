"""The numeric multifrontal factorisation over the fronts of `supernodes`.

Duff and Reid, "The multifrontal solution of indefinite sparse symmetric linear equations" (1983); Liu, "The multifrontal
method for sparse matrix solution" (1992).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.sparse.dense_kernels import Buffer, factor_panel
from boxplus.sparse.supernodes import DIAGONAL, STORED
from boxplus.sparse.vector_tiles import add

Table = NDArray[np.void]
Indices = NDArray[np.uint64]

SINGULAR = 1e-13
"""A pivot that has lost all but this share of its diagonal entry is rounding error: the matrix is singular. Scaling a matrix
does not change the share; it is above 1e-8 on the usual pose graphs."""

_ZERO, _ONE = np.uint64(0), np.uint64(1)
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
                for j in range(i + _ONE):
                    factor[target + i + j * ld] = values[source + i * columns + j]
        else:
            for i in range(rows):
                for j in range(columns):
                    factor[target + j + i * ld] = values[source + i * columns + j]


@kernel(inline=True)
def _add_child(child: Table, first: np.uint64, split: np.uint64, last: np.uint64, runs: Table, stack: Buffer,
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
            for b in range(a + _ONE, last):
                add(target, to + runs[b]["parent"] - shift, stack, source + runs[b]["child"], runs[b]["length"])


@kernel(inline=True)
def _fill_front(g: np.uint64, table: Table, entries: Table, scalar_order: Indices, values: Buffer, diagonal: Buffer,
                factor: Buffer, entries_of_diagonal: Buffer) -> None:  # fmt: skip
    """Fill the panel with the blocks of the matrix and damping."""
    front = table[g]
    column, at, ld = front["column"], front["panel_at"], front["panel_ld"]
    for k in range(at, at + front["width"] * ld):
        factor[k] = 0.0
    _fill_panel(front["entry_start"], table[g + _ONE]["entry_start"], ld, entries, values, factor)
    for k in range(front["width"]):
        entry = factor[at + k + k * ld] + diagonal[scalar_order[column + k]]
        factor[at + k + k * ld] = entry
        entries_of_diagonal[column + k] = entry


@kernel
def _open_parent(p: np.uint64, table: Table, entries: Table, scalar_order: Indices, values: Buffer, diagonal: Buffer,
                 factor: Buffer, stack: Buffer, entries_of_diagonal: Buffer) -> None:  # fmt: skip
    """What an eager front needs before its first child."""
    _fill_front(p, table, entries, scalar_order, values, diagonal, factor, entries_of_diagonal)
    at = table[p]["update_at"]
    for k in range(at, at + table[p]["below"] * table[p]["update_ld"]):
        stack[k] = 0.0


@kernel
def _add_to_parent(g: np.uint64, table: Table, runs: Table, factor: Buffer, stack: Buffer) -> None:
    """Add a whole update matrix to an eager parent."""
    front, last, parent = table[g], table[g + _ONE]["run_start"], table[table[g]["parent"]]
    at, ld = parent["panel_at"], parent["panel_ld"]
    _add_child(front, front["run_start"], front["run_split"], last, runs, stack, factor, at, ld, _ZERO)
    at, ld = parent["update_at"], parent["update_ld"]
    _add_child(front, front["run_split"], last, last, runs, stack, stack, at, ld, parent["width"])


@kernel(inline=True)
def _begin_front(g: np.uint64, table: Table, children: Indices, runs: Table, entries: Table, scalar_order: Indices,
                 values: Buffer, diagonal: Buffer, factor: Buffer, stack: Buffer,
                 entries_of_diagonal: Buffer) -> None:  # fmt: skip
    """Fill the panel: blocks of the matrix, damping, and what the children add to it. An eager front has all that already."""
    front = table[g]
    if front["eager"]:
        return
    _fill_front(g, table, entries, scalar_order, values, diagonal, factor, entries_of_diagonal)
    for c in range(front["child_start"], table[g + _ONE]["child_start"]):
        child, last = table[children[c]], table[children[c] + _ONE]["run_start"]
        at, ld = front["panel_at"], front["panel_ld"]
        _add_child(child, child["run_start"], child["run_split"], last, runs, stack, factor, at, ld, _ZERO)


@kernel(inline=True)
def _end_front(g: np.uint64, table: Table, children: Indices, runs: Table, entries: Table, scalar_order: Indices,
               values: Buffer, diagonal: Buffer, factor: Buffer, stack: Buffer, pivots: Buffer,
               entries_of_diagonal: Buffer) -> np.uint64:  # fmt: skip
    """Add the rest of the children's update matrices to this one, and this one to an eager parent.

    Returns the first column that is singular, or width.
    """
    front = table[g]
    column, width = front["column"], front["width"]
    for k in range(width):
        if pivots[column + k] <= SINGULAR * entries_of_diagonal[column + k]:
            return np.uint64(k)
    if not front["eager"]:
        for c in range(front["child_start"], table[g + _ONE]["child_start"]):
            child, last = table[children[c]], table[children[c] + _ONE]["run_start"]
            _add_child(child, child["run_split"], last, last, runs, stack, stack, front["update_at"], front["update_ld"], width)
    p = front["parent"]
    if p + _ONE < len(table) and table[p]["eager"]:
        if children[table[p]["child_start"]] == g:
            _open_parent(p, table, entries, scalar_order, values, diagonal, factor, stack, entries_of_diagonal)
        _add_to_parent(g, table, runs, factor, stack)
    return np.uint64(width)


@kernel
def begin_front(g: np.uint64, table: Table, children: Indices, runs: Table, entries: Table, scalar_order: Indices, values: Buffer,
                diagonal: Buffer, factor: Buffer, stack: Buffer, entries_of_diagonal: Buffer) -> None:  # fmt: skip
    """See `_begin_front`; for a front that several threads work on."""
    _begin_front(g, table, children, runs, entries, scalar_order, values, diagonal, factor, stack, entries_of_diagonal)


@kernel
def end_front(g: np.uint64, table: Table, children: Indices, runs: Table, entries: Table, scalar_order: Indices,
              values: Buffer, diagonal: Buffer, factor: Buffer, stack: Buffer, pivots: Buffer,
              entries_of_diagonal: Buffer) -> np.uint64:  # fmt: skip
    """See `_end_front`; for a front that several threads work on."""
    return _end_front(  # type: ignore[no-any-return]
        g, table, children, runs, entries, scalar_order, values, diagonal, factor, stack, pivots, entries_of_diagonal
    )


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
        front = table[g]
        column, width, rows = front["column"], front["width"], front["width"] + front["below"]
        _begin_front(g, table, children, runs, entries, scalar_order, values, diagonal, factor, stack, entries_of_diagonal)
        at, ld, update_at, update_ld = front["panel_at"], front["panel_ld"], front["update_at"], front["update_ld"]
        failed = factor_panel(factor, at, ld, rows, width, inverse, pivots, column, stack, update_at, update_ld, front["eager"])
        if failed == width:
            failed = _end_front(
                g, table, children, runs, entries, scalar_order, values, diagonal, factor, stack, pivots, entries_of_diagonal
            )
        if failed < width:
            return np.uint64(column + failed)
    return np.uint64(len(inverse))
