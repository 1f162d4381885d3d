"""Straight lines in space in the orthonormal representation (docs/residuals/line_reprojection.md; Bartoli and Sturm, 2005).

A line through the point p with direction d has Plücker coordinates L = [m; d], m = p × d, defined up to scale. It is stored as
[qw, qx, qy, qz, phi]: the quaternion of U = [u₁, u₂, u₃] = [m/‖m‖, d/‖d‖, u₁ × u₂] and phi = atan2(‖d‖, ‖m‖), so that
L = [cos phi u₁; sin phi u₂] has unit length and ‖m‖/‖d‖ = cot phi is the distance to the origin. Its 4 degrees of freedom
move by U Exp(θ), phi + δ.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.manifolds._batch import as_batch, map_batch
from boxplus.manifolds._kernel_manifold import KernelManifold, normalize_quaternions
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.quaternion import (
    exp_scalars,
    from_matrix,
    multiply_scalars,
    normalized_scalars,
    rotation_entries,
    to_matrix,
)
from boxplus.manifolds.se2 import wrapped_angle
from boxplus.manifolds.se3 import SE3Left
from boxplus.manifolds.so3 import hat, log_quaternion, right_jacobian_into, right_jacobian_inverse_into
from boxplus.manifolds.tangents.change import tangent_change

_NO_MOMENT = 1e-12  # ‖m‖ below this share of ‖d‖ has no direction of its own: the line goes through the origin


@kernel
def _to_plucker_batch(line: NDArray[np.float64], L: NDArray[np.float64]) -> None:
    for i in range(line.shape[0]):
        u00, u01, _, u10, u11, _, u20, u21, _ = rotation_entries(line[i, 0], line[i, 1], line[i, 2], line[i, 3])
        w1, w2 = math.cos(line[i, 4]), math.sin(line[i, 4])
        L[i, 0], L[i, 1], L[i, 2] = w1 * u00, w1 * u10, w1 * u20
        L[i, 3], L[i, 4], L[i, 5] = w2 * u01, w2 * u11, w2 * u21


@kernel
def _boxplus_batch(x: NDArray[np.float64], delta: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    for i in range(x.shape[0]):
        w, a, b, c = exp_scalars(delta[i, 0], delta[i, 1], delta[i, 2])
        w, a, b, c = multiply_scalars(x[i, 0], x[i, 1], x[i, 2], x[i, 3], w, a, b, c)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = normalized_scalars(w, a, b, c)
        out[i, 4] = wrapped_angle(x[i, 4] + delta[i, 3])


@kernel
def _boxminus_batch(x: NDArray[np.float64], base: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    for i in range(x.shape[0]):
        w, a, b, c = multiply_scalars(base[i, 0], -base[i, 1], -base[i, 2], -base[i, 3], x[i, 0], x[i, 1], x[i, 2], x[i, 3])
        out[i, 0], out[i, 1], out[i, 2] = log_quaternion(w, a, b, c)
        out[i, 3] = wrapped_angle(x[i, 4] - base[i, 4])


@kernel
def _jacobian_batch(delta: NDArray[np.float64], is_inverse: bool, J: NDArray[np.float64]) -> None:
    for i in range(delta.shape[0]):
        if is_inverse:
            right_jacobian_inverse_into(delta[i, 0], delta[i, 1], delta[i, 2], J[i])
        else:
            right_jacobian_into(delta[i, 0], delta[i, 1], delta[i, 2], J[i])
        J[i, 3, 3] = 1.0


def to_plucker(line: ArrayLike) -> NDArray[np.float64]:
    """Plücker coordinates [m; d] (..., 6) of unit length of stored lines (..., 5)."""
    return map_batch(_to_plucker_batch, "line", line, (5,), (6,))


def from_plucker(L: ArrayLike) -> NDArray[np.float64]:
    """Stored lines (..., 5) of Plücker coordinates [m; d] (..., 6) of any scale; m is first made orthogonal to d.

    Where m = 0, the line goes through the origin and any u₁ orthogonal to d serves.

    Raises:
        InputError: not finite, or a line without direction (d = 0).
    """
    rows, lead = as_batch("L", L, (6,))
    m, d = rows[:, :3], rows[:, 3:]
    length = np.linalg.norm(d, axis=1)
    bad = ~np.isfinite(rows).all(axis=1) | ~(length > 0.0)
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(
            "Plücker coordinates [m; d] with a finite m and a direction d",
            f"{rows[row]} in row {row}",
            "leave this line out, or check the order of m and d",
        )
    u2 = d / length[:, None]
    m = m - (m * u2).sum(axis=1, keepdims=True) * u2
    moment = np.linalg.norm(m, axis=1)
    through_origin = moment <= _NO_MOMENT * length
    # The axis least along d gives a vector that is safely off it.
    other = np.eye(3)[np.argmin(np.abs(u2), axis=1)]
    m = np.where(through_origin[:, None], np.cross(other, u2), m)
    u1 = m / np.linalg.norm(m, axis=1, keepdims=True)
    U = np.stack([u1, u2, np.cross(u1, u2)], axis=2)
    phi = np.arctan2(length, np.where(through_origin, 0.0, moment))
    return np.column_stack([from_matrix(U), phi]).reshape((*lead, 5))


def from_points(p: ArrayLike, q: ArrayLike) -> NDArray[np.float64]:
    """Stored lines (..., 5) through the points p and q (..., 3), with direction q − p.

    Raises:
        InputError: the points coincide or are not finite.
    """
    start, end = np.broadcast_arrays(np.asarray(p, dtype=np.float64), np.asarray(q, dtype=np.float64))
    d = end - start
    return from_plucker(np.concatenate([np.cross(start, d), d], axis=-1))


def motion_matrix(T_ab: ArrayLike) -> NDArray[np.float64]:
    """[[R, [t]x R], [0, R]] (..., 6, 6) of motions (..., 7): L_a = M L_b of Plücker coordinates [m; d] (docs/lines.md).

    The same matrix is ∂L_a/∂L_b. Bartoli and Sturm, Structure from motion using lines, 2005, section 3.1: the line motion matrix.

    Example:
        >>> motion_matrix([1.0, 0, 0, 0, 0, 0, 2.0])[0]  # m grows by t × d
        array([ 1.,  0.,  0.,  0., -2.,  0.])
    """
    rows, lead = as_batch("T_ab", T_ab, (7,))
    R = to_matrix(rows[:, :4])
    M = np.zeros((len(rows), 6, 6))
    M[:, :3, :3] = M[:, 3:, 3:] = R
    M[:, :3, 3:] = hat(rows[:, 4:]) @ R
    return M.reshape((*lead, 6, 6))


def transform(T_ab: ArrayLike, L_b: ArrayLike) -> NDArray[np.float64]:
    """Plücker coordinates [m; d] (..., 6) in a of those in b: m_a = R m + t × R d, d_a = R d.

    Example:
        >>> transform([1.0, 0, 0, 0, 0, 0, 2.0], [0.0, 0, 0, 1, 0, 0])  # the x axis, two metres up: m = p × d
        array([0., 2., 0., 1., 0., 0.])
    """
    return np.asarray((motion_matrix(T_ab) @ np.asarray(L_b, dtype=np.float64)[..., None])[..., 0])


def transform_jacobian(T_ab: ArrayLike, L_b: ArrayLike, manifold: Manifold = SE3Left) -> NDArray[np.float64]:
    """∂L_a/∂δ (..., 6, 6) of `transform` by the motion, which moves on `manifold`: any update of a pose (docs/lines.md).

    On the left it is [[−[m_a]x, −[d_a]x], [−[d_a]x, 0]]; on `CameraPose`, whose translation is added, −[R m]x − [t]x [d_a]x takes
    the place of −[m_a]x.

    Raises:
        InputError: no update of a pose (7,).

    Example:
        >>> J = transform_jacobian([1.0, 0, 0, 0, 0, 0, 2.0], [0.0, 0, 0, 1, 0, 0])
        >>> J[:, 4] + 0.0  # moving it along y: m gains e_y × d
        array([ 0.,  0., -1.,  0.,  0.,  0.])
    """
    L_a = transform(T_ab, L_b)
    J = np.zeros((*L_a.shape, 6))
    J[..., :3, :3] = -hat(L_a[..., :3])
    J[..., :3, 3:] = J[..., 3:, :3] = -hat(L_a[..., 3:])
    rows = J.reshape(-1, 6, 6)
    change = tangent_change(SE3Left, manifold)
    if change is not None:
        T = np.ascontiguousarray(np.broadcast_to(np.asarray(T_ab, dtype=np.float64), (*L_a.shape[:-1], 7))).reshape(-1, 7)
        change(0, len(rows), T, np.arange(len(rows), dtype=np.uint32), rows)
    return rows.reshape(J.shape)


@dataclass(frozen=True, repr=False)
class _Line3D(KernelManifold):
    """Lines (5,) moved by [θ, δ] (4,): U Exp(θ), phi + δ. Opposite directions of a line are different points.

    Example:
        >>> from boxplus.manifolds import lines
        >>> line = lines.from_points([0.0, 0.0, 1.0], [1.0, 0.0, 1.0])  # along x, at z = 1
        >>> line.shape, bp.Line3D.boxminus(line, line)
        ((5,), array([0., 0., 0., 0.]))
    """

    name = "Line3D"
    size = 5
    dof = 4
    tangent_names = (
        "rotation about the moment [rad]",
        "rotation about the direction [rad]",
        "rotation about the normal of both [rad]",
        "distance angle phi [rad]",
    )

    def boxplus_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        _boxplus_batch(x, delta, out)

    def boxminus_into(self, x: NDArray[np.float64], base: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        _boxminus_batch(x, base, out)

    def boxplus_jacobian_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        _jacobian_batch(delta, False, J)

    def boxminus_jacobian_into(self, x: NDArray[np.float64], base: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        difference = np.empty((len(x), 4))
        _boxminus_batch(x, base, difference)
        _jacobian_batch(difference, True, J)

    def check(self, name: str, x: ArrayLike) -> NDArray[np.float64]:
        rows = super().check(name, x)
        normalize_quaternions(name, rows)
        rows[:, 4] = np.arctan2(np.sin(rows[:, 4]), np.cos(rows[:, 4]))
        return rows

    def identity(self) -> NDArray[np.float64]:
        """The line along y through the point (0, 0, −1)."""
        return np.array([1.0, 0.0, 0.0, 0.0, 0.25 * np.pi])

    def random(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        return from_points(rng.normal(size=(count, 3)), rng.normal(size=(count, 3)))


Line3D: Manifold = _Line3D()
