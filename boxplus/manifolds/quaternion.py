"""Unit quaternions, Hamilton, stored wxyz (SPEC.md 1.3). q and −q are the same rotation."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.manifolds._batch import map_batch
from boxplus.manifolds.so3 import quaternion_into


@kernel
def _from_matrix_batch(R: NDArray[np.float64], q_wxyz: NDArray[np.float64]) -> None:
    for i in range(R.shape[0]):
        quaternion_into(R[i], q_wxyz[i])


def from_matrix(R: ArrayLike) -> NDArray[np.float64]:
    """Unit quaternions wxyz (..., 4) with w ≥ 0 of rotation matrices (..., 3, 3)."""
    return map_batch(_from_matrix_batch, "R", R, (3, 3), (4,))


def to_matrix(q_wxyz: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrices (..., 3, 3) of unit quaternions wxyz (..., 4); the caller normalises."""
    q = np.asarray(q_wxyz, dtype=np.float64)
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def multiply(p_wxyz: ArrayLike, q_wxyz: ArrayLike) -> NDArray[np.float64]:
    """Hamilton product p ⊗ q, (..., 4): R(p ⊗ q) = R(p) R(q)."""
    pw, px, py, pz = np.moveaxis(np.asarray(p_wxyz, dtype=np.float64), -1, 0)
    qw, qx, qy, qz = np.moveaxis(np.asarray(q_wxyz, dtype=np.float64), -1, 0)
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def conjugate(q_wxyz: ArrayLike) -> NDArray[np.float64]:
    """Conjugate (..., 4): the inverse of a unit quaternion."""
    conjugated: NDArray[np.float64] = np.asarray(q_wxyz, dtype=np.float64) * np.array([1.0, -1.0, -1.0, -1.0])
    return conjugated
