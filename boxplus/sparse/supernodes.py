"""Fronts: the dense matrices that a multifrontal factorisation works on, laid out in memory once for many factorisations.

A front eliminates the columns of one supernode. Its panel, `width + below` rows by `width` columns, becomes part of the factor
L; its update matrix, `below` by `below`, is what the elimination adds to the later rows, and is added to the parent front.
Both are column-major. Update matrices live in two stacks that grow towards each other, one for the even and one for the odd
levels of the tree, so that a front's own update matrix can be formed while those of its children are still there. Each of the
subtrees that threads work on side by side has its own pair of stacks, and so has the rest of the tree. Where very many
children would wait for their parent (landmarks for a camera), the parent's memory is there first and each child adds its
update matrix at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.sparse.block_matrix import BlockPattern
from boxplus.sparse.subtrees import split_tree
from boxplus.sparse.symbolic import (
    Indices,
    below_counts,
    elimination_tree,
    group_rows,
    merge_columns,
    order_groups,
    rows_before,
)

FRONT = np.dtype(
    [
        (name, np.uint64)
        for name in (
            "column",  # first scalar column
            "width",  # scalar columns
            "below",  # scalar rows below the columns
            "panel_at",  # first element of the panel in the factor
            "panel_ld",  # its column stride
            "update_at",  # first element of the update matrix in the stack
            "update_ld",
            "child_start",  # first entry in `children`
            "run_start",  # first entry in `runs`
            "run_split",  # first run that lies below the parent's columns
            "entry_start",  # first entry in `entries`
            "row_start",  # first entry in `rows`
            "parent",  # index of the parent front, their number for a root
            "eager",  # 1 where each child adds its update matrix as soon as it is done, 0 where all wait for the front's turn
        )
    ]
)
"""A front; the table has one more record at its end, so that a range is that of a record and the next one."""

RUN = np.dtype([("child", np.uint64), ("parent", np.uint64), ("length", np.uint64)])
"""Rows of an update matrix that follow one another in the parent front too: first row here, first row there."""

ENTRY = np.dtype([("source", np.uint64), ("target", np.uint64), ("rows", np.uint64), ("columns", np.uint64), ("kind", np.uint64)])
"""A block of the matrix: first value, first element in the factor, size as stored; kind as below."""
STORED, TRANSPOSED, DIAGONAL = 0, 1, 2

ALIGNMENT = 8  # elements, a cache line
MANY_CHILDREN, MUCH_MEMORY = 8, 4  # from how many children, and how many times a front's own memory, they do not wait


@dataclass(frozen=True, slots=True)
class Fronts:
    """The result of the symbolic analysis.

    Attributes:
        sizes: (n,) int64, degrees of freedom of the variables.
        order: (n,) int64, variable at each position of the elimination order.
        scalar_order: (N,) uint64, scalar row of the matrix at each position.
        scalar_of: (n,) uint64, scalar position of each variable in the elimination order.
        front_of: (n,) uint64, front that eliminates each variable.
        table: (fronts + 1,) FRONT, children before parents.
        children: (fronts,) uint64.
        sequence: (fronts,) uint64, order of work: subtree after subtree, then the rest.
        parts: (subtrees + 2,) int64, where each subtree and the rest begin in `sequence`, and its end.
        runs: RUN records.
        entries: ENTRY records, by front.
        rows: uint64, scalar rows below each front, in elimination order.
        factor_size: elements of the factor's panels.
        stack_size: elements of the stacks of update matrices.
    """

    sizes: NDArray[np.int64]
    order: NDArray[np.int64]
    scalar_order: NDArray[np.uint64]
    scalar_of: NDArray[np.uint64]
    front_of: NDArray[np.uint64]
    table: NDArray[np.void]
    children: NDArray[np.uint64]
    sequence: NDArray[np.uint64]
    parts: NDArray[np.int64]
    runs: NDArray[np.void]
    entries: NDArray[np.void]
    rows: NDArray[np.uint64]
    factor_size: int
    stack_size: int


def _strides(rows: Indices) -> Indices:
    """Column strides of matrices: whole cache lines where it is worth it, never a large power of two."""
    padded = (rows + ALIGNMENT - 1) // ALIGNMENT * ALIGNMENT
    return np.where(rows < 4 * ALIGNMENT, rows, np.where(padded % 64 == 0, padded + ALIGNMENT, padded))


@kernel
def _eager_fronts(parent: Indices, size: Indices) -> Indices:
    """1 for fronts whose many children together would hold much more memory than their own update matrix."""
    groups = len(parent)
    count, total = np.zeros(groups + 1, np.int64), np.zeros(groups + 1, np.int64)
    for g in range(groups):
        count[parent[g]] += 1
        total[parent[g]] += size[g]
    return ((count[:groups] >= MANY_CHILDREN) & (total[:groups] > MUCH_MEMORY * size)).astype(np.int64)


@kernel
def _stack_offsets(parent: Indices, size: Indices, eager: Indices, part: Indices, parts: int) -> tuple[Indices, int]:
    """Place of each update matrix, and the size of all stacks together. Every part of the tree has two stacks of its own."""
    groups = len(parent)
    level, offset, first = np.zeros(groups + 1, np.int64), np.zeros(groups, np.int64), np.arange(groups + 1)
    for g in range(groups - 1, -1, -1):
        level[g] = level[parent[g]] + 1 if parent[g] < groups else 0
    for g in range(groups):
        first[parent[g]] = min(first[parent[g]], first[g])
    lowest_child, opened = np.full(groups + 1, groups), np.empty(groups, np.int64)
    top, peak, base = np.zeros((parts, 2), np.int64), np.zeros(parts, np.int64), np.zeros(parts + 1, np.int64)
    for g in range(groups):
        p, count, q = part[g], 0, g
        if not eager[g]:
            opened[0], count = g, 1
        # What is allocated now: the front's own update matrix, and those of eager fronts above it that it is the first below.
        while q < groups and first[q] == g:
            if eager[q]:
                opened[count] = q
                count += 1
            q = parent[q]
        for k in range(count - 1, -1, -1):
            q = opened[k]
            side = level[q] % 2
            offset[q] = top[p, side]
            top[p, side] += size[q]
        peak[p] = max(peak[p], top[p, 0] + top[p, 1])
        if lowest_child[g] < groups:
            top[p, 1 - level[g] % 2] = offset[lowest_child[g]]
        if parent[g] < groups and part[parent[g]] == p:
            if eager[parent[g]]:
                top[p, level[g] % 2] = offset[g]
            else:
                lowest_child[parent[g]] = min(lowest_child[parent[g]], g)
    for p in range(parts):
        base[p + 1] = base[p] + peak[p]
    for g in range(groups):
        p = part[g]
        offset[g] = base[p + 1] - offset[g] - size[g] if level[g] % 2 else base[p] + offset[g]
    return offset, base[parts]


@kernel
def _runs(first: Indices, parent: Indices, row_start: Indices, rows: Indices, group_of: Indices, start: Indices,
          run_start: Indices, run_split: Indices, runs: NDArray[np.uint64]) -> None:  # fmt: skip
    """Where the rows of each front lie in its parent."""
    groups, count = len(parent), 0
    for g in range(groups):
        run_start[g] = count
        run_split[g] = count
        p = parent[g]
        if p == groups:
            continue
        base, width = start[first[p]], start[first[p + 1]] - start[first[p]]
        here, behind, q = 0, width, row_start[p]
        begun, expected = False, 0
        for k in range(row_start[g], row_start[g + 1]):
            i = rows[k]
            size = start[i + 1] - start[i]
            if group_of[i] == p:
                there = start[i] - base
            else:
                while rows[q] != i:
                    behind += start[rows[q] + 1] - start[rows[q]]
                    q += 1
                there = behind
            if begun and there == expected and (there != width):
                runs[count - 1, 2] += size
            else:
                runs[count, 0], runs[count, 1], runs[count, 2] = here, there, size
                count += 1
                begun = True
            if there < width:
                run_split[g] = count
            expected = there + size
            here += size
    run_start[groups] = count


@kernel
def _entries(col_start: Indices, row: Indices, value_start: Indices, position: Indices, group_of: Indices, first: Indices,
             row_start: Indices, rows: Indices, start: Indices, panel_at: Indices, panel_ld: Indices,
             entry_start: Indices, entries: NDArray[np.uint64]) -> None:  # fmt: skip
    """Where each block of the matrix goes in the factor."""
    groups, n = len(first) - 1, len(position)
    for column in range(n):
        for k in range(col_start[column], col_start[column + 1]):
            entry_start[group_of[min(position[row[k]], position[column])] + 1] += 1
    for g in range(groups):
        entry_start[g + 1] += entry_start[g]
    fill, block, column_of = entry_start[:groups].copy(), np.empty(len(row), np.int64), np.empty(len(row), np.int64)
    for column in range(n):
        for k in range(col_start[column], col_start[column + 1]):
            g = group_of[min(position[row[k]], position[column])]
            block[fill[g]], column_of[fill[g]] = k, column
            fill[g] += 1
    local = np.zeros(n, np.int64)
    for g in range(groups):
        base = start[first[g]]
        for i in range(first[g], first[g + 1]):
            local[i] = start[i] - base
        behind = start[first[g + 1]] - base
        for k in range(row_start[g], row_start[g + 1]):
            local[rows[k]] = behind
            behind += start[rows[k] + 1] - start[rows[k]]
        at, ld = panel_at[g], panel_ld[g]
        for e in range(entry_start[g], entry_start[g + 1]):
            k = block[e]
            a, b = position[row[k]], position[column_of[e]]
            entries[e, 0] = value_start[k]
            entries[e, 1] = at + local[max(a, b)] + ld * local[min(a, b)]
            entries[e, 2] = start[a + 1] - start[a]
            entries[e, 3] = start[b + 1] - start[b]
            entries[e, 4] = DIAGONAL if a == b else (STORED if a > b else TRANSPOSED)


def lay_out(pattern: BlockPattern, order: NDArray[np.int64], threads: int) -> Fronts:
    """Analyse a pattern in the given elimination order (variable at each position) for a number of threads."""
    n = len(pattern.sizes)
    position = np.empty(n, np.int64)
    position[order] = np.arange(n)
    begin, before = rows_before(pattern.col_start, pattern.row, position)
    sizes = pattern.sizes[order]
    parent = elimination_tree(begin, before)
    group = merge_columns(parent, sizes, below_counts(begin, before, parent, sizes))
    again, first, group_parent = order_groups(parent, group)
    order, sizes = order[again], sizes[again]
    position[order] = np.arange(n)
    begin, before = rows_before(pattern.col_start, pattern.row, position)
    groups = len(group_parent)
    group_of = np.repeat(np.arange(groups), np.diff(first))
    row_start, rows = group_rows(begin, before, group_of, group_parent)

    start = np.zeros(n + 1, np.int64)
    np.cumsum(sizes, out=start[1:])
    width = np.diff(start[first])
    scalar_rows = np.zeros(len(rows) + 1, np.int64)
    np.cumsum(sizes[rows], out=scalar_rows[1:])
    below = np.diff(scalar_rows[row_start])
    update_strides = _strides(below)
    update_sizes = (below * update_strides + ALIGNMENT - 1) // ALIGNMENT * ALIGNMENT
    eager = _eager_fronts(group_parent, update_sizes)
    part, parts = split_tree(group_parent, width, below, eager, threads)
    table = np.zeros(groups + 1, FRONT)
    table["column"] = start[first]
    table["width"][:groups], table["below"][:groups] = width, below
    panel_ld, panel_at = _strides(width + below), np.zeros(groups + 1, np.int64)
    np.cumsum((panel_ld * width + ALIGNMENT - 1) // ALIGNMENT * ALIGNMENT, out=panel_at[1:])
    table["panel_ld"][:groups], table["panel_at"] = panel_ld, panel_at
    table["update_ld"][:groups] = update_strides
    table["update_at"][:groups], stack_size = _stack_offsets(group_parent, update_sizes, eager, part, len(parts) - 1)
    table["parent"][:groups], table["eager"][:groups] = group_parent, eager
    table["row_start"] = scalar_rows[row_start]
    table["child_start"][1:] = np.cumsum(np.bincount(group_parent, minlength=groups + 1)[:groups])
    runs = np.empty((len(rows), 3), np.uint64)
    run_start, run_split, entry_start = (np.zeros(groups + 1, np.int64) for _ in range(3))
    _runs(first, group_parent, row_start, rows, group_of, start, run_start, run_split, runs)
    entries = np.empty((len(pattern.row), 5), np.uint64)
    _entries(
        pattern.col_start,
        pattern.row,
        pattern.value_start,
        position,
        group_of,
        first,
        row_start,
        rows,
        start,
        panel_at,
        panel_ld,
        entry_start,
        entries,
    )
    table["run_start"], table["run_split"], table["entry_start"] = run_start, run_split, entry_start
    return Fronts(
        sizes=pattern.sizes,
        order=order,
        scalar_order=_expand(pattern.start[order], sizes),
        scalar_of=start[position].astype(np.uint64),
        front_of=group_of[position].astype(np.uint64),
        table=table,
        children=np.argsort(group_parent, kind="stable").astype(np.uint64),
        sequence=np.argsort(part, kind="stable").astype(np.uint64),
        parts=parts,
        runs=runs[: run_start[-1]].copy().view(RUN)[:, 0],
        entries=entries.view(ENTRY)[:, 0],
        rows=_expand(start[rows], sizes[rows]),
        factor_size=int(panel_at[-1]),
        stack_size=stack_size,
    )


def _expand(first: NDArray[np.int64], sizes: NDArray[np.int64]) -> NDArray[np.uint64]:
    """The ranges `first[k] … first[k] + sizes[k]`, one after another."""
    ends = np.cumsum(sizes)
    return (np.repeat(first - ends + sizes, sizes) + np.arange(ends[-1] if len(ends) else 0)).astype(np.uint64)
