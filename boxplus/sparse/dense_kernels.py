"""Dense linear algebra of a front: factorise a panel, form an update matrix. Column-major, lower triangles.

The matrices are parts of flat buffers: `_at` is the first element, `ld` the column stride.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.sparse.vector_tiles import (
    TALL_FROM,
    TILE_ROWS,
    factor_1,
    factor_1_short,
    factor_3,
    factor_3_short,
    factor_6,
    factor_6_short,
    solve_1,
    solve_1_short,
    solve_3,
    solve_3_short,
    solve_6,
    solve_6_short,
    update_1,
    update_1_short,
    update_3,
    update_3_short,
    update_6,
    update_6_short,
)

Buffer = NDArray[np.float64]

_ONE, _THREE, _SIX = np.uint64(1), np.uint64(3), np.uint64(6)
_TALL_FROM, _TALL = np.uint64(TALL_FROM), np.uint64(TILE_ROWS)
BLOCK = np.uint64(96)  # columns that are eliminated together
_ROWS = np.uint64(480)  # rows that are updated together: with so many columns they stay in the second-level cache


@kernel
def update(c: Buffer, c_at: np.uint64, ldc: np.uint64, a: Buffer, a_at: np.uint64, lda: np.uint64, b: Buffer, b_at: np.uint64,
           ldb: np.uint64, rows: np.uint64, columns: np.uint64, depth: np.uint64, lower: np.uint64,
           accumulate: np.uint64) -> None:  # fmt: skip
    """C ← C - A Bᵀ, or -A Bᵀ without `accumulate`; C is (rows, columns), A (rows, depth), B (columns, depth).

    `lower` and `accumulate` are 1 or 0. With `lower`, what lies above the diagonal of C is not meaningful.
    """
    top = np.uint64(0)
    while top < rows:
        bottom = min(top + _ROWS, rows)
        end = min(columns, bottom) if lower else columns
        j = np.uint64(0)
        while j < end:
            left, i = columns - j, max(top, j * lower)
            if left >= _SIX:
                while i < bottom:
                    count, at = min(bottom - i, _TALL), c_at + i + j * ldc
                    if count >= _TALL_FROM:
                        update_6(c, at, ldc, a, a_at + i, lda, b, b_at + j, ldb, depth, count, accumulate)
                    else:
                        update_6_short(c, at, ldc, a, a_at + i, lda, b, b_at + j, ldb, depth, count, accumulate)
                    i += count
                j += _SIX
            elif left >= _THREE:
                while i < bottom:
                    count, at = min(bottom - i, _TALL), c_at + i + j * ldc
                    if count >= _TALL_FROM:
                        update_3(c, at, ldc, a, a_at + i, lda, b, b_at + j, ldb, depth, count, accumulate)
                    else:
                        update_3_short(c, at, ldc, a, a_at + i, lda, b, b_at + j, ldb, depth, count, accumulate)
                    i += count
                j += _THREE
            else:
                while i < bottom:
                    count, at = min(bottom - i, _TALL), c_at + i + j * ldc
                    if count >= _TALL_FROM:
                        update_1(c, at, ldc, a, a_at + i, lda, b, b_at + j, ldb, depth, count, accumulate)
                    else:
                        update_1_short(c, at, ldc, a, a_at + i, lda, b, b_at + j, ldb, depth, count, accumulate)
                    i += count
                j += _ONE
        top = bottom


@kernel
def update_rows(c: Buffer, a: Buffer, c_at: np.uint64, ldc: np.uint64, a_at: np.uint64, lda: np.uint64, columns: np.uint64,
                depth: np.uint64, accumulate: np.uint64, begin: np.uint64, end: np.uint64) -> None:  # fmt: skip
    """Rows `begin … end` of `update` with `lower` and B = A."""
    here, there = c_at + begin, a_at + begin
    before = min(begin, columns)
    update(c, here, ldc, a, there, lda, a, a_at, lda, end - begin, before, depth, np.uint64(0), accumulate)
    if before < columns:
        here += before * ldc
        update(c, here, ldc, a, there, lda, a, there, lda, end - begin, min(end, columns) - before, depth, _ONE, accumulate)


@kernel
def factor_block(p: Buffer, at: np.uint64, ld: np.uint64, rows: np.uint64, width: np.uint64, inverse: Buffer, pivots: Buffer,
                  inverse_at: np.uint64) -> np.uint64:  # fmt: skip
    """Factorise the first `width` columns of a panel of `rows` rows, left-looking; returns the first failed column or width."""
    j = np.uint64(0)
    while j < width:
        left = width - j
        b_at, k, count = at + j, inverse_at + j, min(rows - j, _TALL)
        here = b_at + j * ld
        i = j + count
        if left >= _SIX:
            if count >= _TALL_FROM:
                factor_6(p, here, ld, p, b_at, ld, p, b_at, ld, j, count, inverse, k, pivots)
            else:
                factor_6_short(p, here, ld, p, b_at, ld, p, b_at, ld, j, count, inverse, k, pivots)
            while i < rows:
                count, here = min(rows - i, _TALL), at + i + j * ld
                if count >= _TALL_FROM:
                    solve_6(p, here, ld, p, at + i, ld, p, b_at, ld, j, count, inverse, k)
                else:
                    solve_6_short(p, here, ld, p, at + i, ld, p, b_at, ld, j, count, inverse, k)
                i += count
            step = _SIX
        elif left >= _THREE:
            if count >= _TALL_FROM:
                factor_3(p, here, ld, p, b_at, ld, p, b_at, ld, j, count, inverse, k, pivots)
            else:
                factor_3_short(p, here, ld, p, b_at, ld, p, b_at, ld, j, count, inverse, k, pivots)
            while i < rows:
                count, here = min(rows - i, _TALL), at + i + j * ld
                if count >= _TALL_FROM:
                    solve_3(p, here, ld, p, at + i, ld, p, b_at, ld, j, count, inverse, k)
                else:
                    solve_3_short(p, here, ld, p, at + i, ld, p, b_at, ld, j, count, inverse, k)
                i += count
            step = _THREE
        else:
            if count >= _TALL_FROM:
                factor_1(p, here, ld, p, b_at, ld, p, b_at, ld, j, count, inverse, k, pivots)
            else:
                factor_1_short(p, here, ld, p, b_at, ld, p, b_at, ld, j, count, inverse, k, pivots)
            while i < rows:
                count, here = min(rows - i, _TALL), at + i + j * ld
                if count >= _TALL_FROM:
                    solve_1(p, here, ld, p, at + i, ld, p, b_at, ld, j, count, inverse, k)
                else:
                    solve_1_short(p, here, ld, p, at + i, ld, p, b_at, ld, j, count, inverse, k)
                i += count
            step = _ONE
        for failed in range(j, j + step):
            reciprocal = inverse[inverse_at + failed]
            if not (0.0 < reciprocal < np.inf):
                return np.uint64(failed)
        j += step
    return width


@kernel
def factor_panel(p: Buffer, at: np.uint64, ld: np.uint64, rows: np.uint64, width: np.uint64, inverse: Buffer, pivots: Buffer,
                 column: np.uint64, c: Buffer, c_at: np.uint64, ldc: np.uint64, accumulate: np.uint64) -> np.uint64:  # fmt: skip
    """Factorise a panel in place and form the update matrix of the rows below.

    Args:
        p: buffer with the panel, (rows, width).
        inverse: written at `column`: reciprocals of the diagonal of L.
        pivots: written at `column`: their inverse squares.
        c: buffer that receives the update matrix -L₂₁ L₂₁ᵀ, (rows - width) square, lower triangle.
        accumulate: 1 to add it to what is there.

    Returns:
        The first column whose pivot is not positive and finite, or `width`.
    """
    k = np.uint64(0)
    while k < width:
        depth = min(BLOCK, width - k)
        corner = at + k + k * ld
        failed = factor_block(p, corner, ld, rows - k, depth, inverse, pivots, column + k)
        if failed < depth:
            return np.uint64(k + failed)
        behind = k + depth
        rest = rows - behind
        if behind < width:
            here, a_at = at + behind + behind * ld, corner + depth
            update(p, here, ld, p, a_at, ld, p, a_at, ld, rest, width - behind, depth, _ONE, _ONE)
        if rows > width:
            below, a_at = rows - width, at + width + k * ld
            update(c, c_at, ldc, p, a_at, ld, p, a_at, ld, below, below, depth, _ONE, max(min(k, _ONE), accumulate))
        k = behind
    return width
