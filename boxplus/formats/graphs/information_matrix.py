"""Information matrices in files: triangles, order of the tangent, and whether they are positive semi-definite."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

ROUNDING = 1e-6
"""Files carry six digits: a matrix counts as semi-definite down to this pivot, with its diagonal scaled to one, and as
symmetric up to this difference, relative to its largest entry."""

FINE, NOT_FINITE, ZERO, ASYMMETRIC, INDEFINITE = (np.uint8(n) for n in range(5))


def triangle_index(dim: int) -> NDArray[np.intp]:
    """(dim, dim): where the entry (i, j) stands in an upper triangle written row by row."""
    index = np.empty((dim, dim), np.intp)
    rows, columns = np.triu_indices(dim)
    index[rows, columns] = index[columns, rows] = np.arange(len(rows))
    return index


def examine(matrices: NDArray[np.float64]) -> NDArray[np.uint8]:
    """The verdict on each of (m, d, d) matrices, d ≤ 6: `FINE`, or the first of the faults below that it has."""
    verdicts = np.empty(len(matrices), np.uint8)
    _examine(matrices, verdicts)
    return verdicts


def smallest_eigenvalue(matrix: NDArray[np.float64]) -> float:
    """The smallest eigenvalue of a symmetric matrix."""
    return cast(float, np.linalg.eigvalsh(matrix)[0])


@kernel
def _examine(matrices: NDArray[np.float64], verdicts: NDArray[np.uint8]) -> None:
    dim = matrices.shape[1]
    work = np.empty((6, 6))
    scale = np.empty(6)
    for m in range(matrices.shape[0]):
        largest, skew = 0.0, 0.0
        finite = True
        for i in range(dim):
            for j in range(dim):
                entry = matrices[m, i, j]
                finite = finite and np.isfinite(entry)
                largest = max(largest, abs(entry))
                skew = max(skew, abs(entry - matrices[m, j, i]))
        if not finite:
            verdicts[m] = NOT_FINITE
        elif largest == 0.0:
            verdicts[m] = ZERO
        elif skew > ROUNDING * largest:
            verdicts[m] = ASYMMETRIC
        elif _is_semidefinite(matrices[m], work, scale):
            verdicts[m] = FINE
        else:
            verdicts[m] = INDEFINITE


@kernel
def _is_semidefinite(matrix: NDArray[np.float64], work: NDArray[np.float64], scale: NDArray[np.float64]) -> bool:
    """Cholesky of the matrix scaled to a unit diagonal; beside a pivot that vanishes the column must vanish too."""
    dim = matrix.shape[0]
    for i in range(dim):
        diagonal = matrix[i, i]
        if diagonal < 0.0:
            return False
        scale[i] = 1.0 / np.sqrt(diagonal) if diagonal > 0.0 else 0.0
    for i in range(dim):
        for j in range(i + 1):
            entry = matrix[i, j]
            if entry != 0.0 and (scale[i] == 0.0 or scale[j] == 0.0):
                return False
            work[i, j] = entry * scale[i] * scale[j]
    for k in range(dim):
        pivot = work[k, k]
        if pivot < -ROUNDING:
            return False
        if pivot <= ROUNDING:
            for i in range(k + 1, dim):
                if work[i, k] * work[i, k] > ROUNDING:
                    return False
            continue
        for i in range(k + 1, dim):
            factor = work[i, k] / pivot
            for j in range(k + 1, i + 1):
                work[i, j] -= factor * work[j, k]
    return True
