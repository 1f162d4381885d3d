"""The one place where a Jacobian goes over from one ⊞ of a pose to another (DESIGN section 4).

A pose (7,) moves on the right, `SE3`; on the left, `SE3Left`; or with its rotation on the right and its translation by
addition, `Product(UnitQuaternion, Euclidean(3))`. To first order the same motion is, with T = (R, t),

    δ_left = Ad_T δ_right,    δ_product = diag(I, R) δ_right,

so a Jacobian, which multiplies δ from the left, changes by the same matrices on its right side: J_right = J_left Ad_T.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import UnitQuaternion, rotate
from boxplus.manifolds.se3 import SE3, SE3Left

TangentChange = Callable[[int, int, NDArray[np.float64], NDArray[np.uint32], NDArray[np.float64]], None]

_POSES: tuple[Manifold, ...] = (SE3, SE3Left, Product(UnitQuaternion, Euclidean(3)))
_RIGHT, _LEFT = 0, 1  # positions in _POSES


@kernel
def _change(
    begin: int, end: int, x: NDArray[np.float64], index: NDArray[np.uint32], J: NDArray[np.float64], native: int, actual: int
) -> None:
    """Rows j = [a, b] of J times ∂δ_native/∂δ_actual, by way of δ_right; R from the right of a row is Rᵀ on its column."""
    for n in range(np.uint64(begin), np.uint64(end)):
        k = index[n]
        qw, qx, qy, qz, tx, ty, tz = x[k, 0], x[k, 1], x[k, 2], x[k, 3], x[k, 4], x[k, 5], x[k, 6]
        for row in range(J.shape[1]):
            a0, a1, a2, b0, b1, b2 = J[n, row, 0], J[n, row, 1], J[n, row, 2], J[n, row, 3], J[n, row, 4], J[n, row, 5]
            if native == _LEFT:  # [a, b] Ad = [(a + b [t]x) R, b R], and b [t]x is the row b × t
                a0, a1, a2 = a0 + b1 * tz - b2 * ty, a1 + b2 * tx - b0 * tz, a2 + b0 * ty - b1 * tx
                a0, a1, a2 = rotate(qw, -qx, -qy, -qz, a0, a1, a2)
            if native != _RIGHT:
                b0, b1, b2 = rotate(qw, -qx, -qy, -qz, b0, b1, b2)
            if actual != _RIGHT:
                b0, b1, b2 = rotate(qw, qx, qy, qz, b0, b1, b2)
            if actual == _LEFT:  # [a, b] Ad⁻¹ = [a Rᵀ − b Rᵀ [t]x, b Rᵀ]
                a0, a1, a2 = rotate(qw, qx, qy, qz, a0, a1, a2)
                a0, a1, a2 = a0 - (b1 * tz - b2 * ty), a1 - (b2 * tx - b0 * tz), a2 - (b0 * ty - b1 * tx)
            J[n, row, 0], J[n, row, 1], J[n, row, 2], J[n, row, 3], J[n, row, 4], J[n, row, 5] = a0, a1, a2, b0, b1, b2


def tangent_change(native: Manifold, actual: Manifold) -> TangentChange | None:
    """How Jacobians derived on the manifold `native` become those of a variable that lives on `actual`.

    Returns:
        None where the two are equal; else a function of (begin, end, x, index, J) that changes rows [begin, end) of
        J (N, d, 6) in place, residual n being connected to the pose x[index[n]] of x (n, 7).

    Raises:
        InputError: the manifolds do not store the same points.
    """
    if native == actual:
        return None
    if native not in _POSES or actual not in _POSES:
        raise InputError(
            f"a variable on {native.name}"
            + ("" if native not in _POSES else f" or another of {', '.join(m.name for m in _POSES)}"),
            f"one on {actual.name}",
            "only the three updates of a pose change into each other; add the variables on the manifold of the residual",
        )
    codes = _POSES.index(native), _POSES.index(actual)

    def change(begin: int, end: int, x: NDArray[np.float64], index: NDArray[np.uint32], J: NDArray[np.float64]) -> None:
        _change(begin, end, x, index, J, *codes)

    return change
