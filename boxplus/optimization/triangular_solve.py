"""Solves with the factor L of `multifrontal`: forward and backward substitution, front by front."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.optimization.dense_kernels import Buffer
from boxplus.optimization.multifrontal import Indices, Table

_ONE = np.uint64(1)


@kernel(fastmath=True)
def solve_one(
    table: Table, rows: Indices, order: Indices, factor: Buffer, inverse: Buffer, b: Buffer, x: Buffer, work: Buffer
) -> None:
    """Solve L Lᵀ x = b for one right-hand side.

    Args:
        order: scalar row at each position of the elimination order; b and x are in the order of the matrix.
        work: (N + largest front,) scratch.
    """
    n, fronts = np.uint64(len(order)), np.uint64(len(table) - 1)
    for k in range(n):
        work[k] = b[order[k]]
    for g in range(fronts):
        front = table[g]
        column, width, below, ld, row = front["column"], front["width"], front["below"], front["panel_ld"], front["row_start"]
        for i in range(below):
            work[n + i] = 0.0
        for c in range(width):
            at = front["panel_at"] + c * ld
            value = work[column + c] * inverse[column + c]
            work[column + c] = value
            for i in range(c + _ONE, width):
                work[column + i] -= factor[at + i] * value
            for i in range(below):
                work[n + i] += factor[at + width + i] * value
        for i in range(below):
            work[rows[row + i]] -= work[n + i]
    for back in range(fronts):
        front = table[fronts - _ONE - back]
        column, width, below, ld, row = front["column"], front["width"], front["below"], front["panel_ld"], front["row_start"]
        for i in range(below):
            work[n + i] = work[rows[row + i]]
        for done in range(width):
            c = width - _ONE - done
            at = front["panel_at"] + c * ld
            total = 0.0
            for i in range(c + _ONE, width):
                total += factor[at + i] * work[column + i]
            for i in range(below):
                total += factor[at + width + i] * work[n + i]
            work[column + c] = (work[column + c] - total) * inverse[column + c]
    for k in range(n):
        x[order[k]] = work[k]


@kernel(fastmath=True)
def solve_many(table: Table, rows: Indices, order: Indices, factor: Buffer, inverse: Buffer, b: NDArray[np.float64],
               x: NDArray[np.float64], work: NDArray[np.float64]) -> None:  # fmt: skip
    """Solve L Lᵀ X = B, both (N, k), row by row of k numbers; `work` is (N, k)."""
    n, fronts, sides = np.uint64(len(order)), np.uint64(len(table) - 1), np.uint64(b.shape[1])
    for k in range(n):
        for s in range(sides):
            work[k, s] = b[order[k], s]
    for g in range(fronts):
        front = table[g]
        column, width, below, ld, row = front["column"], front["width"], front["below"], front["panel_ld"], front["row_start"]
        for c in range(width):
            at = front["panel_at"] + c * ld
            for s in range(sides):
                work[column + c, s] *= inverse[column + c]
            for i in range(c + _ONE, width):
                weight = factor[at + i]
                for s in range(sides):
                    work[column + i, s] -= weight * work[column + c, s]
            for i in range(below):
                weight, target = factor[at + width + i], rows[row + i]
                for s in range(sides):
                    work[target, s] -= weight * work[column + c, s]
    for back in range(fronts):
        front = table[fronts - _ONE - back]
        column, width, below, ld, row = front["column"], front["width"], front["below"], front["panel_ld"], front["row_start"]
        for done in range(width):
            c = width - _ONE - done
            at = front["panel_at"] + c * ld
            for i in range(c + _ONE, width):
                weight = factor[at + i]
                for s in range(sides):
                    work[column + c, s] -= weight * work[column + i, s]
            for i in range(below):
                weight, source = factor[at + width + i], rows[row + i]
                for s in range(sides):
                    work[column + c, s] -= weight * work[source, s]
            for s in range(sides):
                work[column + c, s] *= inverse[column + c]
    for k in range(n):
        for s in range(sides):
            x[order[k], s] = work[k, s]
