"""One update of the Bayes tree, from the variables that are touched to the new δ: a single call."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.optimization.incremental.elimination import (
    eliminate,
    place_cliques,
    remove_cliques,
    space_needed,
    substitute_back,
)
from boxplus.optimization.incremental.records import NONE, ROOT
from boxplus.optimization.incremental.structure import (
    affected_cliques,
    affected_variables,
    eliminate_symbolically,
    hyperedges,
    orphans_of,
    top_factors,
)
from boxplus.sparse.dense_kernels import Buffer

Indices = NDArray[np.int64]
Table = NDArray[np.void]

DONE, NEEDS_ROOM, SINGULAR = 0, 1, 2


@kernel
def _by_owner(owner: Indices, factors: Indices, groups: int) -> tuple[Indices, Indices]:
    """The factors of each group: CSR. `owner` has those of the factors first."""
    start = np.zeros(groups + 1, np.int64)
    for k in range(len(factors)):
        start[owner[k] + 1] += 1
    for g in range(groups):
        start[g + 1] += start[g]
    fill, owned = start[:groups].copy(), np.empty(len(factors), np.int64)
    for k in range(len(factors)):
        owned[fill[owner[k]]] = factors[k]
        fill[owner[k]] += 1
    return start, owned


@kernel
def _children(group_parent: Indices, orphan_owner: Indices) -> tuple[Indices, Indices]:
    """Lists of the children of each group: groups by their numbers, then orphans; the last entry of the heads is for roots."""
    groups = len(group_parent)
    head, following = np.full(groups + 1, NONE), np.full(groups + len(orphan_owner), NONE)
    for k in range(len(orphan_owner) - 1, -1, -1):
        following[groups + k] = head[orphan_owner[k]]
        head[orphan_owner[k]] = groups + k
    for g in range(groups - 1, -1, -1):
        following[g] = head[group_parent[g]]
        head[group_parent[g]] = g
    return head, following


@kernel
def _link(placed: Indices, head: Indices, following: Indices, records: Indices, mark: int, table: Table) -> None:
    """Put the new cliques on top of the tree, orphans below them."""
    groups = len(placed)
    for g in range(groups):
        previous, child = NONE, head[g]
        while child != NONE:
            c = records[child]
            table[c]["parent"] = placed[g]
            if previous == NONE:
                table[placed[g]]["first_child"] = c
            else:
                table[previous]["next_sibling"] = c
            table[c]["next_sibling"] = NONE
            previous, child = c, following[child]
    # Roots that were not touched stay, the new ones come before them.
    kept, last = NONE, NONE
    c = table[ROOT]["first_child"]
    while c != NONE:
        after = table[c]["next_sibling"]
        if table[c]["parent"] == ROOT and table[c]["mark"] != mark:
            if last == NONE:
                kept = c
            else:
                table[last]["next_sibling"] = c
            last = c
            table[c]["next_sibling"] = NONE
        c = after
    child = head[groups]
    while child != NONE:
        c = records[child]
        table[c]["parent"], table[c]["next_sibling"] = ROOT, kept
        kept, child = c, following[child]
    table[ROOT]["first_child"] = kept


@kernel
def update_tree(mark: int, seeds: Indices, last: Indices, wildfire: float, table: Table, tops: Indices,
                free_cliques: Indices, numbers: Buffer, number_heads: Indices, integers: Indices, integer_heads: Indices,
                dof: Indices, start: Indices, delta: Buffer, information: Buffer, clique_of: Indices, variable_mark: Indices,
                local: Indices, adjacency: Indices, next_entry: Indices, factor_of: Indices, factor_start: Indices,
                factor_variables: Indices, factor_mark: Indices, contribution_at: Indices, contributions: Buffer,
                found: Indices, scratch: Indices, changed: Indices, counts: Indices) -> int:  # fmt: skip
    """Eliminate what is touched anew, and solve.

    Args:
        mark: number of this call, ascending.
        seeds: variables whose factors are new or have changed, and new variables.
        last: variables that are eliminated last, of those that are eliminated.
        found, scratch: as long as the factors, as the table of cliques.
        changed: receives the variables whose δ has changed.
        counts: receives variables changed, variables solved for, variables and cliques eliminated; with NEEDS_ROOM in [0] and [1]
            the numbers and integers needed, with SINGULAR in [0] the variable.

    Returns:
        DONE, or NEEDS_ROOM and SINGULAR, which leave the tree as it was.
    """
    removed = scratch[: affected_cliques(seeds, clique_of, table, mark, scratch)].copy()
    variables = affected_variables(seeds, removed, clique_of, table, integers, mark, variable_mark, local)
    factors = found[
        : top_factors(
            variables, variable_mark, mark, adjacency, next_entry, factor_of, factor_start, factor_variables, factor_mark, found
        )
    ]
    orphans = orphans_of(removed, table, mark)
    edge_start, members = hyperedges(factors, factor_start, factor_variables, orphans, table, integers, local)
    is_last = np.zeros(len(variables), np.bool_)
    for v in last:
        if variable_mark[v] == mark:
            is_last[local[v]] = True
    order, first, group_parent, row_start, rows, owner = eliminate_symbolically(edge_start, members, dof[variables], is_last)
    variable_at = variables[order]
    sizes = dof[variable_at]
    space_needed(first, row_start, rows, sizes, counts)
    if tops[0] + counts[0] > len(numbers) or tops[1] + counts[1] > len(integers):
        return NEEDS_ROOM
    placed = place_cliques(
        first, row_start, rows, sizes, variable_at, mark, table, tops, free_cliques, numbers, number_heads, integers,
        integer_heads,
    )  # fmt: skip
    groups = len(placed)
    owned_start, owned = _by_owner(owner, factors, groups)
    head, following = _children(group_parent, owner[len(factors) :])
    records = np.concatenate((placed, orphans))
    # `local` has served; it is where the elimination keeps the rows of a front.
    failed = eliminate(
        placed, owned_start, owned, head, following, records, table, integers, dof, local, factor_start, factor_variables,
        contribution_at, contributions, numbers,
    )  # fmt: skip
    if failed >= 0:
        remove_cliques(placed, table, tops, free_cliques, numbers, number_heads, integers, integer_heads)
        counts[0] = failed
        return SINGULAR
    remove_cliques(removed, table, tops, free_cliques, numbers, number_heads, integers, integer_heads)
    for c in placed:
        for k in range(table[c]["variables_at"], table[c]["variables_at"] + table[c]["frontals"]):
            clique_of[integers[k]] = c
    _link(placed, head, following, records, mark, table)
    substitute_back(
        table, mark, wildfire, integers, numbers, dof, start, delta, information, variable_mark, scratch, changed, counts
    )
    counts[2], counts[3] = len(variables), groups
    return DONE
