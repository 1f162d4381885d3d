"""The one place where a Jacobian goes over from one ⊞ of a pose to another (docs/manifolds.md).

A pose (7,) moves on the right, `SE3`; on the left, `SE3Left`; with its translation by addition and its rotation on the right,
`BodyPose`, or on the left, `CameraPose`. To first order the same motion is, with T = (R, t),

    δ_left = Ad_T δ_right,    δ_body = diag(I, R) δ_right,    δ_camera = diag(R, R) δ_right,

so a Jacobian, which multiplies δ from the left, changes by the same matrices on its right side: J_right = J_left Ad_T. Products
change component by component: a camera on `Product(SE3Left, Euclidean(3))` may move on `Product(SE3, Euclidean(3))`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.manifolds.body_pose import BodyPose
from boxplus.manifolds.camera_pose import CameraPose
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import rotate
from boxplus.manifolds.se3 import SE3, SE3Left

TangentChange = Callable[[int, int, NDArray[np.float64], NDArray[np.uint32], NDArray[np.float64]], None]

POSES: tuple[Manifold, ...] = (SE3, SE3Left, BodyPose, CameraPose)
"""The updates of a pose (7,) that change into each other."""
_RIGHT, _LEFT, _CAMERA = 0, 1, 3  # positions in POSES


@kernel
def _change(
    begin: int,
    end: int,
    x: NDArray[np.float64],
    index: NDArray[np.uint32],
    J: NDArray[np.float64],
    stored: int,
    tangent: int,
    native: int,
    actual: int,
) -> None:
    """Rows j = [a, b] of J times ∂δ_native/∂δ_actual, by way of δ_right; R from the right of a row is Rᵀ on its column.

    The pose begins at number `stored` of x, its tangent at column `tangent` of J.
    """
    s, c = np.uint64(stored), np.uint64(tangent)
    for n in range(np.uint64(begin), np.uint64(end)):
        k = index[n]
        qw, qx, qy, qz = x[k, s], x[k, s + 1], x[k, s + 2], x[k, s + 3]
        tx, ty, tz = x[k, s + 4], x[k, s + 5], x[k, s + 6]
        for row in range(J.shape[1]):
            a0, a1, a2 = J[n, row, c], J[n, row, c + 1], J[n, row, c + 2]
            b0, b1, b2 = J[n, row, c + 3], J[n, row, c + 4], J[n, row, c + 5]
            if native == _LEFT:  # [a, b] Ad = [(a + b [t]x) R, b R], and b [t]x is the row b × t
                a0, a1, a2 = a0 + b1 * tz - b2 * ty, a1 + b2 * tx - b0 * tz, a2 + b0 * ty - b1 * tx
            if native in (_LEFT, _CAMERA):
                a0, a1, a2 = rotate(qw, -qx, -qy, -qz, a0, a1, a2)
            if native != _RIGHT:
                b0, b1, b2 = rotate(qw, -qx, -qy, -qz, b0, b1, b2)
            if actual != _RIGHT:
                b0, b1, b2 = rotate(qw, qx, qy, qz, b0, b1, b2)
            if actual in (_LEFT, _CAMERA):
                a0, a1, a2 = rotate(qw, qx, qy, qz, a0, a1, a2)
            if actual == _LEFT:  # [a, b] Ad⁻¹ = [a Rᵀ − b Rᵀ [t]x, b Rᵀ]
                a0, a1, a2 = a0 - (b1 * tz - b2 * ty), a1 - (b2 * tx - b0 * tz), a2 - (b0 * ty - b1 * tx)
            J[n, row, c], J[n, row, c + 1], J[n, row, c + 2] = a0, a1, a2
            J[n, row, c + 3], J[n, row, c + 4], J[n, row, c + 5] = b0, b1, b2


def tangent_change(native: Manifold, actual: Manifold) -> TangentChange | None:
    """How Jacobians derived on the manifold `native` become those of a variable that lives on `actual`.

    Returns:
        None where the two are equal; else a function of (begin, end, x, index, J) that changes rows [begin, end) of
        J (N, d, dof) in place, residual n being connected to x[index[n]] of x (n, size).

    Raises:
        InputError: the manifolds do not store the same points.
    """
    if native == actual:
        return None
    parts = _parts(native, actual, 0, 0)
    if parts is None:
        raise InputError(
            f"a variable on {native.name}",
            f"one on {actual.name}",
            f"only the updates of a pose change into each other ({', '.join(pose.name for pose in POSES)}); "
            "add the variables on the manifold of the residual",
        )

    def change(begin: int, end: int, x: NDArray[np.float64], index: NDArray[np.uint32], J: NDArray[np.float64]) -> None:
        for part in parts:
            _change(begin, end, x, index, J, *part)

    return change


def _parts(native: Manifold, actual: Manifold, stored: int, tangent: int) -> list[tuple[int, int, int, int]] | None:
    """(stored, tangent, native code, actual code) of every pose to change; None where another component differs."""
    if native == actual:
        return []
    if native in POSES and actual in POSES:
        return [(stored, tangent, POSES.index(native), POSES.index(actual))]
    if not (isinstance(native, Product) and isinstance(actual, Product) and len(native.components) == len(actual.components)):
        return None
    found = []
    for own, other in zip(native.components, actual.components, strict=True):
        parts = _parts(own, other, stored, tangent)
        if parts is None:
            return None
        found += parts
        stored, tangent = stored + own.size, tangent + own.dof
    return found
