"""Rotations SO(3): Exp, Log and their Jacobians (docs/manifolds.md).

Kernels take scalars or write into arrays of their caller; the functions without underscore are batch-first NumPy fronts.
A rotation vector `w` is axis times angle [rad]. Matrices compose by `@`, invert by transposing and are their own adjoint:
R Exp(w) Rᵀ = Exp(R w). `SO3` is the manifold of rotation matrices as variables.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.manifolds._batch import as_batch, map_batch
from boxplus.manifolds._kernel_manifold import KernelManifold, checked_rows
from boxplus.manifolds.manifold import Manifold

SERIES_SWITCH = 1.0  # angle [rad] below which A, B, C come from their series (docs/manifolds.md)
D_SERIES_SWITCH = 0.5
_ROTATION_TOLERANCE = 1e-3  # matrices this far from orthonormal come from rounded files, not from a mistake


@kernel(inline=True)
def exp_coefficients(angle_sq: float) -> tuple[float, float, float]:
    """A = sin θ/θ, B = (1 − cos θ)/θ², C = (θ − sin θ)/θ³ from θ² (docs/manifolds.md)."""
    if angle_sq < SERIES_SWITCH:
        t = angle_sq
        a = 1.0 - t / 6.0 * (
            1.0 - t / 20.0 * (1.0 - t / 42.0 * (1.0 - t / 72.0 * (1.0 - t / 110.0 * (1.0 - t / 156.0 * (1.0 - t / 210.0)))))
        )
        b = 0.5 * (
            1.0
            - t
            / 12.0
            * (1.0 - t / 30.0 * (1.0 - t / 56.0 * (1.0 - t / 90.0 * (1.0 - t / 132.0 * (1.0 - t / 182.0 * (1.0 - t / 240.0))))))
        )
        c = (
            1.0
            - t
            / 20.0
            * (1.0 - t / 42.0 * (1.0 - t / 72.0 * (1.0 - t / 110.0 * (1.0 - t / 156.0 * (1.0 - t / 210.0 * (1.0 - t / 272.0))))))
        ) / 6.0
        return a, b, c
    angle = math.sqrt(angle_sq)
    half_sin = math.sin(0.5 * angle)
    return math.sin(angle) / angle, 2.0 * half_sin * half_sin / angle_sq, (angle - math.sin(angle)) / (angle * angle_sq)


@kernel(inline=True)
def inverse_jacobian_coefficient(angle_sq: float) -> float:
    """D = (1 − θ/2 cot(θ/2))/θ² from θ² (docs/manifolds.md); regular at π."""
    if angle_sq < D_SERIES_SWITCH * D_SERIES_SWITCH:
        t = angle_sq
        high = 1.0 / 1209600.0 + t * (1.0 / 47900160.0 + t * 691.0 / 1307674368000.0)
        return 1.0 / 12.0 + t * (1.0 / 720.0 + t * (1.0 / 30240.0 + t * high))
    half = 0.5 * math.sqrt(angle_sq)
    return (1.0 - half * math.cos(half) / math.sin(half)) / angle_sq


@kernel(inline=True)
def _quadratic(wx: float, wy: float, wz: float, a: float, b: float, out: NDArray[np.float64]) -> None:
    """out = I + a [w]x + b [w]x²."""
    out[0, 0] = 1.0 - b * (wy * wy + wz * wz)
    out[1, 1] = 1.0 - b * (wx * wx + wz * wz)
    out[2, 2] = 1.0 - b * (wx * wx + wy * wy)
    out[0, 1] = b * wx * wy - a * wz
    out[1, 0] = b * wx * wy + a * wz
    out[0, 2] = b * wx * wz + a * wy
    out[2, 0] = b * wx * wz - a * wy
    out[1, 2] = b * wy * wz - a * wx
    out[2, 1] = b * wy * wz + a * wx


@kernel(inline=True)
def exp_into(wx: float, wy: float, wz: float, R: NDArray[np.float64]) -> None:
    """R = Exp(w), (3, 3)."""
    a, b, _ = exp_coefficients(wx * wx + wy * wy + wz * wz)
    _quadratic(wx, wy, wz, a, b, R)


@kernel(inline=True)
def right_jacobian_into(wx: float, wy: float, wz: float, J: NDArray[np.float64]) -> None:
    """J = J_r(w), (3, 3): Exp(w + d) = Exp(w) Exp(J_r(w) d). J_l(w) is J_r(−w)."""
    _, b, c = exp_coefficients(wx * wx + wy * wy + wz * wz)
    _quadratic(wx, wy, wz, -b, c, J)


@kernel(inline=True)
def right_jacobian_inverse_into(wx: float, wy: float, wz: float, J: NDArray[np.float64]) -> None:
    """J = J_r(w)⁻¹, (3, 3). J_l(w)⁻¹ is J_r(−w)⁻¹."""
    _quadratic(wx, wy, wz, 0.5, inverse_jacobian_coefficient(wx * wx + wy * wy + wz * wz), J)


@kernel(inline=True)
def product_into(A: NDArray[np.float64], B: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """out = A B, all (3, 3); out is neither A nor B."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@kernel(inline=True)
def quaternion_scalars(R: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z) of R with w ≥ 0, by the largest element (Shepperd; docs/manifolds.md)."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace >= R[0, 0] and trace >= R[1, 1] and trace >= R[2, 2]:
        w, x, y, z = 1.0 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    elif R[0, 0] >= R[1, 1] and R[0, 0] >= R[2, 2]:
        w, x, y, z = R[2, 1] - R[1, 2], 1.0 + R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]
    elif R[1, 1] >= R[2, 2]:
        w, x, y, z = R[0, 2] - R[2, 0], R[0, 1] + R[1, 0], 1.0 + R[1, 1] - R[0, 0] - R[2, 2], R[1, 2] + R[2, 1]
    else:
        w, x, y, z = R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], 1.0 + R[2, 2] - R[0, 0] - R[1, 1]
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    if w < 0.0:
        scale = -scale
    return scale * w, scale * x, scale * y, scale * z


@kernel
def quaternion_into(R: NDArray[np.float64], q_wxyz: NDArray[np.float64]) -> None:
    """As `quaternion_scalars`, into (4,)."""
    q_wxyz[0], q_wxyz[1], q_wxyz[2], q_wxyz[3] = quaternion_scalars(R)


@kernel
def log_quaternion(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Rotation vector of the unit quaternion (w, x, y, z), angle in [0, π] (docs/manifolds.md)."""
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    norm_sq = x * x + y * y + z * z
    if norm_sq < 1e-12:
        factor = 2.0 / w * (1.0 - norm_sq / (3.0 * w * w))
    else:
        norm = math.sqrt(norm_sq)
        factor = 2.0 * math.atan2(norm, w) / norm
    return factor * x, factor * y, factor * z


@kernel
def log_into(R: NDArray[np.float64], w: NDArray[np.float64]) -> None:
    """w = Log(R), (3,)."""
    qw, qx, qy, qz = quaternion_scalars(R)
    w[0], w[1], w[2] = log_quaternion(qw, qx, qy, qz)


@kernel
def _exp_batch(w: NDArray[np.float64], R: NDArray[np.float64]) -> None:
    for i in range(w.shape[0]):
        exp_into(w[i, 0], w[i, 1], w[i, 2], R[i])


@kernel
def _log_batch(R: NDArray[np.float64], w: NDArray[np.float64]) -> None:
    for i in range(R.shape[0]):
        log_into(R[i], w[i])


@kernel
def right_jacobian_batch(w: NDArray[np.float64], J: NDArray[np.float64]) -> None:
    for i in range(w.shape[0]):
        right_jacobian_into(w[i, 0], w[i, 1], w[i, 2], J[i])


@kernel
def right_jacobian_inverse_batch(w: NDArray[np.float64], J: NDArray[np.float64]) -> None:
    for i in range(w.shape[0]):
        right_jacobian_inverse_into(w[i, 0], w[i, 1], w[i, 2], J[i])


def exp(w: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    return map_batch(_exp_batch, "w", w, (3,), (3, 3))


def log(R: ArrayLike) -> NDArray[np.float64]:
    """Rotation vectors (..., 3) [rad], angle in [0, π], of rotation matrices (..., 3, 3)."""
    return map_batch(_log_batch, "R", R, (3, 3), (3,))


def right_jacobian(w: ArrayLike) -> NDArray[np.float64]:
    """J_r (..., 3, 3) at w (..., 3): Exp(w + d) ≈ Exp(w) Exp(J_r(w) d)."""
    return map_batch(right_jacobian_batch, "w", w, (3,), (3, 3))


def left_jacobian(w: ArrayLike) -> NDArray[np.float64]:
    """J_l (..., 3, 3) at w (..., 3): Exp(w + d) ≈ Exp(J_l(w) d) Exp(w); J_l(w) = J_r(−w)."""
    return right_jacobian(-np.asarray(w, dtype=np.float64))


def right_jacobian_inverse(w: ArrayLike) -> NDArray[np.float64]:
    """J_r⁻¹ (..., 3, 3) at w (..., 3): Log(Exp(w) Exp(d)) ≈ w + J_r⁻¹(w) d."""
    return map_batch(right_jacobian_inverse_batch, "w", w, (3,), (3, 3))


def left_jacobian_inverse(w: ArrayLike) -> NDArray[np.float64]:
    """J_l⁻¹ (..., 3, 3) at w (..., 3): Log(Exp(d) Exp(w)) ≈ w + J_l⁻¹(w) d."""
    return right_jacobian_inverse(-np.asarray(w, dtype=np.float64))


def hat(w: ArrayLike) -> NDArray[np.float64]:
    """Cross-product matrices [w]x (..., 3, 3) of vectors (..., 3)."""
    vectors, lead = as_batch("w", w, (3,))
    matrices = np.zeros((len(vectors), 3, 3))
    for row, column, component, sign in ((0, 1, 2, -1), (0, 2, 1, 1), (1, 0, 2, 1), (1, 2, 0, -1), (2, 0, 1, -1), (2, 1, 0, 1)):
        matrices[:, row, column] = sign * vectors[:, component]
    return matrices.reshape((*lead, 3, 3))


def ad(w: ArrayLike) -> NDArray[np.float64]:
    """ad(w) = [w]x (..., 3, 3) of (..., 3): ad(a) b = a × b is the Lie bracket, and Exp(w) = exp(ad(w)) is the adjoint.

    Example:
        >>> ad([0.0, 0.0, 1.0]) @ [1.0, 0.0, 0.0]
        array([0., 1., 0.])
    """
    return hat(w)


def boxplus(R: ArrayLike, w: ArrayLike) -> NDArray[np.float64]:
    """R ⊞ w = R Exp(w): right (local) update."""
    return np.asarray(np.asarray(R, dtype=np.float64) @ exp(w))


def boxminus(R: ArrayLike, R_base: ArrayLike) -> NDArray[np.float64]:
    """R ⊟ R_base = Log(R_baseᵀ R): the w with R_base ⊞ w = R."""
    return log(np.swapaxes(np.asarray(R_base, dtype=np.float64), -1, -2) @ np.asarray(R, dtype=np.float64))


def is_rotation(R: ArrayLike, tolerance: float = 1e-6) -> bool:
    """Whether every (3, 3) matrix is orthonormal with determinant +1 within `tolerance` per entry."""
    matrices, _ = as_batch("R", R, (3, 3))
    orthonormal = np.abs(np.swapaxes(matrices, -1, -2) @ matrices - np.eye(3)).max(initial=0.0) <= tolerance
    return bool(np.isfinite(matrices).all() and orthonormal and (np.linalg.det(matrices) > 0).all())


@kernel
def _boxplus_batch(x: NDArray[np.float64], delta: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    step = np.empty((3, 3))
    for i in range(x.shape[0]):
        exp_into(delta[i, 0], delta[i, 1], delta[i, 2], step)
        for row in range(3):
            a, b, c = x[i, 3 * row], x[i, 3 * row + 1], x[i, 3 * row + 2]
            for column in range(3):
                out[i, 3 * row + column] = a * step[0, column] + b * step[1, column] + c * step[2, column]


@kernel
def _boxminus_batch(x: NDArray[np.float64], base: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    difference = np.empty((3, 3))
    for i in range(x.shape[0]):
        for row in range(3):
            for column in range(3):
                difference[row, column] = (
                    base[i, row] * x[i, column] + base[i, 3 + row] * x[i, 3 + column] + base[i, 6 + row] * x[i, 6 + column]
                )
        log_into(difference, out[i])


@dataclass(frozen=True, repr=False)
class _SO3(KernelManifold):
    """Rotation matrices stored row by row (9,), moved by rotation vectors (3,) on the right: R Exp(w).

    Example:
        >>> R = bp.SO3.boxplus(bp.SO3.identity(), [0.0, 0.0, np.pi / 2])
        >>> R.reshape(3, 3).round(3)
        array([[ 0., -1.,  0.],
               [ 1.,  0.,  0.],
               [ 0.,  0.,  1.]])
    """

    name = "SO3"
    size = 9
    dof = 3
    tangent_names = ("rotation x [rad]", "rotation y [rad]", "rotation z [rad]")

    def boxplus_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        _boxplus_batch(x, delta, out)

    def boxminus_into(self, x: NDArray[np.float64], base: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        _boxminus_batch(x, base, out)

    def boxplus_jacobian_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        right_jacobian_batch(delta, J)

    def boxminus_jacobian_into(self, x: NDArray[np.float64], base: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        difference = np.empty((len(x), 3))
        _boxminus_batch(x, base, difference)
        right_jacobian_inverse_batch(difference, J)

    def check(self, name: str, x: ArrayLike) -> NDArray[np.float64]:
        """As `Manifold.check`; takes (n, 3, 3) and (3, 3) as well."""
        shape = np.shape(x)
        if shape[-2:] == (3, 3) and len(shape) in (2, 3):
            x = np.reshape(np.asarray(x, dtype=np.float64), (-1, 9))
        rows = checked_rows(name, x, 9, self.name)
        matrices = rows.reshape(-1, 3, 3)
        # U Vᵀ of the singular value decomposition is the nearest orthonormal matrix.
        left, stretch, right = np.linalg.svd(matrices)
        off = (np.abs(stretch - 1.0).max(axis=1) > _ROTATION_TOLERANCE) | (np.linalg.det(matrices) < 0.0)
        if off.any():
            row = int(np.argmax(off))
            raise InputError(
                f"{name} as rotation matrices",
                f"singular values {stretch[row].round(6)}, determinant {np.linalg.det(matrices[row]):.6g} in row {row}",
                "orthonormalise it, or check whether rows and columns are exchanged or mirrored",
            )
        rows[:] = (left @ right).reshape(-1, 9)
        return rows

    def identity(self) -> NDArray[np.float64]:
        return np.eye(3).ravel()

    def random(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        q = rng.normal(size=(count, 4))
        w = 2.0 * np.arctan2(np.linalg.norm(q[:, 1:], axis=1), q[:, 0])
        return exp(q[:, 1:] * (w / np.linalg.norm(q[:, 1:], axis=1))[:, None]).reshape(count, 9)


SO3: Manifold = _SO3()
