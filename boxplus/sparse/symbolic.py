"""Symbolic analysis of a sparse Cholesky factorisation: tree, groups of columns (supernodes) and their rows, in Numba.

Everything is counted in blocks. Columns are in elimination order, and `n` stands for "no parent". Sources: Liu, "The role of
elimination trees in sparse factorization" (1990); Davis, "Direct Methods for Sparse Linear Systems" (2006), chapter 4;
Ashcraft and Grimes, "The influence of relaxed supernode partitions on the multifrontal method" (1989).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

Indices = NDArray[np.int64]

# Time of a front in nanoseconds, see `front_time`; fitted on pose graphs.
TIME_FRONT = 100.0
TIME_COLUMN = 8.0
TIME_PANEL = 0.8
TIME_UPDATE = 0.5
TIME_FLOP = 0.025


@kernel
def rows_before(col_start: Indices, row: Indices, position: Indices) -> tuple[Indices, Indices]:
    """For each position the earlier positions that it has a block with: CSR of the strictly lower triangle."""
    n = len(position)
    begin = np.zeros(n + 1, np.int64)
    for column in range(n):
        for k in range(col_start[column] + 1, col_start[column + 1]):
            begin[max(position[row[k]], position[column]) + 1] += 1
    for k in range(n):
        begin[k + 1] += begin[k]
    fill = begin[:n].copy()
    before = np.empty(begin[n], np.int64)
    for column in range(n):
        for k in range(col_start[column] + 1, col_start[column + 1]):
            a, b = position[row[k]], position[column]
            before[fill[max(a, b)]] = min(a, b)
            fill[max(a, b)] += 1
    return begin, before


@kernel
def elimination_tree(begin: Indices, before: Indices) -> Indices:
    """Parent of each column, by Liu's algorithm with path compression."""
    n = len(begin) - 1
    parent, ancestor = np.full(n, n), np.full(n, n)
    for i in range(n):
        for k in range(begin[i], begin[i + 1]):
            j = before[k]
            while ancestor[j] != i:
                following = ancestor[j]
                ancestor[j] = i
                if following == n:
                    parent[j] = i
                    break
                j = following
    return parent


@kernel
def below_counts(begin: Indices, before: Indices, parent: Indices, sizes: Indices) -> Indices:
    """Scalar rows below the diagonal block in each column of the factor, by walking the row subtrees."""
    n = len(parent)
    count, seen = np.zeros(n, np.int64), np.full(n, n)
    for i in range(n):
        seen[i] = i
        for k in range(begin[i], begin[i + 1]):
            j = before[k]
            while seen[j] != i:
                seen[j] = i
                count[j] += sizes[i]
                j = parent[j]
    return count


@kernel
def front_time(width: int, below: int) -> float:
    """Expected time [ns] of a front: overhead, pivots, filling the panel, handing the update on, arithmetic."""
    w, r = float(width), float(below)
    flops = w * (w * w / 3.0 + w * r + r * r)
    return TIME_FRONT + TIME_COLUMN * w + TIME_PANEL * w * (w + r) + TIME_UPDATE * r * r + TIME_FLOP * flops


@kernel
def merge_columns(parent: Indices, sizes: Indices, below: Indices) -> Indices:
    """Group of each column, named by its last column: children join their parent where that is expected to save time."""
    n = len(parent)
    width, group = sizes.copy(), np.arange(n)
    first_child, next_child = np.full(n + 1, n), np.full(n, n)
    for p in range(n):
        while True:
            best, gain, best_before, last = n, 0.0, n, n
            c = first_child[p]
            while c != n:
                apart = front_time(width[p], below[p]) + front_time(width[c], below[c])
                saved = apart - front_time(width[p] + width[c], below[p])
                if saved > gain:
                    best, gain, best_before = c, saved, last
                last, c = c, next_child[c]
            if best == n:
                break
            if best_before == n:
                first_child[p] = next_child[best]
            else:
                next_child[best_before] = next_child[best]
            width[p] += width[best]
            group[best] = p
            c = first_child[best]
            while c != n:
                following = next_child[c]
                next_child[c] = first_child[p]
                first_child[p] = c
                c = following
        next_child[p] = first_child[parent[p]]
        first_child[parent[p]] = p
    for p in range(n - 1, -1, -1):
        group[p] = group[group[p]]
    return group


@kernel
def order_groups(parent: Indices, group: Indices) -> tuple[Indices, Indices, Indices]:
    """Postorder the groups.

    Returns `(order, first, group_parent)`: the columns in their new order, the first column of each group in it (one more
    entry at the end), and the parent of each group (their number where there is none).
    """
    n = len(parent)
    first_child, next_child, members, following = np.full(n + 1, n), np.full(n, n), np.full(n, n), np.full(n, n)
    for c in range(n - 1, -1, -1):
        if group[c] == c:
            p = parent[c] if parent[c] == n else group[parent[c]]
            next_child[c] = first_child[p]
            first_child[p] = c
        following[c] = members[group[c]]
        members[group[c]] = c
    order, first, number = np.empty(n, np.int64), np.empty(n + 1, np.int64), np.empty(n + 1, np.int64)
    stack = np.empty(n + 1, np.int64)
    groups, columns, depth = 0, 0, 0
    root = first_child[n]
    while root != n:
        stack[0], depth = root, 1
        root = next_child[root]
        while depth > 0:
            g = stack[depth - 1]
            c = first_child[g]
            if c != n:
                first_child[g] = next_child[c]
                stack[depth] = c
                depth += 1
                continue
            depth -= 1
            number[g], first[groups] = groups, columns
            groups += 1
            c = members[g]
            while c != n:
                order[columns] = c
                columns += 1
                c = following[c]
    first[groups] = n
    group_parent = np.empty(groups, np.int64)
    for c in range(n):
        if group[c] == c:
            group_parent[number[c]] = groups if parent[c] == n else number[group[parent[c]]]
    return order, first[: groups + 1], group_parent


@kernel
def group_rows(begin: Indices, before: Indices, group_of: Indices, group_parent: Indices) -> tuple[Indices, Indices]:
    """Block rows below each group, ascending: CSR over groups."""
    groups, n = len(group_parent), len(group_of)
    start = np.zeros(groups + 1, np.int64)
    fill = np.zeros(groups, np.int64)
    rows = np.empty(0, np.int64)
    for filling in range(2):
        seen = np.full(groups, n)
        for i in range(n):
            seen[group_of[i]] = i
            for k in range(begin[i], begin[i + 1]):
                g = group_of[before[k]]
                while seen[g] != i:
                    seen[g] = i
                    if filling:
                        rows[fill[g]] = i
                        fill[g] += 1
                    else:
                        start[g + 1] += 1
                    g = group_parent[g]
        if not filling:
            for g in range(groups):
                start[g + 1] += start[g]
                fill[g] = start[g]
            rows = np.empty(start[groups], np.int64)
    return start, rows
