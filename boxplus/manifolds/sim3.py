"""Similarities Sim(3): rotation, translation and scale, as monocular maps need them to be joined (Strasdat, RSS 2010).

`S_ab` maps coordinates in b to coordinates in a, p_a = s R p_b + t, stored as [qw, qx, qy, qz, x, y, z, s]: a pose (7,) and its
scale. Tangents are ξ = [w, v, λ] with the 4×4 matrix [[[w]x + λ I, v], [0, 0]], so that

    Exp(ξ) = (Exp(w), W v, e^λ),    W = ∫₀¹ e^{λτ} Exp(w τ) dτ = A I + B [w]x + C [w]x²

The three integrals have positive integrands and are summed by Gauss and Legendre's rule, good to rounding for every angle up to π
and every scale, without the differences of nearly equal numbers of the closed forms (Eade, Lie groups for 2D and 3D
transformations, 2017). With A₀ = A − C θ², W⁻¹ = I/A − B/det [w]x + (B² − C A₀)/(A det) [w]x², det = A₀² + B² θ².

    Ad_S = [[R, 0, 0], [[t]x R, s R, −t], [0, 0, 1]],    ad(ξ) = [[[w]x, 0, 0], [[v]x, [w]x + λ I, −v], [0, 0, 0]]

J_r(ξ) = Σ (−ad ξ)ᵏ/(k + 1)!, from the series at ξ/2ᵐ and φ(2A) = ½ φ(A) (I + e^A).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.manifolds._batch import map_batch, map_pairs
from boxplus.manifolds._kernel_manifold import KernelManifold, normalize_quaternions
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.quaternion import exp_scalars, multiply_scalars, normalized_scalars, rotate
from boxplus.manifolds.so3 import log_quaternion

_PANEL = 6.0  # |λ| that one panel of the rule covers: its error is below 1e-17 there, with angles up to π
_NODES, _WEIGHTS = (np.ascontiguousarray(part) for part in np.polynomial.legendre.leggauss(12))
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS
_SMALL = 0.5  # norm of −ad(ξ)/2ᵐ at which the series is taken: its terms stop at 0.5¹⁴/15! < 1e-16


@kernel
def integrals(angle: float, growth: float) -> tuple[float, float, float]:
    """A, B, C of W at the angle θ and the logarithm of the scale λ."""
    panels = max(1, math.ceil(abs(growth) / _PANEL))
    a, b, c = 0.0, 0.0, 0.0
    for panel in range(panels):
        for k in range(12):
            tau = (panel + _NODES[k]) / panels
            f = _WEIGHTS[k] / panels * math.exp(growth * tau)
            x, half = angle * tau, 0.5 * angle * tau
            sinc = 1.0 - x * x / 6.0 if x < 1e-4 else math.sin(x) / x
            sinc_half = 1.0 - half * half / 6.0 if half < 1e-4 else math.sin(half) / half
            a += f
            b += f * tau * sinc
            c += f * 0.5 * tau * tau * sinc_half * sinc_half
    return a, b, c


@kernel(inline=True)
def _quadratic_times(
    wx: float, wy: float, wz: float, a: float, b: float, c: float, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """(a I + b [w]x + c [w]x²) (x, y, z)."""
    ux, uy, uz = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
    return (
        a * x + b * ux + c * (wy * uz - wz * uy),
        a * y + b * uy + c * (wz * ux - wx * uz),
        a * z + b * uz + c * (wx * uy - wy * ux),
    )


@kernel
def exp_into(xi: NDArray[np.float64], S: NDArray[np.float64]) -> None:
    """S = Exp(ξ), (8,), of ξ (7,)."""
    wx, wy, wz = xi[0], xi[1], xi[2]
    a, b, c = integrals(math.sqrt(wx * wx + wy * wy + wz * wz), xi[6])
    x, y, z = _quadratic_times(wx, wy, wz, a, b, c, xi[3], xi[4], xi[5])
    S[0], S[1], S[2], S[3] = exp_scalars(wx, wy, wz)
    S[4], S[5], S[6], S[7] = x, y, z, math.exp(xi[6])


@kernel
def log_into(S: NDArray[np.float64], xi: NDArray[np.float64]) -> None:
    """ξ = Log(S), (7,), of S (8,); the angle is in [0, π]."""
    wx, wy, wz = log_quaternion(S[0], S[1], S[2], S[3])
    growth, angle_sq = math.log(S[7]), wx * wx + wy * wy + wz * wz
    a, b, c = integrals(math.sqrt(angle_sq), growth)
    a0 = a - c * angle_sq
    det = a0 * a0 + b * b * angle_sq
    x, y, z = _quadratic_times(wx, wy, wz, 1.0 / a, -b / det, (b * b - c * a0) / (a * det), S[4], S[5], S[6])
    xi[0], xi[1], xi[2], xi[3], xi[4], xi[5], xi[6] = wx, wy, wz, x, y, z, growth


@kernel
def compose_into(S_ab: NDArray[np.float64], S_bc: NDArray[np.float64], S_ac: NDArray[np.float64]) -> None:
    """S_ac = S_ab S_bc, all (8,), its quaternion normalised."""
    x, y, z = rotate(S_ab[0], S_ab[1], S_ab[2], S_ab[3], S_bc[4], S_bc[5], S_bc[6])
    x, y, z = S_ab[7] * x + S_ab[4], S_ab[7] * y + S_ab[5], S_ab[7] * z + S_ab[6]
    qw, qx, qy, qz = multiply_scalars(S_ab[0], S_ab[1], S_ab[2], S_ab[3], S_bc[0], S_bc[1], S_bc[2], S_bc[3])
    S_ac[0], S_ac[1], S_ac[2], S_ac[3] = normalized_scalars(qw, qx, qy, qz)
    S_ac[4], S_ac[5], S_ac[6], S_ac[7] = x, y, z, S_ab[7] * S_bc[7]


@kernel
def inverse_into(S_ab: NDArray[np.float64], S_ba: NDArray[np.float64]) -> None:
    """S_ba = S_ab⁻¹, both (8,)."""
    qw, qx, qy, qz, s = S_ab[0], -S_ab[1], -S_ab[2], -S_ab[3], 1.0 / S_ab[7]
    x, y, z = rotate(qw, qx, qy, qz, S_ab[4], S_ab[5], S_ab[6])
    S_ba[0], S_ba[1], S_ba[2], S_ba[3] = qw, qx, qy, qz
    S_ba[4], S_ba[5], S_ba[6], S_ba[7] = -s * x, -s * y, -s * z, s


@kernel
def right_jacobian_into(xi: NDArray[np.float64], J: NDArray[np.float64]) -> None:
    """J = J_r(ξ), (7, 7): Exp(ξ + d) = Exp(ξ) Exp(J_r(ξ) d)."""
    A, E, product = np.zeros((7, 7)), np.zeros((7, 7)), np.zeros((7, 7))
    for block in range(2):
        _add_hat(3 * block, 0, -xi[3 * block], -xi[3 * block + 1], -xi[3 * block + 2], A)
    _add_hat(3, 3, -xi[0], -xi[1], -xi[2], A)
    size = 0.0
    for i in range(3):
        A[3 + i, 3 + i], A[3 + i, 6] = -xi[6], xi[3 + i]
    for i in range(7):
        row = 0.0
        for j in range(7):
            row += abs(A[i, j])
        size = max(size, row)
    halvings = max(0, math.ceil(math.log2(size / _SMALL))) if size > 0.0 else 0
    A *= 0.5**halvings
    J[:] = 0.0
    for k in range(14, 0, -1):  # φ(A) = I + A/2 (I + A/3 (I + …)), Horner's way
        for i in range(7):
            J[i, i] += 1.0
        _product(A, J, product)
        for i in range(7):
            for j in range(7):
                J[i, j] = product[i, j] / (k + 1.0)
    for i in range(7):
        J[i, i] += 1.0
    _product(A, J, E)
    for i in range(7):
        E[i, i] += 1.0  # e^A = I + A φ(A)
    for _ in range(halvings):
        _product(J, E, product)
        for i in range(7):
            for j in range(7):
                J[i, j] = 0.5 * (J[i, j] + product[i, j])
        _product(E, E, product)
        E, product = product, E


@kernel(inline=True)
def _add_hat(row: int, column: int, x: float, y: float, z: float, M: NDArray[np.float64]) -> None:
    """M[row:, column:] = [(x, y, z)]x."""
    M[row, column + 1], M[row, column + 2], M[row + 1, column + 2] = -z, y, -x
    M[row + 1, column], M[row + 2, column], M[row + 2, column + 1] = z, -y, x


@kernel(inline=True)
def _product(A: NDArray[np.float64], B: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    for i in range(7):
        for j in range(7):
            out[i, j] = 0.0
        for k in range(7):
            for j in range(7):
                out[i, j] += A[i, k] * B[k, j]


@kernel
def _exp_batch(xi: NDArray[np.float64], S: NDArray[np.float64]) -> None:
    for n in range(len(xi)):
        exp_into(xi[n], S[n])


@kernel
def _log_batch(S: NDArray[np.float64], xi: NDArray[np.float64]) -> None:
    for n in range(len(S)):
        log_into(S[n], xi[n])


@kernel
def _compose_batch(S_ab: NDArray[np.float64], S_bc: NDArray[np.float64], S_ac: NDArray[np.float64]) -> None:
    for n in range(len(S_ab)):
        compose_into(S_ab[n], S_bc[n], S_ac[n])


@kernel
def _inverse_batch(S_ab: NDArray[np.float64], S_ba: NDArray[np.float64]) -> None:
    for n in range(len(S_ab)):
        inverse_into(S_ab[n], S_ba[n])


@kernel
def _act_batch(S_ab: NDArray[np.float64], p_b: NDArray[np.float64], p_a: NDArray[np.float64]) -> None:
    for n in range(len(S_ab)):
        x, y, z = rotate(S_ab[n, 0], S_ab[n, 1], S_ab[n, 2], S_ab[n, 3], p_b[n, 0], p_b[n, 1], p_b[n, 2])
        s = S_ab[n, 7]
        p_a[n, 0], p_a[n, 1], p_a[n, 2] = s * x + S_ab[n, 4], s * y + S_ab[n, 5], s * z + S_ab[n, 6]


@kernel
def _boxplus_batch(x: NDArray[np.float64], delta: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    step = np.empty(8)
    for n in range(len(x)):
        exp_into(delta[n], step)
        compose_into(x[n], step, out[n])


@kernel
def _boxminus_batch(x: NDArray[np.float64], base: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    difference = np.empty(8)
    for n in range(len(x)):
        inverse_into(base[n], difference)
        compose_into(difference, x[n], difference)
        log_into(difference, out[n])


@kernel
def _right_jacobian_batch(xi: NDArray[np.float64], J: NDArray[np.float64]) -> None:
    for n in range(len(xi)):
        right_jacobian_into(xi[n], J[n])


def exp(xi: ArrayLike) -> NDArray[np.float64]:
    """Similarities (..., 8) of tangents ξ = [w, v, λ] (..., 7) [rad, m, 1]."""
    return map_batch(_exp_batch, "xi", xi, (7,), (8,))


def log(S: ArrayLike) -> NDArray[np.float64]:
    """Tangents ξ = [w, v, λ] (..., 7) of similarities (..., 8); the angle is in [0, π]."""
    return map_batch(_log_batch, "S", S, (8,), (7,))


def compose(S_ab: ArrayLike, S_bc: ArrayLike) -> NDArray[np.float64]:
    """S_ac = S_ab S_bc, (..., 8)."""
    return map_pairs(_compose_batch, "S_ab", S_ab, 8, "S_bc", S_bc, 8, 8)


def inverse(S_ab: ArrayLike) -> NDArray[np.float64]:
    """S_ba = S_ab⁻¹, (..., 8)."""
    return map_batch(_inverse_batch, "S_ab", S_ab, (8,), (8,))


def act(S_ab: ArrayLike, p_b: ArrayLike) -> NDArray[np.float64]:
    """Points p_a = s R p_b + t, (..., 3)."""
    return map_pairs(_act_batch, "S_ab", S_ab, 8, "p_b", p_b, 3, 3)


def right_jacobian(xi: ArrayLike) -> NDArray[np.float64]:
    """J_r(ξ) (..., 7, 7): Exp(ξ + d) = Exp(ξ) Exp(J_r(ξ) d)."""
    return map_batch(_right_jacobian_batch, "xi", xi, (7,), (7, 7))


@dataclass(frozen=True, repr=False)
class _Sim3(KernelManifold):
    """Similarities (8,) moved by [w, v, λ] (7,): S Exp(ξ).

    Example:
        >>> S = bp.Sim3.boxplus(bp.Sim3.identity(), [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.log(2.0)])  # a map twice as large
        >>> float(S[7].round(12))
        2.0
    """

    name = "Sim3"
    size = 8
    dof = 7
    tangent_names = (
        "rotation x [rad]",
        "rotation y [rad]",
        "rotation z [rad]",
        "translation x [m]",
        "translation y [m]",
        "translation z [m]",
        "logarithm of the scale [1]",
    )

    def boxplus_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        _boxplus_batch(x, delta, out)

    def boxminus_into(self, x: NDArray[np.float64], base: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        _boxminus_batch(x, base, out)

    def boxplus_jacobian_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        _right_jacobian_batch(delta, J)

    def boxminus_jacobian_into(self, x: NDArray[np.float64], base: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        difference = np.empty((len(x), 7))
        _boxminus_batch(x, base, difference)
        _right_jacobian_batch(difference, J)
        J[:] = np.linalg.inv(J)

    def check(self, name: str, x: ArrayLike) -> NDArray[np.float64]:
        rows = super().check(name, x)
        normalize_quaternions(name, rows)
        if not (rows[:, 7] > 0.0).all():
            row = int(np.argmin(rows[:, 7]))
            raise InputError(
                f"{name} of positive scale, in the last of the 8 numbers",
                f"{rows[row, 7]:.4g} in row {row}",
                "a mirrored or vanishing map is no similarity",
            )
        return rows

    def identity(self) -> NDArray[np.float64]:
        return np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])

    def random(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        S = rng.normal(size=(count, 8))
        S[:, :4] /= np.linalg.norm(S[:, :4], axis=1, keepdims=True)
        S[:, 7] = np.exp(S[:, 7])
        return S


Sim3: Manifold = _Sim3()
