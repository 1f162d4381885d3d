"""Solves with the factor L of `multifrontal`: forward and backward substitution, front by front.

Several right-hand sides are stored row by row. Seen as a column-major matrix with one row for each side, they are what the tiles
of `vector_tiles` work on: L X = B is Xᵀ Lᵀ = Bᵀ.
"""

from __future__ import annotations

import numpy as np

from boxplus._jit import kernel
from boxplus.sparse.dense_kernels import Buffer, update
from boxplus.sparse.multifrontal import Indices, Table
from boxplus.sparse.vector_tiles import (
    TALL_FROM,
    TILE_ROWS,
    dots_1,
    dots_3,
    dots_6,
    solve_1,
    solve_1_short,
    solve_3,
    solve_3_short,
    solve_6,
    solve_6_short,
    transposed_1,
    transposed_1_short,
    transposed_3,
    transposed_3_short,
    transposed_6,
    transposed_6_short,
    update_1,
    update_1_short,
)

_ZERO, _ONE, _THREE, _SIX = np.uint64(0), np.uint64(1), np.uint64(3), np.uint64(6)
_TALL_FROM, _TALL = np.uint64(TALL_FROM), np.uint64(TILE_ROWS)


@kernel
def forward(factor: Buffer, at: np.uint64, ld: np.uint64, width: np.uint64, inverse: Buffer, column: np.uint64, x: Buffer,
            x_at: np.uint64, sides: np.uint64) -> None:  # fmt: skip
    """X ← L₁₁⁻¹ X for the columns of a front that begin with `column`; X is (width, sides)."""
    j = np.uint64(0)
    while j < width:
        left, b_at, k, s = width - j, at + j, column + j, np.uint64(0)
        while s < sides:
            count, a_at = min(sides - s, _TALL), x_at + s
            here = a_at + j * sides
            if left >= _SIX:
                if count >= _TALL_FROM:
                    solve_6(x, here, sides, x, a_at, sides, factor, b_at, ld, j, count, inverse, k)
                else:
                    solve_6_short(x, here, sides, x, a_at, sides, factor, b_at, ld, j, count, inverse, k)
            elif left >= _THREE:
                if count >= _TALL_FROM:
                    solve_3(x, here, sides, x, a_at, sides, factor, b_at, ld, j, count, inverse, k)
                else:
                    solve_3_short(x, here, sides, x, a_at, sides, factor, b_at, ld, j, count, inverse, k)
            elif count >= _TALL_FROM:
                solve_1(x, here, sides, x, a_at, sides, factor, b_at, ld, j, count, inverse, k)
            else:
                solve_1_short(x, here, sides, x, a_at, sides, factor, b_at, ld, j, count, inverse, k)
            s += count
        j += _SIX if left >= _SIX else (_THREE if left >= _THREE else _ONE)


@kernel
def _subtract_transposed(x: Buffer, x_at: np.uint64, sides: np.uint64, y: Buffer, y_at: np.uint64, factor: Buffer, at: np.uint64,
                         ld: np.uint64, columns: np.uint64, depth: np.uint64) -> None:  # fmt: skip
    """X ← X - Lᵀ Y for 6, 3 or 1 columns of a part of L that is `depth` rows high."""
    s = np.uint64(0)
    while s < sides:
        count, here, there = min(sides - s, _TALL), x_at + s, y_at + s
        if columns == _SIX:
            if count >= _TALL_FROM:
                transposed_6(x, here, sides, y, there, sides, factor, at, ld, depth, count, _ONE)
            else:
                transposed_6_short(x, here, sides, y, there, sides, factor, at, ld, depth, count, _ONE)
        elif columns == _THREE:
            if count >= _TALL_FROM:
                transposed_3(x, here, sides, y, there, sides, factor, at, ld, depth, count, _ONE)
            else:
                transposed_3_short(x, here, sides, y, there, sides, factor, at, ld, depth, count, _ONE)
        elif count >= _TALL_FROM:
            transposed_1(x, here, sides, y, there, sides, factor, at, ld, depth, count, _ONE)
        else:
            transposed_1_short(x, here, sides, y, there, sides, factor, at, ld, depth, count, _ONE)
        s += count


@kernel
def _backward(factor: Buffer, at: np.uint64, ld: np.uint64, width: np.uint64, below: np.uint64, inverse: Buffer,
              column: np.uint64, x: Buffer, y: Buffer, sides: np.uint64) -> None:  # fmt: skip
    """X₁ ← L₁₁⁻ᵀ (X₁ - L₂₁ᵀ Y) for the columns of a front, from the last on."""
    end = width
    while end > _ZERO:
        rest = end % _SIX
        columns = _SIX if rest == _ZERO else (_THREE if rest == _THREE else _ONE)
        begin = end - columns
        x_at, l_at = (column + begin) * sides, at + begin * ld
        _subtract_transposed(x, x_at, sides, y, _ZERO, factor, l_at + width, ld, columns, below)
        _subtract_transposed(x, x_at, sides, x, (column + end) * sides, factor, l_at + end, ld, columns, width - end)
        for done in range(columns):
            c = columns - _ONE - done
            target = x_at + c * sides
            for i in range(c + _ONE, columns):
                weight, source = factor[l_at + begin + i + c * ld], x_at + i * sides
                for s in range(sides):
                    x[target + s] -= weight * x[source + s]
            scale = inverse[column + begin + c]
            for s in range(sides):
                x[target + s] *= scale
        end = begin


@kernel
def solve_many(table: Table, rows: Indices, order: Indices, factor: Buffer, inverse: Buffer, b: Buffer, sides: np.uint64,
               x: Buffer, y: Buffer, z: Buffer) -> None:  # fmt: skip
    """Solve L Lᵀ Z = B for several right-hand sides, all (N, sides), flat.

    Args:
        order: scalar row at each position of the elimination order; b and z are in the order of the matrix.
        x: (N * sides,) scratch.
        y: (most rows below a front * sides,) scratch.
    """
    fronts = np.uint64(len(table) - 1)
    for k in range(np.uint64(len(order))):
        for s in range(sides):
            x[k * sides + s] = b[order[k] * sides + s]
    for g in range(fronts):
        front = table[g]
        width, below, at, ld, row = front["width"], front["below"], front["panel_at"], front["panel_ld"], front["row_start"]
        column = front["column"]
        forward(factor, at, ld, width, inverse, column, x, column * sides, sides)
        update(y, _ZERO, sides, x, column * sides, sides, factor, at + width, ld, sides, below, width, _ZERO, _ZERO)
        for i in range(below):
            target = rows[row + i] * sides
            for s in range(sides):
                x[target + s] += y[i * sides + s]
    for back in range(fronts):
        front = table[fronts - _ONE - back]
        width, below, at, ld, row = front["width"], front["below"], front["panel_at"], front["panel_ld"], front["row_start"]
        for i in range(below):
            source = rows[row + i] * sides
            for s in range(sides):
                y[i * sides + s] = x[source + s]
        _backward(factor, at, ld, width, below, inverse, front["column"], x, y, sides)
    for k in range(np.uint64(len(order))):
        for s in range(sides):
            z[order[k] * sides + s] = x[k * sides + s]


@kernel(inline=True)
def _subtract(y: Buffer, y_at: np.uint64, factor: Buffer, at: np.uint64, ld: np.uint64, x: Buffer, x_at: np.uint64,
              rows: np.uint64, depth: np.uint64, accumulate: np.uint64) -> None:  # fmt: skip
    """y ← y - L x, or -L x, for some columns of L."""
    i = np.uint64(0)
    while i < rows:
        count = min(rows - i, _TALL)
        if count >= _TALL_FROM:
            update_1(y, y_at + i, _ONE, factor, at + i, ld, x, x_at, _ONE, depth, count, accumulate)
        else:
            update_1_short(y, y_at + i, _ONE, factor, at + i, ld, x, x_at, _ONE, depth, count, accumulate)
        i += count


@kernel(inline=True)
def backward_one(factor: Buffer, at: np.uint64, ld: np.uint64, width: np.uint64, below: np.uint64, inverse: Buffer,
                  column: np.uint64, x: Buffer, y: Buffer) -> None:  # fmt: skip
    """As `_backward`, for one right-hand side."""
    end = width
    while end > _ZERO:
        rest = end % _SIX
        columns = _SIX if rest == _ZERO else (_THREE if rest == _THREE else _ONE)
        begin = end - columns
        x_at, l_at = column + begin, at + begin * ld
        if columns == _SIX:
            dots_6(x, x_at, y, _ZERO, factor, l_at + width, ld, below)
            dots_6(x, x_at, x, column + end, factor, l_at + end, ld, width - end)
        elif columns == _THREE:
            dots_3(x, x_at, y, _ZERO, factor, l_at + width, ld, below)
            dots_3(x, x_at, x, column + end, factor, l_at + end, ld, width - end)
        else:
            dots_1(x, x_at, y, _ZERO, factor, l_at + width, ld, below)
            dots_1(x, x_at, x, column + end, factor, l_at + end, ld, width - end)
        for done in range(columns):
            c = columns - _ONE - done
            value = x[x_at + c]
            for i in range(c + _ONE, columns):
                value -= factor[l_at + begin + i + c * ld] * x[x_at + i]
            x[x_at + c] = value * inverse[x_at + c]
        end = begin


@kernel
def solve_one(table: Table, rows: Indices, order: Indices, factor: Buffer, inverse: Buffer, b: Buffer, x: Buffer, y: Buffer,
              z: Buffer) -> None:  # fmt: skip
    """Solve L Lᵀ z = b, as `solve_many` with one side."""
    fronts = np.uint64(len(table) - 1)
    for k in range(np.uint64(len(order))):
        x[k] = b[order[k]]
    for g in range(fronts):
        front = table[g]
        width, below, at, ld, row = front["width"], front["below"], front["panel_at"], front["panel_ld"], front["row_start"]
        column = front["column"]
        begin = _ZERO
        while begin < width:
            end = min(begin + _SIX, width)
            l_at = at + begin * ld
            for c in range(begin, end):
                value = x[column + c] * inverse[column + c]
                x[column + c] = value
                for i in range(c + _ONE, end):
                    x[column + i] -= factor[at + i + c * ld] * value
            _subtract(x, column + end, factor, l_at + end, ld, x, column + begin, width - end, end - begin, _ONE)
            _subtract(y, _ZERO, factor, l_at + width, ld, x, column + begin, below, end - begin, min(begin, _ONE))
            begin = end
        for i in range(below):
            x[rows[row + i]] += y[i]
    for back in range(fronts):
        front = table[fronts - _ONE - back]
        width, below, at, ld, row = front["width"], front["below"], front["panel_at"], front["panel_ld"], front["row_start"]
        for i in range(below):
            y[i] = x[rows[row + i]]
        backward_one(factor, at, ld, width, below, inverse, front["column"], x, y)
    for k in range(np.uint64(len(order))):
        z[order[k]] = x[k]
