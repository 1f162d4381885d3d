"""Numeric elimination of the cliques that an update puts on top of the tree, and back-substitution down to where nothing changes.

Every clique holds its columns of L with the right-hand side as a last row, and the update matrix that its elimination leaves on
its separators (the cached factor of iSAM2): a subtree is used again without being looked into. Panels and update matrices are
those of `sparse.multifrontal`, column-major, and so are the dense kernels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.optimization.incremental.arena import block_size, give_back, take
from boxplus.optimization.incremental.records import NONE, ROOT
from boxplus.sparse.dense_kernels import Buffer, factor_panel
from boxplus.sparse.multifrontal import SINGULAR
from boxplus.sparse.prefetch import prefetch
from boxplus.sparse.triangular_solve import backward_one
from boxplus.sparse.vector_tiles import add

Indices = NDArray[np.int64]
Table = NDArray[np.void]

_ZERO = np.uint64(0)
_FETCHED = 256  # elements of a panel that are asked for ahead; what follows the processor fetches by itself


@kernel
def _stride(rows: int) -> int:
    """Column stride: whole cache lines where it is worth it, never a large power of two."""
    if rows < 32:
        return rows
    padded = (rows + 7) // 8 * 8
    return padded + 8 if padded % 64 == 0 else padded


@kernel
def _memory(width: int, below: int) -> tuple[int, int, int]:
    """Elements of a clique: up to its panel, up to its update matrix, altogether."""
    panel = (width + 7) // 8 * 8
    update = panel + (width * _stride(width + below + 1) + 7) // 8 * 8
    return panel, update, update + (below + 1) * _stride(below + 1)


@kernel
def space_needed(first: Indices, row_start: Indices, rows: Indices, sizes: Indices, needed: Indices) -> None:
    """Elements that `place_cliques` may take: needed[0] numbers, needed[1] integers."""
    needed[0], needed[1] = 0, 0
    for g in range(len(first) - 1):
        width, below = 0, 0
        for k in range(first[g], first[g + 1]):
            width += sizes[k]
        for k in range(row_start[g], row_start[g + 1]):
            below += sizes[rows[k]]
        needed[0] += block_size(_memory(width, below)[2])
        needed[1] += block_size(first[g + 1] - first[g] + row_start[g + 1] - row_start[g])


@kernel
def place_cliques(first: Indices, row_start: Indices, rows: Indices, sizes: Indices, variable_at: Indices, mark: int,
                  table: Table, tops: Indices, free_cliques: Indices, numbers: Buffer, number_heads: Indices,
                  integers: Indices, integer_heads: Indices) -> Indices:  # fmt: skip
    """Records and memory of new cliques.

    Args:
        first, row_start, rows: see `eliminate_symbolically`.
        sizes, variable_at: (n,) degrees of freedom and variable at each position.
        tops: elements used of the numbers, of the integers, records used, free records.

    Returns:
        (groups,) the records.
    """
    groups = len(first) - 1
    placed = np.empty(groups, np.int64)
    for g in range(groups):
        if tops[3] > 0:
            tops[3] -= 1
            c = free_cliques[tops[3]]
        else:
            c = tops[2]
            tops[2] += 1
        placed[g] = c
        frontals, separators = first[g + 1] - first[g], row_start[g + 1] - row_start[g]
        at = take(integers, integer_heads, tops[1:2], frontals + separators)
        width, below = 0, 0
        for k in range(frontals):
            integers[at + k] = variable_at[first[g] + k]
            width += sizes[first[g] + k]
        for k in range(separators):
            p = rows[row_start[g] + k]
            integers[at + frontals + k] = variable_at[p]
            below += sizes[p]
        panel, update, whole = _memory(width, below)
        memory = take(numbers, number_heads, tops[0:1], whole)
        record = table[c]
        record["parent"], record["first_child"], record["next_sibling"], record["mark"] = ROOT, NONE, NONE, mark
        record["frontals"], record["separators"], record["variables_at"] = frontals, separators, at
        record["width"], record["below"], record["memory_at"] = width, below, memory
        record["panel_at"], record["panel_ld"] = memory + panel, _stride(width + below + 1)
        record["update_at"], record["update_ld"] = memory + update, _stride(below + 1)
    return placed


@kernel
def remove_cliques(cliques: Indices, table: Table, tops: Indices, free_cliques: Indices, numbers: Buffer, number_heads: Indices,
                   integers: Indices, integer_heads: Indices) -> None:  # fmt: skip
    """Give records and memory of cliques back."""
    for c in cliques:
        record = table[c]
        give_back(integers, integer_heads, record["variables_at"], record["frontals"] + record["separators"])
        give_back(numbers, number_heads, record["memory_at"], _memory(record["width"], record["below"])[2])
        record["parent"] = NONE
        free_cliques[tops[3]] = c
        tops[3] += 1


@kernel
def _clear(numbers: Buffer, at: int, ld: int, columns: int, rows: int) -> None:
    """Zeros from the diagonal on: what lies above is never read."""
    for j in range(columns):
        for k in range(np.uint64(at + j * ld + j), np.uint64(at + j * ld + rows)):
            numbers[k] = 0.0


@kernel(inline=True)
def _add_factor(f: int, clique: Table, factor_start: Indices, factor_variables: Indices, dof: Indices, offset: Indices,
                contribution_at: Indices, contributions: Buffer, numbers: Buffer) -> None:  # fmt: skip
    """Add JᵀJ and −Jᵀr of a factor, (D + 1, D + 1), to a front."""
    width, below = clique["width"], clique["below"]
    panel_at, ld, update_at, update_ld = clique["panel_at"], clique["panel_ld"], clique["update_at"], clique["update_ld"]
    columns = 1
    for k in range(factor_start[f], factor_start[f + 1]):
        columns += dof[factor_variables[k]]
    source = contribution_at[f]
    for b in range(factor_start[f], factor_start[f + 1]):
        left, db = offset[factor_variables[b]], dof[factor_variables[b]]
        for j in range(db):
            column = left + j
            if column < width:
                target = panel_at + column * ld
            else:
                target = update_at + (column - width) * update_ld - width
            here = source + j * columns
            for a in range(factor_start[f], factor_start[f + 1]):
                top, da = offset[factor_variables[a]], dof[factor_variables[a]]
                if top >= left:
                    for i in range(j if top == left else 0, da):
                        numbers[target + top + i] += contributions[here + i]
                here += da
            numbers[target + width + below] += contributions[here]
        source += db * columns


@kernel
def _add_child(child: Table, clique: Table, integers: Indices, dof: Indices, offset: Indices, numbers: Buffer,
               runs: NDArray[np.int64]) -> None:  # fmt: skip
    """Add the update matrix of a child to a front; rows that follow one another there too go together.

    The child may be older than the front, and its separators in another order than the front's.
    """
    width, below = clique["width"], clique["below"]
    panel_at, ld, update_at, update_ld = clique["panel_at"], clique["panel_ld"], clique["update_at"], clique["update_ld"]
    count, here, expected = 0, 0, -1
    first = child["variables_at"] + child["frontals"]
    for k in range(first, first + child["separators"] + 1):
        if k < first + child["separators"]:
            there, size = offset[integers[k]], dof[integers[k]]
        else:
            there, size = width + below, 1
        if there == expected and there != width:
            runs[count - 1, 2] += size
        else:
            runs[count, 0], runs[count, 1], runs[count, 2] = here, there, size
            count += 1
        expected = there + size
        here += size
    for a in range(count):
        left, there, length = runs[a, 0], runs[a, 1], runs[a, 2]
        for j in range(length):
            column = there + j
            source = child["update_at"] + (left + j) * child["update_ld"]
            if column < width:
                target = panel_at + column * ld
            else:
                target = update_at + (column - width) * update_ld - width
            add(numbers, np.uint64(target + column), numbers, np.uint64(source + left + j), np.uint64(length - j))
            for b in range(a + 1, count):
                top, row, rows = runs[b, 0], runs[b, 1], runs[b, 2]
                if row > there:
                    add(numbers, np.uint64(target + row), numbers, np.uint64(source + top), np.uint64(rows))
                elif row < width:
                    for i in range(rows):
                        numbers[panel_at + (row + i) * ld + column] += numbers[source + top + i]
                else:
                    for i in range(rows):
                        numbers[update_at + (row + i - width) * update_ld + column - width] += numbers[source + top + i]


@kernel
def eliminate(placed: Indices, owned_start: Indices, owned: Indices, child_head: Indices, child_next: Indices,
              child_record: Indices, table: Table, integers: Indices, dof: Indices, offset: Indices, factor_start: Indices,
              factor_variables: Indices, contribution_at: Indices, contributions: Buffer, numbers: Buffer) -> int:  # fmt: skip
    """Eliminate new cliques, children before parents.

    Args:
        owned_start, owned: factors of each clique.
        child_head, child_next, child_record: lists of the children of each clique, old and new ones.
        offset: scratch, for every variable its first row in the front.

    Returns:
        The variable that turns out not to be determined, or −1.
    """
    most, widest = 1, 1
    for c in placed:
        most = max(most, table[c]["separators"] + 2)
        widest = max(widest, table[c]["width"])
    for c in child_record:
        most = max(most, table[c]["separators"] + 2)
    runs = np.empty((most, 3), np.int64)
    inverse, pivots, diagonal = np.empty(widest), np.empty(widest), np.empty(widest)
    for g in range(len(placed)):
        clique = table[placed[g]]
        width, below, at, ld = clique["width"], clique["below"], clique["panel_at"], clique["panel_ld"]
        row = 0
        for k in range(clique["variables_at"], clique["variables_at"] + clique["frontals"] + clique["separators"]):
            offset[integers[k]] = row
            row += dof[integers[k]]
        _clear(numbers, at, ld, width, width + below + 1)
        _clear(numbers, clique["update_at"], clique["update_ld"], below + 1, below + 1)
        for k in range(owned_start[g], owned_start[g + 1]):
            _add_factor(owned[k], clique, factor_start, factor_variables, dof, offset, contribution_at, contributions, numbers)
        child = child_head[g]
        while child != NONE:
            _add_child(table[child_record[child]], clique, integers, dof, offset, numbers, runs)
            child = child_next[child]
        for k in range(width):
            diagonal[k] = numbers[at + k * (ld + 1)]
        failed = int(
            factor_panel(
                numbers, np.uint64(at), np.uint64(ld), np.uint64(width + below + 1), np.uint64(width), inverse, pivots, _ZERO,
                numbers, np.uint64(clique["update_at"]), np.uint64(clique["update_ld"]), np.uint64(1),
            )
        )  # fmt: skip
        for k in range(failed):
            if pivots[k] <= SINGULAR * diagonal[k]:
                failed = k
                break
        if failed < width:
            k, row = clique["variables_at"], dof[integers[clique["variables_at"]]]
            while row <= failed:
                k += 1
                row += dof[integers[k]]
            return integers[k]  # type: ignore[no-any-return]
        for k in range(width):
            numbers[clique["memory_at"] + k] = inverse[k]
    return -1


@kernel
def substitute_back(table: Table, mark: int, wildfire: float, integers: Indices, numbers: Buffer, dof: Indices, start: Indices,
                    delta: Buffer, information: Buffer, variable_mark: Indices, waiting: Indices, changed: Indices,
                    counts: Indices) -> None:  # fmt: skip
    """Solve for δ in the new cliques, and below them as long as what they hang on has changed.

    Args:
        mark: of the new cliques; variables that have changed receive −mark in `variable_mark`.
        wildfire: change up to which a variable keeps the δ that it has, in standard deviations. What is kept stays within it of
            what it should be, however many small changes come together.
        information: (tangents,) what residuals say about each tangent, the others being known: one over its variance.
        waiting: scratch, as long as `table`.
        changed: receives the variables whose δ has changed.
        counts: receives in [0] their number, in [1] that of those that were solved for.
    """
    x, y, inverse = np.empty(64), np.empty(256), np.empty(64)
    depth, solved, count = 0, 0, 0
    c = table[ROOT]["first_child"]
    while c != NONE:
        if table[c]["mark"] == mark:
            waiting[depth] = c
            depth += 1
        c = table[c]["next_sibling"]
    while depth > 0:
        depth -= 1
        clique = table[waiting[depth]]
        width, below, at, ld = clique["width"], clique["below"], clique["panel_at"], clique["panel_ld"]
        if width > len(x):
            x, inverse = np.empty(2 * width), np.empty(2 * width)
        if below > len(y):
            y = np.empty(2 * below)
        for k in range(width):
            x[k] = numbers[at + k * ld + width + below]
            inverse[k] = numbers[clique["memory_at"] + k]
        first = clique["variables_at"]
        split = first + clique["frontals"]
        row = 0
        for k in range(split, split + clique["separators"]):
            v = integers[k]
            for i in range(start[v], start[v] + dof[v]):
                y[row] = delta[i]
                row += 1
        backward_one(numbers, np.uint64(at), np.uint64(ld), np.uint64(width), np.uint64(below), inverse, _ZERO, x, y)
        row = 0
        for k in range(first, split):
            v, change = integers[k], 0.0
            for i in range(dof[v]):
                difference = x[row + i] - delta[start[v] + i]
                change = max(change, difference * difference * information[start[v] + i])
            if change > wildfire * wildfire:
                variable_mark[v] = -mark
                changed[count] = v
                count += 1
                for i in range(dof[v]):
                    delta[start[v] + i] = x[row + i]
            row += dof[v]
        solved += clique["frontals"]
        c = clique["first_child"]
        while c != NONE:
            child = table[c]
            goes_on = child["mark"] == mark
            k = child["variables_at"] + child["frontals"]
            end = k + child["separators"]
            while not goes_on and k < end:
                goes_on = variable_mark[integers[k]] == -mark
                k += 1
            if goes_on:
                waiting[depth] = c
                depth += 1
                # A panel is read once an update, from far away: it is fetched while others are worked on.
                here = child["memory_at"]
                for ahead in range(here, min(here + _FETCHED, child["panel_at"] + child["width"] * child["panel_ld"]), 8):
                    prefetch(numbers, np.uint64(ahead))
            c = child["next_sibling"]
    counts[0], counts[1] = count, solved
