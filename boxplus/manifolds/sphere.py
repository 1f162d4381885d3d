"""Directions: the unit sphere S², such as the direction of gravity with its magnitude known.

A point is a unit vector x (3,), a tangent two numbers along the columns of an orthonormal basis B(x) (3, 2) of the plane
orthogonal to x. ⊞ walks along a great circle, with θ = ‖δ‖ and A = sin θ/θ:

    x ⊞ δ = cos θ x + A B(x) δ,    y ⊟ x = atan2(‖u‖, x·y) u/‖u‖  with u = B(x)ᵀ y

Jacobians, with y = x ⊞ δ:  ∂y/∂δ = −A x δᵀ + A B − (A − cos θ)/θ² (B δ) δᵀ, and B(y)ᵀ in front of it for that of ⊞.

⊟ of opposite points, half a great circle apart, has length π and no particular direction: its Jacobian is singular there.

Source: Hertzberg et al., Information Fusion 2013; the basis: Duff et al., Building an orthonormal basis, revisited, JCGT 2017.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.manifolds._batch import map_batch
from boxplus.manifolds._kernel_manifold import KernelManifold
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.so3 import exp_coefficients

_UNIT_TOLERANCE = 1e-3  # vectors this far from unit length come from rounded files, not from a mistake

Basis = tuple[float, float, float, float, float, float]


@kernel(inline=True)
def basis_scalars(x: float, y: float, z: float) -> Basis:
    """The columns of B, one after the other."""
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return 1.0 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y


@kernel
def _basis_batch(x: NDArray[np.float64], B: NDArray[np.float64]) -> None:
    for n in range(np.uint64(x.shape[0])):
        B[n, 0, 0], B[n, 1, 0], B[n, 2, 0], B[n, 0, 1], B[n, 1, 1], B[n, 2, 1] = basis_scalars(x[n, 0], x[n, 1], x[n, 2])


@kernel
def _boxplus_batch(x: NDArray[np.float64], delta: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    for n in range(np.uint64(x.shape[0])):
        B = basis_scalars(x[n, 0], x[n, 1], x[n, 2])
        d, e = delta[n, 0], delta[n, 1]
        A, _, _ = exp_coefficients(d * d + e * e)
        c = math.cos(math.sqrt(d * d + e * e))
        y0 = c * x[n, 0] + A * (B[0] * d + B[3] * e)
        y1 = c * x[n, 1] + A * (B[1] * d + B[4] * e)
        y2 = c * x[n, 2] + A * (B[2] * d + B[5] * e)
        scale = 1.0 / math.sqrt(y0 * y0 + y1 * y1 + y2 * y2)
        out[n, 0], out[n, 1], out[n, 2] = scale * y0, scale * y1, scale * y2


@kernel
def _boxminus_batch(y: NDArray[np.float64], x: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    for n in range(np.uint64(x.shape[0])):
        B = basis_scalars(x[n, 0], x[n, 1], x[n, 2])
        u = B[0] * y[n, 0] + B[1] * y[n, 1] + B[2] * y[n, 2]
        v = B[3] * y[n, 0] + B[4] * y[n, 1] + B[5] * y[n, 2]
        cosine = x[n, 0] * y[n, 0] + x[n, 1] * y[n, 1] + x[n, 2] * y[n, 2]
        sine = math.sqrt(u * u + v * v)
        if sine > 0.0:
            scale = math.atan2(sine, cosine) / sine
            out[n, 0], out[n, 1] = scale * u, scale * v
        else:
            out[n, 0], out[n, 1] = math.atan2(sine, cosine), 0.0


@kernel
def _jacobian_batch(x: NDArray[np.float64], delta: NDArray[np.float64], inverse: bool, J: NDArray[np.float64]) -> None:
    """∂((x ⊞ (δ + ε)) ⊟ (x ⊞ δ))/∂ε at ε = 0 for every row, or its inverse."""
    y = np.empty_like(x)
    _boxplus_batch(x, delta, y)
    for n in range(np.uint64(x.shape[0])):
        B, C = basis_scalars(x[n, 0], x[n, 1], x[n, 2]), basis_scalars(y[n, 0], y[n, 1], y[n, 2])
        d, e = delta[n, 0], delta[n, 1]
        A, b, c = exp_coefficients(d * d + e * e)
        # C·x, C·B and C·(B δ), the rows of C being those of B(y)ᵀ; (A − cos θ)/θ² = b − c.
        for row in range(np.uint64(2)):
            k = 3 * row
            C0, C1, C2 = C[k], C[k + 1], C[k + 2]
            along_x = C0 * x[n, 0] + C1 * x[n, 1] + C2 * x[n, 2]
            first = C0 * B[0] + C1 * B[1] + C2 * B[2]
            second = C0 * B[3] + C1 * B[4] + C2 * B[5]
            common = -A * along_x - (b - c) * (first * d + second * e)
            J[n, row, 0] = A * first + common * d
            J[n, row, 1] = A * second + common * e
        if inverse:
            scale = 1.0 / (J[n, 0, 0] * J[n, 1, 1] - J[n, 0, 1] * J[n, 1, 0])
            J[n, 0, 0], J[n, 1, 1] = scale * J[n, 1, 1], scale * J[n, 0, 0]
            J[n, 0, 1], J[n, 1, 0] = -scale * J[n, 0, 1], -scale * J[n, 1, 0]


def tangent_basis(x: ArrayLike) -> NDArray[np.float64]:
    """B (..., 3, 2) of unit vectors x (..., 3)."""
    return map_batch(_basis_batch, "x", x, (3,), (3, 2))


@dataclass(frozen=True, repr=False)
class _S2(KernelManifold):
    """Unit vectors (3,) moved along great circles by two angles.

    Example:
        >>> up = bp.S2.boxplus([0.0, 0.0, 1.0], [np.pi / 2, 0.0])
        >>> up.round(3), bp.S2.boxminus(up, [0.0, 0.0, 1.0]).round(3)
        (array([1., 0., 0.]), array([1.571, 0.   ]))
    """

    name = "S2"
    size = 3
    dof = 2
    tangent_names = ("first tilt [rad]", "second tilt [rad]")

    def boxplus_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        _boxplus_batch(x, delta, out)

    def boxminus_into(self, x: NDArray[np.float64], base: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        _boxminus_batch(x, base, out)

    def boxplus_jacobian_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        _jacobian_batch(x, delta, False, J)

    def boxminus_jacobian_into(self, x: NDArray[np.float64], base: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        difference = np.empty((len(x), 2))
        _boxminus_batch(x, base, difference)
        _jacobian_batch(base, difference, True, J)

    def check(self, name: str, x: ArrayLike) -> NDArray[np.float64]:
        rows = super().check(name, x)
        length = np.linalg.norm(rows, axis=1)
        off = ~(np.abs(length - 1.0) <= _UNIT_TOLERANCE)
        if off.any():
            row = int(np.argmax(off))
            raise InputError(
                f"{name} as unit vectors",
                f"length {length[row]:.4g} in row {row}",
                "divide it by its length; S2 is of directions",
            )
        np.divide(rows, length[:, None], out=rows, where=np.abs(length[:, None] - 1.0) > 4e-16)
        return rows

    def identity(self) -> NDArray[np.float64]:
        """Along z."""
        return np.array([0.0, 0.0, 1.0])

    def random(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        x = rng.normal(size=(count, 3))
        return np.asarray(x / np.linalg.norm(x, axis=1)[:, None])


S2: Manifold = _S2()
