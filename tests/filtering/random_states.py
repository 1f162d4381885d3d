"""Random states, covariances and numeric derivatives on the manifold of the navigation state."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import TANGENT, NavState
from boxplus.manifolds import so3

Floats = NDArray[np.float64]


def random_state(random: np.random.Generator, spread: float = 1.0) -> NavState:
    """Any attitude and extrinsic; positions, velocities and biases of the size `spread`."""
    R, R_L = so3.exp(random.normal(size=(2, 3)) * 1.5)
    p, v, bw, ba, p_L = spread * random.normal(size=(5, 3))
    return NavState(R, 10.0 * p, 3.0 * v, 0.1 * bw, 0.3 * ba, np.array([0.3, -0.2, -9.8]), R_L, 0.3 * p_L)


def random_covariance(random: np.random.Generator, size: int = TANGENT) -> Floats:
    """Symmetric positive definite, full, with standard deviations between 0.03 and 3."""
    root = random.normal(size=(size, size)) / np.sqrt(size)
    sigma = 10.0 ** random.uniform(-1.5, 0.5, size)
    covariance: Floats = np.outer(sigma, sigma) * (root @ root.T + 0.1 * np.eye(size))
    return covariance


def derivative(function: Callable[[Floats], Floats], size: int, step: float = 1e-3) -> Floats:
    """Fourth-order central differences of `function` at 0: (outputs, size)."""
    columns = []
    for direction in np.eye(size) * step:
        near, far = function(direction) - function(-direction), function(2 * direction) - function(-2 * direction)
        columns.append((8.0 * near - far) / (12.0 * step))
    return np.stack(columns, axis=-1)
