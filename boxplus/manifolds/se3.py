"""Rigid motions SE(3), stored [qw, qx, qy, qz, x, y, z] (docs/manifolds.md). T_ab maps coordinates in b to coordinates in a.

Tangents are ξ = [w, v], rotation first [rad, m]. Kernels take rows (7,) and write into arrays of their caller, which may be
their inputs; the functions below them are batch-first. `SE3` moves a pose on the right (local), `SE3Left` on the left (global).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.manifolds._batch import as_batch, map_batch, map_pairs
from boxplus.manifolds._kernel_manifold import KernelManifold, normalize_quaternions
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.quaternion import half_angle, multiply_scalars, normalized_scalars, rotate, rotation_entries
from boxplus.manifolds.se3_jacobians import (
    inverse_jacobian_coefficients,
    left_jacobian,
    left_jacobian_into,
    left_jacobian_inverse,
    left_jacobian_inverse_into,
    right_jacobian,
    right_jacobian_into,
    right_jacobian_inverse,
    right_jacobian_inverse_into,
)
from boxplus.manifolds.so3 import SERIES_SWITCH, exp_coefficients, hat, log_quaternion

__all__ = [
    "SE3",
    "SE3Left",
    "act",
    "ad",
    "adjoint",
    "adjoint_into",
    "between_into",
    "between_scalars",
    "compose",
    "compose_into",
    "exp",
    "exp_into",
    "inverse",
    "inverse_into",
    "left_jacobian",
    "left_jacobian_into",
    "left_jacobian_inverse",
    "left_jacobian_inverse_into",
    "log",
    "log_into",
    "log_scalars",
    "right_jacobian",
    "right_jacobian_into",
    "right_jacobian_inverse",
    "right_jacobian_inverse_into",
]


@kernel(inline=True)
def exp_into(wx: float, wy: float, wz: float, vx: float, vy: float, vz: float, T: NDArray[np.float64]) -> None:
    """T = Exp(w, v), (7,): rotation Exp(w), translation J_l(w) v."""
    t = wx * wx + wy * wy + wz * wz
    cos_half, s = half_angle(t)
    if t < SERIES_SWITCH:
        _, b, c = exp_coefficients(t)
    else:  # B and C by sin θ = 2 sin(θ/2) cos(θ/2), which are there already
        b, c = 2.0 * s * s, (1.0 - 2.0 * s * cos_half) / t
    T[0], T[1], T[2], T[3] = cos_half, s * wx, s * wy, s * wz
    # J_l v = v + b w × v + c w × (w × v)
    ux, uy, uz = wy * vz - wz * vy, wz * vx - wx * vz, wx * vy - wy * vx
    T[4] = vx + b * ux + c * (wy * uz - wz * uy)
    T[5] = vy + b * uy + c * (wz * ux - wx * uz)
    T[6] = vz + b * uz + c * (wx * uy - wy * ux)


@kernel(inline=True)
def log_scalars(
    qw: float, qx: float, qy: float, qz: float, x: float, y: float, z: float
) -> tuple[float, float, float, float, float, float]:
    """ξ = [w, v] of the pose with unit quaternion (qw, qx, qy, qz) and translation (x, y, z): v = J_l⁻¹(w) t."""
    wx, wy, wz = log_quaternion(qw, qx, qy, qz)
    d, _ = inverse_jacobian_coefficients(wx * wx + wy * wy + wz * wz)
    ux, uy, uz = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
    return (
        wx,
        wy,
        wz,
        x - 0.5 * ux + d * (wy * uz - wz * uy),
        y - 0.5 * uy + d * (wz * ux - wx * uz),
        z - 0.5 * uz + d * (wx * uy - wy * ux),
    )


@kernel(inline=True)
def log_into(T: NDArray[np.float64], xi: NDArray[np.float64]) -> None:
    """ξ = Log(T), (6,), of a pose (7,)."""
    xi[0], xi[1], xi[2], xi[3], xi[4], xi[5] = log_scalars(T[0], T[1], T[2], T[3], T[4], T[5], T[6])


@kernel(inline=True)
def compose_into(T_ab: NDArray[np.float64], T_bc: NDArray[np.float64], T_ac: NDArray[np.float64]) -> None:
    """T_ac = T_ab T_bc, all (7,), its quaternion normalised."""
    x, y, z = rotate(T_ab[0], T_ab[1], T_ab[2], T_ab[3], T_bc[4], T_bc[5], T_bc[6])
    x, y, z = x + T_ab[4], y + T_ab[5], z + T_ab[6]
    qw, qx, qy, qz = multiply_scalars(T_ab[0], T_ab[1], T_ab[2], T_ab[3], T_bc[0], T_bc[1], T_bc[2], T_bc[3])
    T_ac[0], T_ac[1], T_ac[2], T_ac[3] = normalized_scalars(qw, qx, qy, qz)
    T_ac[4], T_ac[5], T_ac[6] = x, y, z


@kernel(inline=True)
def inverse_into(T_ab: NDArray[np.float64], T_ba: NDArray[np.float64]) -> None:
    """T_ba = T_ab⁻¹, both (7,)."""
    qw, qx, qy, qz = T_ab[0], -T_ab[1], -T_ab[2], -T_ab[3]
    x, y, z = rotate(qw, qx, qy, qz, T_ab[4], T_ab[5], T_ab[6])
    T_ba[0], T_ba[1], T_ba[2], T_ba[3] = qw, qx, qy, qz
    T_ba[4], T_ba[5], T_ba[6] = -x, -y, -z


@kernel(inline=True)
def between_scalars(
    T_wa: NDArray[np.float64], T_wb: NDArray[np.float64]
) -> tuple[float, float, float, float, float, float, float]:
    """The seven numbers of T_ab = T_wa⁻¹ T_wb."""
    qw, qx, qy, qz = multiply_scalars(T_wa[0], -T_wa[1], -T_wa[2], -T_wa[3], T_wb[0], T_wb[1], T_wb[2], T_wb[3])
    x, y, z = rotate(T_wa[0], -T_wa[1], -T_wa[2], -T_wa[3], T_wb[4] - T_wa[4], T_wb[5] - T_wa[5], T_wb[6] - T_wa[6])
    return qw, qx, qy, qz, x, y, z


@kernel(inline=True)
def between_into(T_wa: NDArray[np.float64], T_wb: NDArray[np.float64], T_ab: NDArray[np.float64]) -> None:
    """T_ab = T_wa⁻¹ T_wb, all (7,), its quaternion normalised."""
    qw, qx, qy, qz, x, y, z = between_scalars(T_wa, T_wb)
    T_ab[0], T_ab[1], T_ab[2], T_ab[3] = normalized_scalars(qw, qx, qy, qz)
    T_ab[4], T_ab[5], T_ab[6] = x, y, z


@kernel(inline=True)
def adjoint_into(T: NDArray[np.float64], Ad: NDArray[np.float64]) -> None:
    """Ad = [[R, 0], [[t]x R, R]], (6, 6): T Exp(ξ) T⁻¹ = Exp(Ad ξ)."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_entries(T[0], T[1], T[2], T[3])
    x, y, z = T[4], T[5], T[6]
    Ad[0, 0], Ad[0, 1], Ad[0, 2], Ad[0, 3], Ad[0, 4], Ad[0, 5] = r00, r01, r02, 0.0, 0.0, 0.0
    Ad[1, 0], Ad[1, 1], Ad[1, 2], Ad[1, 3], Ad[1, 4], Ad[1, 5] = r10, r11, r12, 0.0, 0.0, 0.0
    Ad[2, 0], Ad[2, 1], Ad[2, 2], Ad[2, 3], Ad[2, 4], Ad[2, 5] = r20, r21, r22, 0.0, 0.0, 0.0
    Ad[3, 0], Ad[3, 1], Ad[3, 2] = y * r20 - z * r10, y * r21 - z * r11, y * r22 - z * r12
    Ad[4, 0], Ad[4, 1], Ad[4, 2] = z * r00 - x * r20, z * r01 - x * r21, z * r02 - x * r22
    Ad[5, 0], Ad[5, 1], Ad[5, 2] = x * r10 - y * r00, x * r11 - y * r01, x * r12 - y * r02
    Ad[3, 3], Ad[3, 4], Ad[3, 5] = r00, r01, r02
    Ad[4, 3], Ad[4, 4], Ad[4, 5] = r10, r11, r12
    Ad[5, 3], Ad[5, 4], Ad[5, 5] = r20, r21, r22


@kernel
def _exp_batch(xi: NDArray[np.float64], T: NDArray[np.float64]) -> None:
    for i in range(xi.shape[0]):
        exp_into(xi[i, 0], xi[i, 1], xi[i, 2], xi[i, 3], xi[i, 4], xi[i, 5], T[i])


@kernel
def _log_batch(T: NDArray[np.float64], xi: NDArray[np.float64]) -> None:
    for i in range(T.shape[0]):
        log_into(T[i], xi[i])


@kernel
def _compose_batch(T_ab: NDArray[np.float64], T_bc: NDArray[np.float64], T_ac: NDArray[np.float64]) -> None:
    for i in range(T_ab.shape[0]):
        compose_into(T_ab[i], T_bc[i], T_ac[i])


@kernel
def _inverse_batch(T_ab: NDArray[np.float64], T_ba: NDArray[np.float64]) -> None:
    for i in range(T_ab.shape[0]):
        inverse_into(T_ab[i], T_ba[i])


@kernel
def _act_batch(T_ab: NDArray[np.float64], p_b: NDArray[np.float64], p_a: NDArray[np.float64]) -> None:
    for i in range(T_ab.shape[0]):
        x, y, z = rotate(T_ab[i, 0], T_ab[i, 1], T_ab[i, 2], T_ab[i, 3], p_b[i, 0], p_b[i, 1], p_b[i, 2])
        p_a[i, 0], p_a[i, 1], p_a[i, 2] = x + T_ab[i, 4], y + T_ab[i, 5], z + T_ab[i, 6]


@kernel
def _adjoint_batch(T: NDArray[np.float64], Ad: NDArray[np.float64]) -> None:
    for i in range(T.shape[0]):
        adjoint_into(T[i], Ad[i])


@kernel
def _boxplus_batch(x: NDArray[np.float64], delta: NDArray[np.float64], is_left: bool, out: NDArray[np.float64]) -> None:
    step = np.empty(7)
    for i in range(x.shape[0]):
        exp_into(delta[i, 0], delta[i, 1], delta[i, 2], delta[i, 3], delta[i, 4], delta[i, 5], step)
        if is_left:
            compose_into(step, x[i], out[i])
        else:
            compose_into(x[i], step, out[i])


@kernel
def _boxminus_batch(x: NDArray[np.float64], base: NDArray[np.float64], is_left: bool, out: NDArray[np.float64]) -> None:
    difference, other = np.empty(7), np.empty(7)
    for i in range(x.shape[0]):
        if is_left:
            inverse_into(base[i], other)
            compose_into(x[i], other, difference)
        else:
            between_into(base[i], x[i], difference)
        log_into(difference, out[i])


@kernel
def _boxplus_jacobian_batch(delta: NDArray[np.float64], is_left: bool, J: NDArray[np.float64]) -> None:
    for i in range(delta.shape[0]):
        if is_left:
            left_jacobian_into(delta[i, 0], delta[i, 1], delta[i, 2], delta[i, 3], delta[i, 4], delta[i, 5], J[i])
        else:
            right_jacobian_into(delta[i, 0], delta[i, 1], delta[i, 2], delta[i, 3], delta[i, 4], delta[i, 5], J[i])


@kernel
def _boxminus_jacobian_batch(xi: NDArray[np.float64], is_left: bool, J: NDArray[np.float64]) -> None:
    for i in range(xi.shape[0]):
        if is_left:
            left_jacobian_inverse_into(xi[i, 0], xi[i, 1], xi[i, 2], xi[i, 3], xi[i, 4], xi[i, 5], J[i])
        else:
            right_jacobian_inverse_into(xi[i, 0], xi[i, 1], xi[i, 2], xi[i, 3], xi[i, 4], xi[i, 5], J[i])


def exp(xi: ArrayLike) -> NDArray[np.float64]:
    """Poses (..., 7) of tangents ξ = [w, v] (..., 6) [rad, m]."""
    return map_batch(_exp_batch, "xi", xi, (6,), (7,))


def log(T: ArrayLike) -> NDArray[np.float64]:
    """Tangents ξ = [w, v] (..., 6) of poses (..., 7); the angle is in [0, π]."""
    return map_batch(_log_batch, "T", T, (7,), (6,))


def compose(T_ab: ArrayLike, T_bc: ArrayLike) -> NDArray[np.float64]:
    """T_ac = T_ab T_bc, (..., 7)."""
    return map_pairs(_compose_batch, "T_ab", T_ab, 7, "T_bc", T_bc, 7, 7)


def inverse(T_ab: ArrayLike) -> NDArray[np.float64]:
    """T_ba = T_ab⁻¹, (..., 7)."""
    return map_batch(_inverse_batch, "T_ab", T_ab, (7,), (7,))


def act(T_ab: ArrayLike, p_b: ArrayLike) -> NDArray[np.float64]:
    """Points p_a = T_ab p_b, (..., 3)."""
    return map_pairs(_act_batch, "T_ab", T_ab, 7, "p_b", p_b, 3, 3)


def ad(xi: ArrayLike) -> NDArray[np.float64]:
    """ad(ξ) = [[[w]x, 0], [[v]x, [w]x]] (..., 6, 6) of ξ = [w, v] (..., 6): ad(a) b is the Lie bracket, Ad(Exp(ξ)) = exp(ad(ξ)).

    I + ½ ad(e) is J_r⁻¹(e) to first order (docs/manifolds.md; Barfoot, State Estimation for Robotics, 2017, section 7.1).

    Example:
        >>> ad([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]) @ [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]  # turning about z, moving along x
        array([0., 0., 0., 0., 1., 0.])
    """
    rows, lead = as_batch("xi", xi, (6,))
    A = np.zeros((len(rows), 6, 6))
    A[:, :3, :3] = A[:, 3:, 3:] = hat(rows[:, :3])
    A[:, 3:, :3] = hat(rows[:, 3:])
    return A.reshape((*lead, 6, 6))


def adjoint(T: ArrayLike) -> NDArray[np.float64]:
    """Ad_T (..., 6, 6) in the order [w, v]: T Exp(ξ) T⁻¹ = Exp(Ad_T ξ)."""
    return map_batch(_adjoint_batch, "T", T, (7,), (6, 6))


@dataclass(frozen=True, repr=False)
class _SE3(KernelManifold):
    """Poses (7,) moved by [w, v] (6,): T Exp(ξ), or Exp(ξ) T where `is_left`.

    Example:
        >>> T = bp.SE3.boxplus(bp.SE3.identity(), [0.0, 0.0, np.pi / 2, 1.0, 0.0, 0.0])  # turn and go at once, seen in the body
        >>> T.round(3)
        array([0.707, 0.   , 0.   , 0.707, 0.637, 0.637, 0.   ])
        >>> bp.SE3.boxminus(T, bp.SE3.identity()).round(3)
        array([0.   , 0.   , 1.571, 1.   , 0.   , 0.   ])
    """

    name: str
    is_left: bool

    size = 7
    dof = 6
    tangent_names = (
        "rotation x [rad]",
        "rotation y [rad]",
        "rotation z [rad]",
        "translation x [m]",
        "translation y [m]",
        "translation z [m]",
    )

    def boxplus_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        _boxplus_batch(x, delta, self.is_left, out)

    def boxminus_into(self, x: NDArray[np.float64], base: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        _boxminus_batch(x, base, self.is_left, out)

    def boxplus_jacobian_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        _boxplus_jacobian_batch(delta, self.is_left, J)

    def boxminus_jacobian_into(self, x: NDArray[np.float64], base: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        difference = np.empty((len(x), 6))
        _boxminus_batch(x, base, self.is_left, difference)
        _boxminus_jacobian_batch(difference, self.is_left, J)

    def check(self, name: str, x: ArrayLike) -> NDArray[np.float64]:
        rows = super().check(name, x)
        normalize_quaternions(name, rows)
        return rows

    def identity(self) -> NDArray[np.float64]:
        return np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])

    def random(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        T = rng.normal(size=(count, 7))
        T[:, :4] /= np.linalg.norm(T[:, :4], axis=1, keepdims=True)
        return T


SE3: Manifold = _SE3("SE3", False)
SE3Left: Manifold = _SE3("SE3Left", True)
