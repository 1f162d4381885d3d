"""Jacobians of SE(3) in tangents [w, v] (docs/manifolds.md).

A pose is a rotation over dual numbers: ad(w, v) = [[W, 0], [V, W]] multiplies as W + εV does. So the lower left block of
J_l(w, v) is the derivative of J_l(w) along v, and that of J_l⁻¹(w, v) the derivative of J_l⁻¹(w): the same numbers as
the block Q of the literature and −J_l⁻¹ Q J_l⁻¹, without their products of 3×3 matrices.
Derivatives of B, C, D are with respect to θ².
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.manifolds._batch import map_batch
from boxplus.manifolds.so3 import SERIES_SWITCH, exp_coefficients

D_SERIES_SWITCH_SQ = 0.25  # θ² [rad²] below which D and its derivative come from their series


@kernel(inline=True)
def jacobian_coefficients(angle_sq: float) -> tuple[float, float, float, float]:
    """B, C of docs/manifolds.md and their derivatives with respect to θ²."""
    a, b, c = exp_coefficients(angle_sq)
    t = angle_sq
    if t < SERIES_SWITCH:
        # Σ (−1)ᵏ k tᵏ⁻¹/(2k+2)! and Σ (−1)ᵏ k tᵏ⁻¹/(2k+3)!
        b_high = -6.0 / 87178291200.0 + t * 7.0 / 20922789888000.0
        b_t = -1.0 / 24.0 + t * (
            2.0 / 720.0 + t * (-3.0 / 40320.0 + t * (4.0 / 3628800.0 + t * (-5.0 / 479001600.0 - t * b_high)))
        )
        c_high = -6.0 / 1307674368000.0 + t * 7.0 / 355687428096000.0
        c_t = -1.0 / 120.0 + t * (
            2.0 / 5040.0 + t * (-3.0 / 362880.0 + t * (4.0 / 39916800.0 + t * (-5.0 / 6227020800.0 - t * c_high)))
        )
        return b, c, b_t, c_t
    return b, c, (0.5 * a - b) / t, (0.5 * b - 1.5 * c) / t


@kernel(inline=True)
def inverse_jacobian_coefficients(angle_sq: float) -> tuple[float, float]:
    """D of docs/manifolds.md and its derivative with respect to θ²; regular at π."""
    t = angle_sq
    if t < D_SERIES_SWITCH_SQ:
        d_high = 1.0 / 47900160.0 + t * (691.0 / 1307674368000.0 + t / 74724249600.0)
        d = 1.0 / 12.0 + t * (1.0 / 720.0 + t * (1.0 / 30240.0 + t * (1.0 / 1209600.0 + t * d_high)))
        high = 4.0 / 47900160.0 + t * (3455.0 / 1307674368000.0 + t * (6.0 / 74724249600.0))
        return d, 1.0 / 720.0 + t * (2.0 / 30240.0 + t * (3.0 / 1209600.0 + t * high))
    half = 0.5 * math.sqrt(t)
    sine = math.sin(half)
    cot = math.cos(half) / sine
    d = (1.0 - half * cot) / t
    return d, (0.125 / (sine * sine) - 0.125 * cot / half - d) / t


@kernel(inline=True)
def dual_blocks_into(
    wx: float,
    wy: float,
    wz: float,
    vx: float,
    vy: float,
    vz: float,
    a: float,
    b: float,
    a_t: float,
    b_t: float,
    J: NDArray[np.float64],
) -> None:
    """J (6, 6) = [[F, 0], [dF, F]] of F = I + a W + b W², where a_t and b_t are the derivatives of a and b by θ²."""
    wv2 = 2.0 * (wx * vx + wy * vy + wz * vz)
    xx, yy, zz = wx * wx, wy * wy, wz * wz
    # F, twice on the diagonal.
    f00, f11, f22 = 1.0 - b * (yy + zz), 1.0 - b * (xx + zz), 1.0 - b * (xx + yy)
    sxy, sxz, syz = b * wx * wy, b * wx * wz, b * wy * wz
    ax, ay, az = a * wx, a * wy, a * wz
    J[0, 0], J[0, 1], J[0, 2] = f00, sxy - az, sxz + ay
    J[1, 0], J[1, 1], J[1, 2] = sxy + az, f11, syz - ax
    J[2, 0], J[2, 1], J[2, 2] = sxz - ay, syz + ax, f22
    J[3, 3], J[3, 4], J[3, 5] = f00, sxy - az, sxz + ay
    J[4, 3], J[4, 4], J[4, 5] = sxy + az, f11, syz - ax
    J[5, 3], J[5, 4], J[5, 5] = sxz - ay, syz + ax, f22
    # dF = a V + b (VW + WV) + 2 (w·v) (a_t W + b_t W²), with VW + WV = v wᵀ + w vᵀ − 2 (w·v) I.
    g = wv2 * b_t
    diagonal = -wv2 * b - g * (xx + yy + zz)
    sxy = b * (vx * wy + wx * vy) + g * wx * wy
    sxz = b * (vx * wz + wx * vz) + g * wx * wz
    syz = b * (vy * wz + wy * vz) + g * wy * wz
    ax, ay, az = a * vx + wv2 * a_t * wx, a * vy + wv2 * a_t * wy, a * vz + wv2 * a_t * wz
    J[3, 0], J[3, 1], J[3, 2] = diagonal + 2.0 * b * wx * vx + g * xx, sxy - az, sxz + ay
    J[4, 0], J[4, 1], J[4, 2] = sxy + az, diagonal + 2.0 * b * wy * vy + g * yy, syz - ax
    J[5, 0], J[5, 1], J[5, 2] = sxz - ay, syz + ax, diagonal + 2.0 * b * wz * vz + g * zz
    J[0, 3], J[0, 4], J[0, 5] = 0.0, 0.0, 0.0
    J[1, 3], J[1, 4], J[1, 5] = 0.0, 0.0, 0.0
    J[2, 3], J[2, 4], J[2, 5] = 0.0, 0.0, 0.0


@kernel(inline=True)
def left_jacobian_into(wx: float, wy: float, wz: float, vx: float, vy: float, vz: float, J: NDArray[np.float64]) -> None:
    """J = J_l(ξ), (6, 6): Exp(ξ + d) = Exp(J_l(ξ) d) Exp(ξ)."""
    b, c, b_t, c_t = jacobian_coefficients(wx * wx + wy * wy + wz * wz)
    dual_blocks_into(wx, wy, wz, vx, vy, vz, b, c, b_t, c_t, J)


@kernel(inline=True)
def right_jacobian_into(wx: float, wy: float, wz: float, vx: float, vy: float, vz: float, J: NDArray[np.float64]) -> None:
    """J = J_r(ξ) = J_l(−ξ), (6, 6): Exp(ξ + d) = Exp(ξ) Exp(J_r(ξ) d)."""
    b, c, b_t, c_t = jacobian_coefficients(wx * wx + wy * wy + wz * wz)
    dual_blocks_into(wx, wy, wz, vx, vy, vz, -b, c, -b_t, c_t, J)


@kernel(inline=True)
def left_jacobian_inverse_into(wx: float, wy: float, wz: float, vx: float, vy: float, vz: float, J: NDArray[np.float64]) -> None:
    """J = J_l(ξ)⁻¹, (6, 6): Log(Exp(d) Exp(ξ)) = ξ + J_l⁻¹(ξ) d."""
    d, d_t = inverse_jacobian_coefficients(wx * wx + wy * wy + wz * wz)
    dual_blocks_into(wx, wy, wz, vx, vy, vz, -0.5, d, 0.0, d_t, J)


@kernel(inline=True)
def right_jacobian_inverse_into(wx: float, wy: float, wz: float, vx: float, vy: float, vz: float, J: NDArray[np.float64]) -> None:
    """J = J_r(ξ)⁻¹, (6, 6): Log(Exp(ξ) Exp(d)) = ξ + J_r⁻¹(ξ) d."""
    d, d_t = inverse_jacobian_coefficients(wx * wx + wy * wy + wz * wz)
    dual_blocks_into(wx, wy, wz, vx, vy, vz, 0.5, d, 0.0, d_t, J)


@kernel
def _left_jacobian_batch(xi: NDArray[np.float64], J: NDArray[np.float64]) -> None:
    for i in range(xi.shape[0]):
        left_jacobian_into(xi[i, 0], xi[i, 1], xi[i, 2], xi[i, 3], xi[i, 4], xi[i, 5], J[i])


@kernel
def _right_jacobian_batch(xi: NDArray[np.float64], J: NDArray[np.float64]) -> None:
    for i in range(xi.shape[0]):
        right_jacobian_into(xi[i, 0], xi[i, 1], xi[i, 2], xi[i, 3], xi[i, 4], xi[i, 5], J[i])


@kernel
def _left_jacobian_inverse_batch(xi: NDArray[np.float64], J: NDArray[np.float64]) -> None:
    for i in range(xi.shape[0]):
        left_jacobian_inverse_into(xi[i, 0], xi[i, 1], xi[i, 2], xi[i, 3], xi[i, 4], xi[i, 5], J[i])


@kernel
def _right_jacobian_inverse_batch(xi: NDArray[np.float64], J: NDArray[np.float64]) -> None:
    for i in range(xi.shape[0]):
        right_jacobian_inverse_into(xi[i, 0], xi[i, 1], xi[i, 2], xi[i, 3], xi[i, 4], xi[i, 5], J[i])


def left_jacobian(xi: ArrayLike) -> NDArray[np.float64]:
    """J_l (..., 6, 6) at ξ = [w, v] (..., 6): Exp(ξ + d) ≈ Exp(J_l(ξ) d) Exp(ξ)."""
    return map_batch(_left_jacobian_batch, "xi", xi, (6,), (6, 6))


def right_jacobian(xi: ArrayLike) -> NDArray[np.float64]:
    """J_r (..., 6, 6) at ξ = [w, v] (..., 6): Exp(ξ + d) ≈ Exp(ξ) Exp(J_r(ξ) d)."""
    return map_batch(_right_jacobian_batch, "xi", xi, (6,), (6, 6))


def left_jacobian_inverse(xi: ArrayLike) -> NDArray[np.float64]:
    """J_l⁻¹ (..., 6, 6) at ξ = [w, v] (..., 6): Log(Exp(d) Exp(ξ)) ≈ ξ + J_l⁻¹(ξ) d."""
    return map_batch(_left_jacobian_inverse_batch, "xi", xi, (6,), (6, 6))


def right_jacobian_inverse(xi: ArrayLike) -> NDArray[np.float64]:
    """J_r⁻¹ (..., 6, 6) at ξ = [w, v] (..., 6): Log(Exp(ξ) Exp(d)) ≈ ξ + J_r⁻¹(ξ) d."""
    return map_batch(_right_jacobian_inverse_batch, "xi", xi, (6,), (6, 6))
