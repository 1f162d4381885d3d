"""The rotation next to a matrix, which also turns one set of vectors onto another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def nearest_rotation(M: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation R (3, 3) with the largest trace of Rᵀ M, the nearest one to M (3, 3) (Kabsch, 1976).

    With M = Σ bᵢ aᵢᵀ it is the rotation by which the vectors aᵢ come closest to bᵢ.

    Example:
        >>> np.round(nearest_rotation(np.diag([2.0, 1.0, 0.5])), 6).diagonal().tolist()
        [1.0, 1.0, 1.0]
    """
    U, _, Vt = np.linalg.svd(M)
    R: NDArray[np.float64] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return R
