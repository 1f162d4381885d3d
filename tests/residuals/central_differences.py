"""Jacobians of residuals by fourth-order central differences in the tangent space (SPEC.md 11)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.residuals.residual import Residual


def numeric_jacobian(residual: Residual, x: list[NDArray[np.float64]], slot: int, step: float = 1e-3) -> NDArray[np.float64]:
    """∂r/∂δ of the connected variable `slot`, (N, dim, dof), one value (N, size) of every variable given."""
    manifold = residual.manifolds[slot]
    J = np.empty((residual.count, residual.dim, manifold.dof))
    for k in range(manifold.dof):

        def at(h: float, k: int = k) -> NDArray[np.float64]:
            moved = list(x)
            moved[slot] = manifold.boxplus(x[slot], h * np.eye(manifold.dof)[k])
            return residual.evaluate(*moved)

        J[:, :, k] = (8 * (at(step) - at(-step)) - (at(2 * step) - at(-2 * step))) / (12 * step)
    return J


def assert_jacobians(residual: Residual, *x: NDArray[np.float64], steps: tuple[float, ...] | None = None) -> None:
    """Compare the analytic Jacobians with differences, within 1e-7 of the largest entry; and evaluation with both."""
    values = [np.atleast_2d(v) for v in x]
    linear = residual.linearize(*values)
    assert linear.valid.all()
    assert np.abs(linear.residuals).max() > 1e-2, "the test must stay away from zero residual"
    np.testing.assert_array_equal(residual.evaluate(*values), linear.residuals)
    for slot, J in enumerate(linear.jacobians):
        expected = numeric_jacobian(residual, values, slot, 1e-3 if steps is None else steps[slot])
        size = np.maximum(1.0, np.abs(J).max(axis=(1, 2), keepdims=True))
        worst = float((np.abs(J - expected) / size).max())
        assert worst < 1e-7, f"{residual.roles[slot]}: off by {worst:.2g} of the largest entry"
