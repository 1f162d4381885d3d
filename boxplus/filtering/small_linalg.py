"""Dense linear algebra on the 24×24 blocks of the filter, compiled once, without LAPACK's call overhead."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel


@kernel
def cholesky_inverse_into(A: NDArray[np.float64], inverse: NDArray[np.float64], work: NDArray[np.float64]) -> bool:
    """inverse = A⁻¹ for symmetric positive definite A (n, n) by Cholesky; False, and nothing useful, if A is not."""
    n = A.shape[0]
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= work[i, k] * work[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                work[i, i] = math.sqrt(total)
            else:
                work[i, j] = total / work[j, j]
    # work <- L⁻¹, in place, column by column.
    for j in range(n):
        work[j, j] = 1.0 / work[j, j]
        for i in range(j + 1, n):
            total = 0.0
            for k in range(j, i):
                total -= work[i, k] * work[k, j]
            work[i, j] = total / work[i, i]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += work[k, i] * work[k, j]
            inverse[i, j] = total
            inverse[j, i] = total
    return True
