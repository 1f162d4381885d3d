"""Cholesky factorisation of a small dense matrix: no call of LAPACK, which for so few rows would mostly wake its threads."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel


@kernel(fastmath=True)
def factorize_dense(A: NDArray[np.float64], least: float) -> np.int64:
    """A (n, n) ← L in its lower triangle, with L Lᵀ = A, read from there; returns the row that failed, or n.

    Args:
        least: share of its diagonal entry below which a pivot is rounding. A failed row has its pivot on the diagonal.
    """
    n = np.uint64(A.shape[0])
    for i in range(n):
        for j in range(i):
            total = 0.0
            for k in range(j):
                total += A[i, k] * A[j, k]
            A[i, j] = (A[i, j] - total) / A[j, j]
        total = 0.0
        for k in range(i):
            total += A[i, k] * A[i, k]
        whole = A[i, i]
        pivot = whole - total
        if not pivot > least * whole:
            A[i, i] = pivot
            return np.int64(i)
        A[i, i] = math.sqrt(pivot)
    return np.int64(n)


@kernel(fastmath=True)
def solve_dense(L: NDArray[np.float64], X: NDArray[np.float64]) -> None:
    """X (n, m) ← (L Lᵀ)⁻¹ X."""
    n, sides = np.uint64(X.shape[0]), np.uint64(X.shape[1])
    one = np.uint64(1)
    for i in range(n):
        for k in range(i):
            factor = L[i, k]
            for s in range(sides):
                X[i, s] -= factor * X[k, s]
        for s in range(sides):
            X[i, s] /= L[i, i]
    for back in range(n):
        row = n - one - np.uint64(back)
        for s in range(sides):
            X[row, s] /= L[row, row]
        for k in range(row):
            factor = L[row, k]
            for s in range(sides):
                X[k, s] -= factor * X[row, s]
