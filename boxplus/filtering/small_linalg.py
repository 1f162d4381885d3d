"""Dense linear algebra on the small blocks of the filter, compiled once, without LAPACK's call overhead."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

_SWEEPS = 30  # of Jacobi's method, which needs six to ten
_OFF = 1e-32  # squared, what is left off the diagonal against what is on it


@kernel
def inverse_root_into(A: NDArray[np.float64], root: NDArray[np.float64]) -> bool:
    """The lower triangle of `root` is L⁻¹, A = L Lᵀ symmetric positive definite (n, n); False, and nothing useful, if A is not.

    Neither the upper triangle of A is read nor that of `root` written.
    """
    n = A.shape[0]
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                root[i, i] = math.sqrt(total)
            else:
                root[i, j] = total / root[j, j]
    # root <- L⁻¹, in place, column by column.
    for j in range(n):
        root[j, j] = 1.0 / root[j, j]
        for i in range(j + 1, n):
            total = 0.0
            for k in range(j, i):
                total -= root[i, k] * root[k, j]
            root[i, j] = total / root[i, i]
    return True


@kernel
def cholesky_inverse_into(A: NDArray[np.float64], inverse: NDArray[np.float64], work: NDArray[np.float64]) -> bool:
    """inverse = A⁻¹ for symmetric positive definite A (n, n) by Cholesky; False, and nothing useful, if A is not."""
    if not inverse_root_into(A, work):
        return False
    n = A.shape[0]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += work[k, i] * work[k, j]
            inverse[i, j] = total
            inverse[j, i] = total
    return True


@kernel
def symmetric_eigen_into(A: NDArray[np.float64], values: NDArray[np.float64], vectors: NDArray[np.float64]) -> None:
    """Eigenvalues (n,) ascending and eigenvectors (n, n), one a column, of symmetric A (n, n), by Jacobi's rotations.

    Accurate to rounding of the largest; A is destroyed. (Golub and Van Loan, Matrix Computations, 2013, section 8.5)
    """
    n = A.shape[0]
    for i in range(n):
        for j in range(n):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(_SWEEPS):
        off = on = 0.0
        for i in range(n):
            on += A[i, i] * A[i, i]
            for j in range(i):
                off += A[i, j] * A[i, j]
        if not off > _OFF * on:
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                if A[p, q] == 0.0:
                    continue
                tau = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
                t = math.copysign(1.0, tau) / (abs(tau) + math.sqrt(1.0 + tau * tau))
                c = 1.0 / math.sqrt(1.0 + t * t)
                s = t * c
                for k in range(n):
                    a, b = A[k, p], A[k, q]
                    A[k, p], A[k, q] = c * a - s * b, s * a + c * b
                for k in range(n):
                    a, b = A[p, k], A[q, k]
                    A[p, k], A[q, k] = c * a - s * b, s * a + c * b
                    a, b = vectors[k, p], vectors[k, q]
                    vectors[k, p], vectors[k, q] = c * a - s * b, s * a + c * b
    for i in range(n):
        values[i] = A[i, i]
    for i in range(n - 1):
        least = i
        for j in range(i + 1, n):
            if values[j] < values[least]:
                least = j
        if least != i:
            values[i], values[least] = values[least], values[i]
            for k in range(n):
                vectors[k, i], vectors[k, least] = vectors[k, least], vectors[k, i]


@kernel
def positive_part_into(M: NDArray[np.float64]) -> None:
    """The positive semidefinite part of a symmetric matrix takes its place."""
    n = M.shape[0]
    values, vectors = np.empty(n), np.empty((n, n))
    symmetric_eigen_into(M, values, vectors)
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(n):
                total += vectors[i, k] * max(values[k], 0.0) * vectors[j, k]
            M[i, j] = total
            M[j, i] = total


def positive_part(M: NDArray[np.float64]) -> NDArray[np.float64]:
    """The positive semidefinite part of a symmetric matrix."""
    positive: NDArray[np.float64] = np.array(M, dtype=np.float64)
    positive_part_into(positive)
    return positive
