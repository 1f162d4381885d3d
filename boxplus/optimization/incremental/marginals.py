"""Columns of H⁻¹ from the Bayes tree: only the cliques above a variable see it, and only those above another one lead there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.optimization.incremental.records import ROOT
from boxplus.sparse.dense_kernels import Buffer

Indices = NDArray[np.int64]
Table = NDArray[np.void]


@kernel
def _places(clique: Table, integers: Indices, dof: Indices, start: Indices, places: Indices) -> None:
    """Where the rows of a clique lie in the tangent vector."""
    row, first = 0, clique["variables_at"]
    for k in range(first, first + clique["frontals"] + clique["separators"]):
        v = integers[k]
        for i in range(start[v], start[v] + dof[v]):
            places[row] = i
            row += 1


@kernel
def solve_unit_columns(variable: int, targets: Indices, mark: int, table: Table, clique_of: Indices, integers: Indices,
                       numbers: Buffer, dof: Indices, start: Indices, b: Buffer, path: Indices,
                       out: NDArray[np.float64]) -> None:  # fmt: skip
    """Rows of the columns of H⁻¹ that belong to `variable`.

    Args:
        targets: variables whose rows are wanted.
        mark: a new number.
        b: (tangents,) scratch, zero; it is zero again afterwards.
        path: scratch, as long as the table.
        out: receives the rows of all targets one after the other, (·, dof of the variable).
    """
    # What lies above the targets, parents before children.
    count, most = 0, 1
    for t in targets:
        c, first = clique_of[t], count
        while c != ROOT and table[c]["mark"] != mark:
            table[c]["mark"] = mark
            path[count] = c
            count += 1
            most = max(most, table[c]["width"] + table[c]["below"])
            c = table[c]["parent"]
        for k in range((count - first) // 2):
            path[first + k], path[count - 1 - k] = path[count - 1 - k], path[first + k]
    c = clique_of[variable]
    while c != ROOT:
        most = max(most, table[c]["width"] + table[c]["below"])
        c = table[c]["parent"]
    places = np.empty(most, np.int64)
    for column in range(dof[variable]):
        b[start[variable] + column] = 1.0
        c = clique_of[variable]
        while c != ROOT:
            clique = table[c]
            width, rows, at, ld = clique["width"], clique["width"] + clique["below"], clique["panel_at"], clique["panel_ld"]
            _places(clique, integers, dof, start, places)
            for j in range(width):
                value = b[places[j]] * numbers[clique["memory_at"] + j]
                b[places[j]] = value
                for i in range(j + 1, rows):
                    b[places[i]] -= numbers[at + i + j * ld] * value
            c = clique["parent"]
        for k in range(count):
            clique = table[path[k]]
            width, rows, at, ld = clique["width"], clique["width"] + clique["below"], clique["panel_at"], clique["panel_ld"]
            _places(clique, integers, dof, start, places)
            for back in range(width):
                j = width - 1 - back
                value = b[places[j]]
                for i in range(j + 1, rows):
                    value -= numbers[at + i + j * ld] * b[places[i]]
                b[places[j]] = value * numbers[clique["memory_at"] + j]
        row = 0
        for t in targets:
            for i in range(start[t], start[t] + dof[t]):
                out[row, column] = b[i]
                row += 1
        for k in range(count):
            _clear(table[path[k]], integers, dof, start, b)
        c = clique_of[variable]
        while c != ROOT:
            _clear(table[c], integers, dof, start, b)
            c = table[c]["parent"]


@kernel
def _clear(clique: Table, integers: Indices, dof: Indices, start: Indices, b: Buffer) -> None:
    first = clique["variables_at"]
    for k in range(first, first + clique["frontals"]):
        v = integers[k]
        for i in range(start[v], start[v] + dof[v]):
            b[i] = 0.0
