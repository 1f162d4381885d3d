"""Unit quaternions, Hamilton, stored wxyz (docs/manifolds.md). q and −q are the same rotation.

The kernels take and return scalars, for the inner loops of residuals; the functions below them are batch-first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.manifolds._batch import as_batch, map_batch, map_pairs
from boxplus.manifolds._kernel_manifold import KernelManifold, normalize_quaternions
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.so3 import (
    SERIES_SWITCH,
    hat,
    log_quaternion,
    quaternion_scalars,
    right_jacobian_batch,
    right_jacobian_inverse_batch,
)


@kernel(inline=True)
def multiply_scalars(
    pw: float, px: float, py: float, pz: float, qw: float, qx: float, qy: float, qz: float
) -> tuple[float, float, float, float]:
    """p ⊗ q as (w, x, y, z)."""
    return (
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    )


@kernel(inline=True)
def rotate(w: float, x: float, y: float, z: float, px: float, py: float, pz: float) -> tuple[float, float, float]:
    """R(q) p of a unit quaternion (w, x, y, z) as (x, y, z); with (w, −x, −y, −z) it is Rᵀ p."""
    cx = 2.0 * (y * pz - z * py)
    cy = 2.0 * (z * px - x * pz)
    cz = 2.0 * (x * py - y * px)
    return px + w * cx + y * cz - z * cy, py + w * cy + z * cx - x * cz, pz + w * cz + x * cy - y * cx


@kernel(inline=True)
def rotation_entries(
    w: float, x: float, y: float, z: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """The nine entries of R(q), row by row, of a unit quaternion (w, x, y, z)."""
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz = x * y, x * z, y * z
    wx, wy, wz = w * x, w * y, w * z
    return (
        1.0 - 2.0 * (yy + zz),
        2.0 * (xy - wz),
        2.0 * (xz + wy),
        2.0 * (xy + wz),
        1.0 - 2.0 * (xx + zz),
        2.0 * (yz - wx),
        2.0 * (xz - wy),
        2.0 * (yz + wx),
        1.0 - 2.0 * (xx + yy),
    )


@kernel(inline=True)
def half_angle(angle_sq: float) -> tuple[float, float]:
    """cos(θ/2) and sin(θ/2)/θ from θ²; by their series below the switch of the other coefficients (docs/manifolds.md)."""
    if angle_sq < SERIES_SWITCH:
        t = 0.25 * angle_sq
        c = 1.0 - t / 2.0 * (
            1.0 - t / 12.0 * (1.0 - t / 30.0 * (1.0 - t / 56.0 * (1.0 - t / 90.0 * (1.0 - t / 132.0 * (1.0 - t / 182.0)))))
        )
        s = 0.5 - t / 12.0 * (1.0 - t / 20.0 * (1.0 - t / 42.0 * (1.0 - t / 72.0 * (1.0 - t / 110.0 * (1.0 - t / 156.0)))))
        return c, s
    angle = math.sqrt(angle_sq)
    return math.cos(0.5 * angle), math.sin(0.5 * angle) / angle


@kernel(inline=True)
def exp_scalars(wx: float, wy: float, wz: float) -> tuple[float, float, float, float]:
    """Exp_q of a rotation vector as (w, x, y, z): [cos θ/2, sin(θ/2) axis] (docs/manifolds.md)."""
    c, s = half_angle(wx * wx + wy * wy + wz * wz)
    return c, s * wx, s * wy, s * wz


@kernel(inline=True)
def normalized_scalars(w: float, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """(w, x, y, z) brought to unit length, for a product that is stored."""
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return scale * w, scale * x, scale * y, scale * z


@kernel
def _from_matrix_batch(R: NDArray[np.float64], q_wxyz: NDArray[np.float64]) -> None:
    for i in range(R.shape[0]):
        q_wxyz[i, 0], q_wxyz[i, 1], q_wxyz[i, 2], q_wxyz[i, 3] = quaternion_scalars(R[i])


def from_matrix(R: ArrayLike) -> NDArray[np.float64]:
    """Unit quaternions wxyz (..., 4) with w ≥ 0 of rotation matrices (..., 3, 3)."""
    return map_batch(_from_matrix_batch, "R", R, (3, 3), (4,))


@kernel
def _to_matrix_batch(q_wxyz: NDArray[np.float64], R: NDArray[np.float64]) -> None:
    for i in range(q_wxyz.shape[0]):
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_entries(q_wxyz[i, 0], q_wxyz[i, 1], q_wxyz[i, 2], q_wxyz[i, 3])
        R[i, 0, 0], R[i, 0, 1], R[i, 0, 2] = r00, r01, r02
        R[i, 1, 0], R[i, 1, 1], R[i, 1, 2] = r10, r11, r12
        R[i, 2, 0], R[i, 2, 1], R[i, 2, 2] = r20, r21, r22


def to_matrix(q_wxyz: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrices (..., 3, 3) of unit quaternions wxyz (..., 4); the caller normalises."""
    return map_batch(_to_matrix_batch, "q_wxyz", q_wxyz, (4,), (3, 3))


@kernel
def _multiply_batch(p: NDArray[np.float64], q: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    for i in range(p.shape[0]):
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = multiply_scalars(
            p[i, 0], p[i, 1], p[i, 2], p[i, 3], q[i, 0], q[i, 1], q[i, 2], q[i, 3]
        )


def multiply(p_wxyz: ArrayLike, q_wxyz: ArrayLike) -> NDArray[np.float64]:
    """Hamilton product p ⊗ q, (..., 4): R(p ⊗ q) = R(p) R(q)."""
    return map_pairs(_multiply_batch, "p_wxyz", p_wxyz, 4, "q_wxyz", q_wxyz, 4, 4)


def left_matrix(q_wxyz: ArrayLike) -> NDArray[np.float64]:
    """[q]_L (..., 4, 4) of quaternions wxyz (..., 4): q ⊗ p = [q]_L p, linear in p (docs/manifolds.md).

    Example:
        >>> q, p = [0.5, 0.5, 0.5, 0.5], [0.0, 1.0, 0.0, 0.0]
        >>> left_matrix(q) @ p, multiply(q, p)
        (array([-0.5,  0.5,  0.5, -0.5]), array([-0.5,  0.5,  0.5, -0.5]))
    """
    return _product_matrix(q_wxyz, 1.0)


def right_matrix(q_wxyz: ArrayLike) -> NDArray[np.float64]:
    """[q]_R (..., 4, 4) of quaternions wxyz (..., 4): p ⊗ q = [q]_R p, linear in p (docs/manifolds.md).

    Example:
        >>> q, p = [0.5, 0.5, 0.5, 0.5], [0.0, 1.0, 0.0, 0.0]
        >>> right_matrix(q) @ p, multiply(p, q)
        (array([-0.5,  0.5, -0.5,  0.5]), array([-0.5,  0.5, -0.5,  0.5]))
    """
    return _product_matrix(q_wxyz, -1.0)


def _product_matrix(q_wxyz: ArrayLike, sign: float) -> NDArray[np.float64]:
    """[w, −vᵀ; v, w I ± [v]×]."""
    rows, lead = as_batch("q_wxyz", q_wxyz, (4,))
    M = np.zeros((len(rows), 4, 4))
    M[:, 0, 1:], M[:, 1:, 0] = -rows[:, 1:], rows[:, 1:]
    M[:, 1:, 1:] = sign * hat(rows[:, 1:])
    M[:, range(4), range(4)] = rows[:, :1]
    return M.reshape((*lead, 4, 4))


def from_half_angle_vector(epsilon: ArrayLike) -> NDArray[np.float64]:
    """Quaternions [√(1 − εᵀε), ε] (..., 4) of half-angle vectors ε = sin(θ/2) axis (..., 3), up to half a turn.

    Raises:
        InputError: longer than 1.

    Example:
        >>> from_half_angle_vector([0.6, 0.0, 0.0])
        array([0.8, 0.6, 0. , 0. ])
    """
    rows, lead = as_batch("epsilon", epsilon, (3,))
    square = (rows * rows).sum(axis=1)
    if not (square <= 1.0).all():
        row = int(np.argmin(square <= 1.0))
        raise InputError("half-angle vectors no longer than 1", f"{rows[row]} in row {row}", "rotation vectors have `so3.exp`")
    return np.column_stack([np.sqrt(1.0 - square), rows]).reshape((*lead, 4))


def to_half_angle_vector(q_wxyz: ArrayLike) -> NDArray[np.float64]:
    """Half-angle vectors ε = sin(θ/2) axis (..., 3) of unit quaternions wxyz (..., 4), of q and −q alike.

    Example:
        >>> to_half_angle_vector([-0.8, -0.6, 0.0, 0.0])
        array([ 0.6, -0. , -0. ])
    """
    rows, lead = as_batch("q_wxyz", q_wxyz, (4,))
    return np.asarray(np.where(rows[:, :1] < 0.0, -rows[:, 1:], rows[:, 1:])).reshape((*lead, 3))


def rotation_jacobian(
    q_wxyz: ArrayLike, p: ArrayLike, by: Literal["quaternion", "right", "left", "half_angle"] = "quaternion"
) -> NDArray[np.float64]:
    """Derivative of the rotated point q ⊗ [0, p] ⊗ q* (..., 3) of p (..., 3) by its rotation (docs/manifolds.md).

    Args:
        by: the "quaternion" as four free numbers, (..., 3, 4): 2 [w p + v × p | vᵀp I + v pᵀ − p vᵀ − w [p]×] (Solà, Quaternion
            kinematics for the error-state Kalman filter, 2017, equation 174). A rotation vector on the "right", −R [p]×, or the
            "left", −[R p]×, or the "half_angle" vector on the right, −2 R [p]×: (..., 3, 3).

    Example:
        >>> rotation_jacobian([1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0], by="right") + 0.0  # turning about z moves x along y
        array([[ 0.,  0.,  0.],
               [ 0.,  0.,  1.],
               [ 0., -1.,  0.]])
    """
    q, p = np.asarray(q_wxyz, dtype=np.float64), np.asarray(p, dtype=np.float64)
    if by == "quaternion":
        w, v = q[..., :1], q[..., 1:]
        J = np.empty((*np.broadcast_shapes(v.shape, p.shape), 4))
        J[..., 0] = w * p + np.cross(v, p)
        J[..., 1:] = (v * p).sum(axis=-1)[..., None, None] * np.eye(3) - w[..., None] * hat(p)
        J[..., 1:] += v[..., :, None] * p[..., None, :] - p[..., :, None] * v[..., None, :]
        return 2.0 * J
    R = to_matrix(q)
    if by == "left":
        return np.asarray(-hat((R @ p[..., None])[..., 0]))
    if by not in ("right", "half_angle"):
        raise InputError('by "quaternion", "right", "left" or "half_angle"', repr(by), "see docs/manifolds.md")
    return np.asarray((-2.0 if by == "half_angle" else -1.0) * R @ hat(p))


@kernel
def _boxplus_batch(x: NDArray[np.float64], delta: NDArray[np.float64], is_left: bool, out: NDArray[np.float64]) -> None:
    for i in range(x.shape[0]):
        w, a, b, c = exp_scalars(delta[i, 0], delta[i, 1], delta[i, 2])
        if is_left:
            w, a, b, c = multiply_scalars(w, a, b, c, x[i, 0], x[i, 1], x[i, 2], x[i, 3])
        else:
            w, a, b, c = multiply_scalars(x[i, 0], x[i, 1], x[i, 2], x[i, 3], w, a, b, c)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = normalized_scalars(w, a, b, c)


@kernel
def _boxminus_batch(x: NDArray[np.float64], base: NDArray[np.float64], is_left: bool, out: NDArray[np.float64]) -> None:
    for i in range(x.shape[0]):
        bw, bx, by, bz = base[i, 0], -base[i, 1], -base[i, 2], -base[i, 3]
        if is_left:
            w, a, b, c = multiply_scalars(x[i, 0], x[i, 1], x[i, 2], x[i, 3], bw, bx, by, bz)
        else:
            w, a, b, c = multiply_scalars(bw, bx, by, bz, x[i, 0], x[i, 1], x[i, 2], x[i, 3])
        out[i, 0], out[i, 1], out[i, 2] = log_quaternion(w, a, b, c)


@dataclass(frozen=True, repr=False)
class _UnitQuaternion(KernelManifold):
    """Rotations stored wxyz (4,), moved by rotation vectors (3,): on the right, q ⊗ Exp_q(w), or on the left, Exp_q(w) ⊗ q.

    Example:
        >>> bp.UnitQuaternion.boxplus([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2]).round(3)
        array([0.707, 0.   , 0.   , 0.707])
    """

    name: str
    is_left: bool
    size = 4
    dof = 3
    tangent_names = ("rotation x [rad]", "rotation y [rad]", "rotation z [rad]")

    def boxplus_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        _boxplus_batch(x, delta, self.is_left, out)

    def boxminus_into(self, x: NDArray[np.float64], base: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        _boxminus_batch(x, base, self.is_left, out)

    def boxplus_jacobian_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        right_jacobian_batch(-delta if self.is_left else delta, J)  # J_l(w) = J_r(−w)

    def boxminus_jacobian_into(self, x: NDArray[np.float64], base: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        difference = np.empty((len(x), 3))
        _boxminus_batch(x, base, self.is_left, difference)
        right_jacobian_inverse_batch(-difference if self.is_left else difference, J)

    def check(self, name: str, x: ArrayLike) -> NDArray[np.float64]:
        rows = super().check(name, x)
        normalize_quaternions(name, rows)
        return rows

    def identity(self) -> NDArray[np.float64]:
        return np.array([1.0, 0.0, 0.0, 0.0])

    def random(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        q = rng.normal(size=(count, 4))
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        return q


UnitQuaternion: Manifold = _UnitQuaternion("UnitQuaternion", False)
UnitQuaternionLeft: Manifold = _UnitQuaternion("UnitQuaternionLeft", True)
