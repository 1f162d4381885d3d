"""Rigid motions of the plane SE(2), stored [theta, x, y], theta in [−π, π].

Tangents are ξ = [w, vx, vy], rotation first [rad, m]. SE(2) is the part of SE(3) that turns about z and moves in x, y, and so
are its Exp, Log and Jacobians (docs/manifolds.md). `SE2` moves a pose on the right (local).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.manifolds._batch import map_batch, map_pairs
from boxplus.manifolds._kernel_manifold import KernelManifold
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.so3 import exp_coefficients, inverse_jacobian_coefficient


@kernel(inline=True)
def wrapped_angle(angle: float) -> float:
    """The angle in [−π, π] that turns as far; an angle in that range keeps its bits."""
    if -math.pi <= angle <= math.pi:
        return angle
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@kernel(inline=True)
def exp_scalars(w: float, vx: float, vy: float) -> tuple[float, float, float]:
    """(theta, x, y) of Exp(w, v)."""
    _, b, c = exp_coefficients(w * w)
    a, b = 1.0 - w * w * c, w * b
    return w, a * vx - b * vy, b * vx + a * vy


@kernel(inline=True)
def log_scalars(theta: float, x: float, y: float) -> tuple[float, float, float]:
    """(w, vx, vy) of the pose (theta, x, y); w in [−π, π]."""
    w = wrapped_angle(theta)
    a, b = 1.0 - w * w * inverse_jacobian_coefficient(w * w), 0.5 * w
    return w, a * x + b * y, a * y - b * x


@kernel(inline=True)
def compose_scalars(
    theta_ab: float, x_ab: float, y_ab: float, theta_bc: float, x_bc: float, y_bc: float
) -> tuple[float, float, float]:
    """(theta, x, y) of T_ac = T_ab T_bc."""
    c, s = math.cos(theta_ab), math.sin(theta_ab)
    return wrapped_angle(theta_ab + theta_bc), x_ab + c * x_bc - s * y_bc, y_ab + s * x_bc + c * y_bc


@kernel(inline=True)
def between_scalars(theta_a: float, x_a: float, y_a: float, theta_b: float, x_b: float, y_b: float) -> tuple[float, float, float]:
    """(theta, x, y) of T_ab = T_wa⁻¹ T_wb."""
    c, s = math.cos(theta_a), math.sin(theta_a)
    x, y = x_b - x_a, y_b - y_a
    return wrapped_angle(theta_b - theta_a), c * x + s * y, c * y - s * x


@kernel(inline=True)
def right_jacobian_into(w: float, vx: float, vy: float, J: NDArray[np.float64]) -> None:
    """J = J_r(ξ), (3, 3): Exp(ξ + d) = Exp(ξ) Exp(J_r(ξ) d). J_l(ξ) is J_r(−ξ)."""
    _, b, c = exp_coefficients(w * w)
    a = 1.0 - w * w * c
    J[0, 0], J[0, 1], J[0, 2] = 1.0, 0.0, 0.0
    J[1, 0], J[1, 1], J[1, 2] = c * w * vx - b * vy, a, b * w
    J[2, 0], J[2, 1], J[2, 2] = c * w * vy + b * vx, -b * w, a


@kernel(inline=True)
def right_jacobian_inverse_into(w: float, vx: float, vy: float, J: NDArray[np.float64]) -> None:
    """J = J_r(ξ)⁻¹, (3, 3): Log(Exp(ξ) Exp(d)) = ξ + J_r(ξ)⁻¹ d. J_l(ξ)⁻¹ is J_r(−ξ)⁻¹."""
    d = inverse_jacobian_coefficient(w * w)
    a = 1.0 - w * w * d
    J[0, 0], J[0, 1], J[0, 2] = 1.0, 0.0, 0.0
    J[1, 0], J[1, 1], J[1, 2] = d * w * vx + 0.5 * vy, a, -0.5 * w
    J[2, 0], J[2, 1], J[2, 2] = d * w * vy - 0.5 * vx, 0.5 * w, a


@kernel
def _exp_batch(xi: NDArray[np.float64], T: NDArray[np.float64]) -> None:
    for i in range(xi.shape[0]):
        w, T[i, 1], T[i, 2] = exp_scalars(xi[i, 0], xi[i, 1], xi[i, 2])
        T[i, 0] = wrapped_angle(w)


@kernel
def _log_batch(T: NDArray[np.float64], xi: NDArray[np.float64]) -> None:
    for i in range(T.shape[0]):
        xi[i, 0], xi[i, 1], xi[i, 2] = log_scalars(T[i, 0], T[i, 1], T[i, 2])


@kernel
def _compose_batch(T_ab: NDArray[np.float64], T_bc: NDArray[np.float64], T_ac: NDArray[np.float64]) -> None:
    for i in range(T_ab.shape[0]):
        T_ac[i, 0], T_ac[i, 1], T_ac[i, 2] = compose_scalars(
            T_ab[i, 0], T_ab[i, 1], T_ab[i, 2], T_bc[i, 0], T_bc[i, 1], T_bc[i, 2]
        )


@kernel
def _inverse_batch(T_ab: NDArray[np.float64], T_ba: NDArray[np.float64]) -> None:
    for i in range(T_ab.shape[0]):
        T_ba[i, 0], T_ba[i, 1], T_ba[i, 2] = between_scalars(T_ab[i, 0], T_ab[i, 1], T_ab[i, 2], 0.0, 0.0, 0.0)


@kernel
def _act_batch(T_ab: NDArray[np.float64], p_b: NDArray[np.float64], p_a: NDArray[np.float64]) -> None:
    for i in range(T_ab.shape[0]):
        _, p_a[i, 0], p_a[i, 1] = compose_scalars(T_ab[i, 0], T_ab[i, 1], T_ab[i, 2], 0.0, p_b[i, 0], p_b[i, 1])


@kernel
def _boxplus_batch(x: NDArray[np.float64], delta: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    for i in range(x.shape[0]):
        theta, a, b = exp_scalars(delta[i, 0], delta[i, 1], delta[i, 2])
        out[i, 0], out[i, 1], out[i, 2] = compose_scalars(x[i, 0], x[i, 1], x[i, 2], theta, a, b)


@kernel
def _boxminus_batch(x: NDArray[np.float64], base: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    for i in range(x.shape[0]):
        theta, a, b = between_scalars(base[i, 0], base[i, 1], base[i, 2], x[i, 0], x[i, 1], x[i, 2])
        out[i, 0], out[i, 1], out[i, 2] = log_scalars(theta, a, b)


@kernel
def _right_jacobian_batch(xi: NDArray[np.float64], J: NDArray[np.float64]) -> None:
    for i in range(xi.shape[0]):
        right_jacobian_into(xi[i, 0], xi[i, 1], xi[i, 2], J[i])


@kernel
def _right_jacobian_inverse_batch(xi: NDArray[np.float64], J: NDArray[np.float64]) -> None:
    for i in range(xi.shape[0]):
        right_jacobian_inverse_into(xi[i, 0], xi[i, 1], xi[i, 2], J[i])


def exp(xi: ArrayLike) -> NDArray[np.float64]:
    """Poses [theta, x, y] (..., 3) of tangents ξ = [w, vx, vy] (..., 3) [rad, m]."""
    return map_batch(_exp_batch, "xi", xi, (3,), (3,))


def log(T: ArrayLike) -> NDArray[np.float64]:
    """Tangents ξ = [w, vx, vy] (..., 3) of poses [theta, x, y] (..., 3); w in [−π, π]."""
    return map_batch(_log_batch, "T", T, (3,), (3,))


def compose(T_ab: ArrayLike, T_bc: ArrayLike) -> NDArray[np.float64]:
    """T_ac = T_ab T_bc, (..., 3)."""
    return map_pairs(_compose_batch, "T_ab", T_ab, 3, "T_bc", T_bc, 3, 3)


def inverse(T_ab: ArrayLike) -> NDArray[np.float64]:
    """T_ba = T_ab⁻¹, (..., 3)."""
    return map_batch(_inverse_batch, "T_ab", T_ab, (3,), (3,))


def act(T_ab: ArrayLike, p_b: ArrayLike) -> NDArray[np.float64]:
    """Points p_a = T_ab p_b, (..., 2)."""
    return map_pairs(_act_batch, "T_ab", T_ab, 3, "p_b", p_b, 2, 2)


def adjoint(T: ArrayLike) -> NDArray[np.float64]:
    """Ad_T (..., 3, 3) in the order [w, vx, vy]: T Exp(ξ) T⁻¹ = Exp(Ad_T ξ)."""
    theta, x, y = np.moveaxis(np.asarray(T, dtype=np.float64), -1, 0)
    c, s, one, zero = np.cos(theta), np.sin(theta), np.ones_like(theta), np.zeros_like(theta)
    rows = [[one, zero, zero], [y, c, -s], [-x, s, c]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def right_jacobian(xi: ArrayLike) -> NDArray[np.float64]:
    """J_r (..., 3, 3) at ξ = [w, vx, vy] (..., 3): Exp(ξ + d) ≈ Exp(ξ) Exp(J_r(ξ) d)."""
    return map_batch(_right_jacobian_batch, "xi", xi, (3,), (3, 3))


def left_jacobian(xi: ArrayLike) -> NDArray[np.float64]:
    """J_l (..., 3, 3) at ξ = [w, vx, vy] (..., 3): Exp(ξ + d) ≈ Exp(J_l(ξ) d) Exp(ξ); J_l(ξ) = J_r(−ξ)."""
    return right_jacobian(-np.asarray(xi, dtype=np.float64))


def right_jacobian_inverse(xi: ArrayLike) -> NDArray[np.float64]:
    """J_r⁻¹ (..., 3, 3) at ξ = [w, vx, vy] (..., 3): Log(Exp(ξ) Exp(d)) ≈ ξ + J_r⁻¹(ξ) d."""
    return map_batch(_right_jacobian_inverse_batch, "xi", xi, (3,), (3, 3))


def left_jacobian_inverse(xi: ArrayLike) -> NDArray[np.float64]:
    """J_l⁻¹ (..., 3, 3) at ξ = [w, vx, vy] (..., 3): Log(Exp(d) Exp(ξ)) ≈ ξ + J_l⁻¹(ξ) d."""
    return right_jacobian_inverse(-np.asarray(xi, dtype=np.float64))


@dataclass(frozen=True, repr=False)
class _SE2(KernelManifold):
    """Poses [theta, x, y] (3,) moved by [w, vx, vy] (3,) on the right: T Exp(ξ).

    Example:
        >>> bp.SE2.boxplus([np.pi / 2, 1.0, 0.0], [0.0, 2.0, 0.0]).round(3)  # theta, x, y: two metres ahead
        array([1.571, 1.   , 2.   ])
    """

    name = "SE2"
    size = 3
    dof = 3
    tangent_names = ("rotation [rad]", "translation x [m]", "translation y [m]")

    def boxplus_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        _boxplus_batch(x, delta, out)

    def boxminus_into(self, x: NDArray[np.float64], base: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        _boxminus_batch(x, base, out)

    def boxplus_jacobian_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        _right_jacobian_batch(delta, J)

    def boxminus_jacobian_into(self, x: NDArray[np.float64], base: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        difference = np.empty((len(x), 3))
        _boxminus_batch(x, base, difference)
        _right_jacobian_inverse_batch(difference, J)

    def check(self, name: str, x: ArrayLike) -> NDArray[np.float64]:
        rows = super().check(name, x)
        around = np.abs(rows[:, 0]) > np.pi
        if around.any():
            rows[around, 0] = np.arctan2(np.sin(rows[around, 0]), np.cos(rows[around, 0]))
        return rows

    def identity(self) -> NDArray[np.float64]:
        return np.zeros(3)

    def random(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        return np.column_stack([rng.uniform(-np.pi, np.pi, count), rng.normal(size=(count, 2))])


SE2: Manifold = _SE2()
