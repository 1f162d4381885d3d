"""Blocks of the inverse from the factor L, on the pattern of L: selected inversion, front by front from the root down.

With the front's rows split into its columns (1) and the rows below (2), and Z the inverse,

    Z₂₁ = -Z₂₂ W,   Z₁₁ = L₁₁⁻ᵀ L₁₁⁻¹ - Wᵀ Z₂₁,   W = L₂₁ L₁₁⁻¹,

where Z₂₂ is a part of the parent front's Z. Takahashi, Fagan, Chin, "Formation of a sparse bus impedance matrix and its
application to short circuit study" (1973); Erisman and Tinney, "On computing certain elements of the inverse of a sparse
matrix" (1975).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.sparse.dense_kernels import BLOCK, Buffer, update
from boxplus.sparse.multifrontal import Indices, Table
from boxplus.sparse.supernodes import DIAGONAL, STORED, TRANSPOSED, Fronts
from boxplus.sparse.triangular_solve import forward

_ZERO, _ONE = np.uint64(0), np.uint64(1)
_SQUARE = np.uint64(8)


@kernel
def _invert_triangle(factor: Buffer, at: np.uint64, ld: np.uint64, inverse: Buffer, column: np.uint64, width: np.uint64,
                     m: Buffer, negative: Buffer) -> None:  # fmt: skip
    """M = L₁₁⁻¹, row by row, (width, width), and its negative."""
    for k in range(width * width):
        m[k] = 0.0
    for k in range(width):
        m[k + k * width] = 1.0
    forward(factor, at, ld, width, inverse, column, m, _ZERO, width)
    for k in range(width * width):
        negative[k] = -m[k]


@kernel
def _transpose(source: Buffer, at: np.uint64, ld: np.uint64, rows: np.uint64, columns: np.uint64, target: Buffer, to: np.uint64,
               to_ld: np.uint64, lower: np.uint64) -> None:  # fmt: skip
    """Copy a column-major matrix to the place of its transpose, in small squares; with `lower` = 1 only below its diagonal."""
    for corner in range((columns + _SQUARE - _ONE) // _SQUARE):
        first = corner * _SQUARE
        last = min(first + _SQUARE, columns)
        top = first * lower
        while top < rows:
            bottom = min(top + _SQUARE, rows)
            for j in range(first, last):
                for i in range(max(top, (j + _ONE) * lower), bottom):
                    target[to + j + i * to_ld] = source[at + i + j * ld]
            top = bottom


@kernel
def _hand_to_child(child: Table, last: np.uint64, runs: Table, z: Buffer, at: np.uint64, ld: np.uint64, width: np.uint64,
                   stack: Buffer, below_at: np.uint64, below_ld: np.uint64) -> None:  # fmt: skip
    """Copy a child's part of a front's Z to the place of its update matrix, lower triangle."""
    target_at, target_ld = child["update_at"], child["update_ld"]
    for a in range(child["run_start"], last):
        column, there, length = runs[a]["child"], runs[a]["parent"], runs[a]["length"]
        for j in range(length):
            target = target_at + (column + j) * target_ld
            for b in range(a, last):
                row, below, count = runs[b]["child"], runs[b]["parent"], runs[b]["length"]
                if there < width:
                    source = at + (there + j) * ld + below
                    for i in range(count):
                        stack[target + row + i] = z[source + i]
                else:
                    source = below_at + (there + j - width) * below_ld + below - width
                    for i in range(count):
                        stack[target + row + i] = stack[source + i]


@kernel
def _product(c: Buffer, c_at: np.uint64, ldc: np.uint64, a: Buffer, a_at: np.uint64, lda: np.uint64, b: Buffer, b_at: np.uint64,
             ldb: np.uint64, rows: np.uint64, columns: np.uint64, depth: np.uint64, lower: np.uint64,
             accumulate: np.uint64) -> None:  # fmt: skip
    """`update` in pieces of the depth whose part of A stays in the cache."""
    k = np.uint64(0)
    while k < depth:
        piece = min(depth - k, BLOCK)
        add = max(accumulate, min(k, _ONE))
        update(c, c_at, ldc, a, a_at + k * lda, lda, b, b_at + k * ldb, ldb, rows, columns, piece, lower, add)
        k += piece


@kernel
def selected_inverse(table: Table, children: Indices, runs: Table, factor: Buffer, inverse: Buffer, stack: Buffer, z: Buffer,
                     m: Buffer, negative: Buffer, w: Buffer, z_transposed: Buffer) -> None:  # fmt: skip
    """The inverse on the pattern of the factor, in panels like those of the factor.

    Args:
        stack: scratch, that of the factorisation.
        z: receives the panels; lower triangles.
        m, negative: scratch, (largest width squared,).
        w, z_transposed: scratch, (largest width times rows below,).
    """
    fronts = np.uint64(len(table) - 1)
    for back in range(fronts):
        g = fronts - _ONE - back
        front, following = table[g], table[g + _ONE]
        width, below, at, ld = front["width"], front["below"], front["panel_at"], front["panel_ld"]
        below_at, below_ld = front["update_at"], front["update_ld"]
        if front["parent"] < fronts and table[front["parent"]]["eager"]:
            p = table[front["parent"]]
            p_at, p_ld, p_below, p_below_ld = p["panel_at"], p["panel_ld"], p["update_at"], p["update_ld"]
            _hand_to_child(front, following["run_start"], runs, z, p_at, p_ld, p["width"], stack, p_below, p_below_ld)
        _invert_triangle(factor, at, ld, inverse, front["column"], width, m, negative)
        _product(z, at, ld, m, _ZERO, width, negative, _ZERO, width, width, width, width, _ONE, _ZERO)
        if below > _ZERO:
            _transpose(stack, below_at, below_ld, below, below, stack, below_at, below_ld, _ONE)
            _product(w, _ZERO, width, negative, _ZERO, width, factor, at + width, ld, width, below, width, _ZERO, _ZERO)
            _product(z, at + width, ld, stack, below_at, below_ld, w, _ZERO, width, below, width, below, _ZERO, _ZERO)
            _transpose(z, at + width, ld, below, width, z_transposed, _ZERO, width, _ZERO)
            _product(z, at, ld, w, _ZERO, width, z_transposed, _ZERO, width, width, width, below, _ONE, _ONE)
        if not front["eager"]:
            for c in range(front["child_start"], following["child_start"]):
                child, last = table[children[c]], table[children[c] + _ONE]["run_start"]
                _hand_to_child(child, last, runs, z, at, ld, width, stack, below_at, below_ld)


@kernel
def _locate(first: Indices, second: Indices, scalar_of: Indices, front_of: Indices, table: Table, rows: Indices,
            place: NDArray[np.int64]) -> None:  # fmt: skip
    """First element of the blocks of pairs of variables among the panels, -1 outside the pattern of the factor."""
    for k in range(np.uint64(len(first))):
        a, b = scalar_of[first[k]], scalar_of[second[k]]
        front = table[front_of[first[k] if a < b else second[k]]]
        low, high = min(a, b) - front["column"], max(a, b)
        place[k] = -1
        if high < front["column"] + front["width"]:
            row = high - front["column"]
        else:
            end = front["row_start"] + front["below"]
            lower, upper = front["row_start"], end
            while lower < upper:
                middle = (lower + upper) // np.uint64(2)
                if rows[middle] < high:
                    lower = middle + _ONE
                else:
                    upper = middle
            if lower == end or rows[lower] != high:
                continue
            row = front["width"] + lower - front["row_start"]
        place[k] = np.int64(front["panel_at"] + row + low * front["panel_ld"])


@kernel
def _read(panels: Buffer, place: NDArray[np.int64], ld: Indices, rows: NDArray[np.int64], columns: NDArray[np.int64],
          kind: NDArray[np.int64], found: Buffer) -> None:  # fmt: skip
    """Blocks from the panels, row-major, one after another, those without a place left out; `kind` as of the matrix."""
    at = np.uint64(0)
    for k in range(np.uint64(len(place))):
        if place[k] < 0:
            at += np.uint64(rows[k] * columns[k])
            continue
        first = np.uint64(place[k])
        for i in range(np.uint64(rows[k])):
            for j in range(np.uint64(columns[k])):
                low, high = (i, j) if kind[k] == TRANSPOSED or (kind[k] == DIAGONAL and j > i) else (j, i)
                found[at] = panels[first + high + low * ld[k]]
                at += _ONE


class SelectedInverse:
    """All blocks of the inverse of a factorised matrix that lie on the pattern of its factor.

    Args:
        fronts: the analysis.
        factor, inverse: panels and reciprocals of the diagonal of L.
        stack: scratch, that of the factorisation.
    """

    def __init__(self, fronts: Fronts, factor: Buffer, inverse: Buffer, stack: Buffer) -> None:
        self._fronts = fronts
        self._panels = np.empty_like(factor)
        width, below = (fronts.table[name][:-1].astype(np.int64) for name in ("width", "below"))
        triangle, rectangle = (int(a.max(initial=0)) for a in (width * width, width * below))
        selected_inverse(
            fronts.table, fronts.children, fronts.runs, factor, inverse, stack, self._panels,
            np.empty(triangle), np.empty(triangle), np.empty(rectangle), np.empty(rectangle),
        )  # fmt: skip

    def read(self, place: NDArray[np.int64], i: NDArray[np.int64], j: NDArray[np.int64], found: Buffer) -> None:
        """Write the blocks of the pairs of variables (i, j) at places that `locate_blocks` found, row-major, one after another.

        Args:
            found: where; what belongs to pairs without a place, -1, stays as it is.
        """
        fronts = self._fronts
        lower = fronts.scalar_of[i] > fronts.scalar_of[j]
        ld = fronts.table["panel_ld"][fronts.front_of[np.where(lower, j, i)]]
        kind = np.where(i == j, DIAGONAL, np.where(lower, STORED, TRANSPOSED))
        _read(self._panels, place, ld, fronts.sizes[i], fronts.sizes[j], kind, found)


def split_blocks(values: Buffer, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> list[NDArray[np.float64]]:
    """Blocks (rows[k], columns[k]) that lie one after another, row-major, as arrays of their own: views."""
    ends = np.cumsum(rows * columns)
    shapes = zip(ends.tolist(), rows.tolist(), columns.tolist(), strict=True)
    return [values[e - r * c : e].reshape(r, c) for e, r, c in shapes]


def locate_blocks(fronts: Fronts, i: NDArray[np.int64], j: NDArray[np.int64]) -> NDArray[np.int64]:
    """(m,) places of the blocks of pairs of variables, -1 outside the pattern of the factor."""
    place = np.empty(len(i), np.int64)
    _locate(i.astype(np.uint64), j.astype(np.uint64), fronts.scalar_of, fronts.front_of, fronts.table, fronts.rows, place)
    return place
