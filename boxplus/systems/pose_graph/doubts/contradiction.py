"""How far all other edges contradict each one, and in how many directions they can.

With S the covariance of whitened errors e, an edge is contradicted by eᵀ S⁻¹ e, and what it claims bends the result by
eᵀ S⁻¹ (I − S) S⁻¹ e, along the directions in which S does not vanish (Baarda, A testing procedure for use in geodetic networks,
1968). No share of an error that shows is larger than one, so none of S is smaller than its determinant: where that is large
enough, no direction vanishes, and a Cholesky factor does; only else are the directions looked for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

Floats = NDArray[np.float64]

_CLEAR = 2.0  # times the least share that counts, for its own rounding


@dataclass(frozen=True, slots=True)
class Contradiction:
    """What all other edges say of each one.

    Attributes:
        squared: (m,) how far they contradict it, squared.
        directions: (m,) in how many directions they can.
        bent: (m,) how far it bends the result, in the standard deviations that the result claims of the pose of one of its poses
            in the other.
    """

    squared: Floats
    directions: NDArray[np.int64]
    bent: Floats

    @classmethod
    def of(cls, errors: Floats, predicted: Floats, least: Floats) -> Contradiction:
        """Of whitened errors (m, d), of which the result predicts the covariance (m, d, d), with S = I − predicted.

        Args:
            least: (m,) share of an error that shows, up to which nothing checks a direction.
        """
        m, d = errors.shape
        squared, bent, directions = np.zeros(m), np.zeros(m), np.full(m, d)
        is_clear = np.zeros(m, dtype=np.bool_)
        _contradict(errors, predicted, _CLEAR * least, squared, bent, is_clear)
        rows = np.flatnonzero(~is_clear)
        share, U = np.linalg.eigh(np.eye(d) - predicted[rows])
        is_checked = share > least[rows, None]
        own = np.einsum("nji,nj->ni", U, errors[rows])
        along = np.where(is_checked, own * own / np.where(is_checked, share, 1.0), 0.0)
        across = np.where(is_checked, along / np.where(is_checked, share, 1.0) * np.clip(1.0 - share, 0.0, 1.0), 0.0)
        squared[rows], directions[rows], bent[rows] = along.sum(axis=1), is_checked.sum(axis=1), np.sqrt(across.sum(axis=1))
        return cls(squared, directions, bent)


@kernel
def _contradict(
    errors: Floats, predicted: Floats, least: Floats, squared: Floats, bent: Floats, is_clear: NDArray[np.bool_]
) -> None:
    """Of the edges of which the determinant of S = L Lᵀ says that every direction is checked."""
    m, d = errors.shape
    L, y = np.empty((d, d)), np.empty(d)
    for n in range(m):
        determinant = 1.0
        for k in range(d):
            for i in range(k, d):
                total = (1.0 if i == k else 0.0) - predicted[n, i, k]
                for q in range(k):
                    total -= L[i, q] * L[k, q]
                if i > k:
                    L[i, k] = total / L[k, k]
                    continue
                determinant *= total
                if not determinant > least[n]:
                    break
                L[k, k] = np.sqrt(total)
            if not determinant > least[n]:
                break
        if not determinant > least[n]:
            continue
        is_clear[n] = True
        whole = 0.0
        for k in range(d):
            total = errors[n, k]
            for q in range(k):
                total -= L[k, q] * y[q]
            y[k] = total / L[k, k]
            whole += y[k] * y[k]
        longer = 0.0
        for k in range(d - 1, -1, -1):
            total = y[k]
            for q in range(k + 1, d):
                total -= L[q, k] * y[q]
            y[k] = total / L[k, k]
            longer += y[k] * y[k]
        squared[n], bent[n] = whole, np.sqrt(max(longer - whole, 0.0))
