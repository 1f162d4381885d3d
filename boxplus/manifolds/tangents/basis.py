"""∂(x ⊞ δ)/∂δ at δ = 0: how the stored numbers of a point move with a tangent, which is where automatic differentiation begins.

A function of the stored numbers has the derivative ∂f/∂x · ∂(x ⊞ δ)/∂δ along a tangent (docs/differentiation.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import multiply_scalars, rotate
from boxplus.manifolds.sphere import basis_scalars
from boxplus.manifolds.tangents.step import (
    ADD,
    GROW,
    MOVE_LOCAL,
    MOVE_PLANE,
    MOVE_SCALED,
    TILT,
    TURN_ALONE,
    TURN_LEFT,
    TURN_RIGHT,
    tangent_steps,
)
from boxplus.manifolds.user_manifold import UserManifold


@kernel(inline=True)
def tangent_basis_into(
    steps: NDArray[np.int64], x: NDArray[np.float64], basis: NDArray[np.float64], row: int, column: int
) -> None:
    """basis[row + i, column + k] = ∂(x ⊞ δ)ᵢ/∂δₖ, with the steps that `tangent_steps` gives for the manifold.

    Entries that are zero everywhere are not written.
    """
    for k in range(np.uint64(steps.shape[0])):
        kind, axis = steps[k, 0], steps[k, 2]
        s, r, c = np.uint64(steps[k, 1]), np.uint64(row) + np.uint64(steps[k, 1]), np.uint64(column) + k
        e0 = 1.0 if axis == 0 else 0.0
        e1 = 1.0 if axis == 1 else 0.0
        e2 = 1.0 if axis == 2 else 0.0
        if kind == ADD:
            basis[r, c] = 1.0
        elif kind == TURN_RIGHT:
            basis[r, c], basis[r + 1, c], basis[r + 2, c], basis[r + 3, c] = multiply_scalars(
                x[s], x[s + 1], x[s + 2], x[s + 3], 0.0, 0.5 * e0, 0.5 * e1, 0.5 * e2
            )
        elif kind == TURN_LEFT or kind == TURN_ALONE:  # noqa: SIM109 - a tuple is slower
            basis[r, c], basis[r + 1, c], basis[r + 2, c], basis[r + 3, c] = multiply_scalars(
                0.0, 0.5 * e0, 0.5 * e1, 0.5 * e2, x[s], x[s + 1], x[s + 2], x[s + 3]
            )
            if kind == TURN_LEFT:
                basis[r + 4, c] = e1 * x[s + 6] - e2 * x[s + 5]
                basis[r + 5, c] = e2 * x[s + 4] - e0 * x[s + 6]
                basis[r + 6, c] = e0 * x[s + 5] - e1 * x[s + 4]
        elif kind == MOVE_LOCAL or kind == MOVE_SCALED:  # noqa: SIM109 - a tuple is slower
            size = x[s + 7] if kind == MOVE_SCALED else 1.0
            basis[r + 4, c], basis[r + 5, c], basis[r + 6, c] = rotate(
                x[s], x[s + 1], x[s + 2], x[s + 3], size * e0, size * e1, size * e2
            )
        elif kind == GROW:
            basis[r, c] = x[s]
        elif kind == TILT:
            B = basis_scalars(x[s], x[s + 1], x[s + 2])
            for i in range(np.uint64(3)):
                basis[r + i, c] = e0 * B[i] + e1 * B[i + np.uint64(3)]
        elif kind == MOVE_PLANE:
            cosine, sine = np.cos(x[s]), np.sin(x[s])
            basis[r + 1, c] = cosine * e0 - sine * e1
            basis[r + 2, c] = sine * e0 + cosine * e1
        else:  # TURN_MATRIX
            first, second = np.uint64((axis + 1) % 3), np.uint64((axis + 2) % 3)
            for i in range(np.uint64(0), np.uint64(9), np.uint64(3)):
                basis[r + i + first, c] = x[s + i + second]
                basis[r + i + second, c] = -x[s + i + first]


@dataclass(frozen=True)
class BasisPart:
    """A component of a manifold: where its numbers and tangents begin, and what `tangent_basis_into` needs to know of it.

    Attributes:
        steps: of a shipped manifold.
        manifold: a user's, whose compiled ⊞ is differentiated.
    """

    stored: int
    tangent: int
    steps: NDArray[np.int64] | None = None
    manifold: UserManifold | None = None


def basis_parts(manifold: Manifold, stored: int = 0, tangent: int = 0) -> tuple[BasisPart, ...] | None:
    """The components of a manifold; None where one is a foreign one, of which compiled code knows nothing."""
    if isinstance(manifold, UserManifold):
        return (BasisPart(stored, tangent, manifold=manifold),)
    steps = tangent_steps(manifold)
    if steps is not None:
        return (BasisPart(stored, tangent, steps=steps),)
    if not isinstance(manifold, Product):
        return None
    found: list[BasisPart] = []
    for component in manifold.components:
        parts = basis_parts(component, stored, tangent)
        if parts is None:
            return None
        found += parts
        stored, tangent = stored + component.size, tangent + component.dof
    return tuple(found)
