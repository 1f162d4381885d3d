"""What an update takes off the tree, and the structure of what is put in its place (symbolic part of an update).

Sources: Kaess, Johannsson, Roberts, Ila, Leonard, Dellaert, "iSAM2: Incremental smoothing and mapping using the Bayes tree",
Int. J. Robotics Research 31(2), 2012, algorithms 3 to 6; Liu 1990 and Ashcraft and Grimes 1989 as in `sparse.symbolic`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.optimization.incremental.records import NONE, ROOT
from boxplus.sparse.orderings.clique_ordering import order_cliques
from boxplus.sparse.symbolic import below_counts, elimination_tree, group_rows, merge_columns, order_groups

Indices = NDArray[np.int64]
Table = NDArray[np.void]


@kernel
def affected_cliques(seeds: Indices, clique_of: Indices, table: Table, mark: int, cliques: Indices) -> int:
    """Mark the cliques that eliminate `seeds` and all above them; returns their number."""
    count = 0
    for v in seeds:
        c = clique_of[v]
        while c != NONE and c != ROOT and table[c]["mark"] != mark:
            table[c]["mark"] = mark
            cliques[count] = c
            count += 1
            c = table[c]["parent"]
    return count


@kernel
def affected_variables(seeds: Indices, cliques: Indices, clique_of: Indices, table: Table, variables_in: Indices, mark: int,
                       variable_mark: Indices, local: Indices) -> Indices:  # fmt: skip
    """The variables that are eliminated anew, those of the cliques and new ones, ascending; `local` receives their places."""
    count = 0
    for c in cliques:
        count += table[c]["frontals"]
    found = np.empty(count + len(seeds), np.int64)
    count = 0
    for c in cliques:
        at = table[c]["variables_at"]
        for k in range(at, at + table[c]["frontals"]):
            found[count] = variables_in[k]
            variable_mark[found[count]] = mark
            count += 1
    for v in seeds:
        if clique_of[v] == NONE and variable_mark[v] != mark:
            found[count] = v
            variable_mark[v] = mark
            count += 1
    variables = np.sort(found[:count])
    for k in range(count):
        local[variables[k]] = k
    return variables


@kernel
def top_factors(variables: Indices, variable_mark: Indices, mark: int, adjacency: Indices, next_entry: Indices,
                factor_of: Indices, factor_start: Indices, factor_variables: Indices, factor_mark: Indices,
                found: Indices) -> int:  # fmt: skip
    """The factors all of whose variables are eliminated anew; returns their number."""
    count = 0
    for v in variables:
        entry = adjacency[v]
        while entry != NONE:
            f = factor_of[entry]
            entry = next_entry[entry]
            if factor_mark[f] == mark:
                continue
            factor_mark[f] = mark
            inside = True
            for k in range(factor_start[f], factor_start[f + 1]):
                inside = inside and variable_mark[factor_variables[k]] == mark
            if inside:
                found[count] = f
                count += 1
    return count


@kernel
def orphans_of(cliques: Indices, table: Table, mark: int) -> Indices:
    """The subtrees that stay as they are: children of cliques that are taken off."""
    count = 0
    for filling in range(2):
        orphans = np.empty(count, np.int64)
        count = 0
        for c in cliques:
            child = table[c]["first_child"]
            while child != NONE:
                if table[child]["mark"] != mark:
                    if filling:
                        orphans[count] = child
                    count += 1
                child = table[child]["next_sibling"]
    return orphans


@kernel
def hyperedges(factors: Indices, factor_start: Indices, factor_variables: Indices, orphans: Indices, table: Table,
               variables_in: Indices, local: Indices) -> tuple[Indices, Indices]:  # fmt: skip
    """What joins the variables, in places: first the factors, then the separators of the orphans; each variable once."""
    room = 0
    for f in factors:
        room += factor_start[f + 1] - factor_start[f]
    for c in orphans:
        room += table[c]["separators"]
    start, members = np.zeros(len(factors) + len(orphans) + 1, np.int64), np.empty(room, np.int64)
    used, e = 0, 0
    for f in factors:
        for k in range(factor_start[f], factor_start[f + 1]):
            v, fresh = local[factor_variables[k]], True
            for m in range(start[e], used):
                fresh = fresh and members[m] != v
            if fresh:
                members[used] = v
                used += 1
        e += 1
        start[e] = used
    for c in orphans:
        at = table[c]["variables_at"] + table[c]["frontals"]
        for k in range(at, at + table[c]["separators"]):
            members[used] = local[variables_in[k]]
            used += 1
        e += 1
        start[e] = used
    return start, members[:used]


@kernel
def _stars(start: Indices, members: Indices, position: Indices, owner: Indices) -> tuple[Indices, Indices]:
    """For each position the earlier ones it has to be joined with: a clique is joined by what is eliminated first of it."""
    n = len(position)
    begin = np.zeros(n + 1, np.int64)
    for e in range(len(start) - 1):
        first = n
        for k in range(start[e], start[e + 1]):
            first = min(first, position[members[k]])
        owner[e] = first
        for k in range(start[e], start[e + 1]):
            if position[members[k]] != first:
                begin[position[members[k]] + 1] += 1
    for k in range(n):
        begin[k + 1] += begin[k]
    fill, before = begin[:n].copy(), np.empty(begin[n], np.int64)
    for e in range(len(start) - 1):
        for k in range(start[e], start[e + 1]):
            p = position[members[k]]
            if p != owner[e]:
                before[fill[p]] = owner[e]
                fill[p] += 1
    return begin, before


@kernel
def eliminate_symbolically(start: Indices, members: Indices, sizes: Indices, is_last: NDArray[np.bool_]) -> tuple[
    Indices, Indices, Indices, Indices, Indices, Indices
]:  # fmt: skip
    """Order the variables and group them into cliques.

    Args:
        start, members: see `hyperedges`.
        sizes: (n,) degrees of freedom.
        is_last: (n,) variables that are eliminated last.

    Returns:
        order (n,), place of the variable at each position; first (groups + 1,), the first position of each group, children
        before parents; parent (groups,), `groups` for none; row_start, rows: positions below each group, ascending; owner, the
        group that eliminates the first variable of each hyperedge.
    """
    n = len(sizes)
    order = order_cliques(start, members, sizes, is_last)
    position, owner = np.empty(n, np.int64), np.empty(len(start) - 1, np.int64)
    for k in range(n):
        position[order[k]] = k
    begin, before = _stars(start, members, position, owner)
    parent = elimination_tree(begin, before)
    ordered = sizes[order]
    group = merge_columns(parent, ordered, below_counts(begin, before, parent, ordered))
    again, first, group_parent = order_groups(parent, group)
    order = order[again]
    for k in range(n):
        position[order[k]] = k
    begin, before = _stars(start, members, position, owner)
    groups = len(group_parent)
    group_of = np.empty(n, np.int64)
    for g in range(groups):
        group_of[first[g] : first[g + 1]] = g
    row_start, rows = group_rows(begin, before, group_of, group_parent)
    for e in range(len(owner)):
        owner[e] = group_of[owner[e]]
    return order, first, group_parent, row_start, rows, owner
