"""A turn of the camera, as corners tell it without anything else, and what it leaves of how they moved: parallax.

A turn moves all corners alike, whatever their depth. What the rotation that explains them best does not explain is what tells
depths, so that a camera that turns on the spot tells none.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds.nearest_rotation import nearest_rotation

_ROUNDS = 5  # of weights by distance, for the sum of the distances

Floats = NDArray[np.float64]


def turn_between(m1: Floats, m2: Floats) -> Floats:
    """The rotation R_21 (3, 3) that takes corners (n, 3), z = 1, closest to where they are, by the sum of the distances."""
    a, b = (m / np.linalg.norm(m, axis=1, keepdims=True) for m in (m1, m2))
    weight, R = np.ones(len(a)), np.eye(3)
    for _ in range(_ROUNDS):
        R = nearest_rotation((weight[:, None] * b).T @ a)
        distance = distances(R, m1, m2)
        weight = 1.0 / np.maximum(distance, 0.5 * float(np.median(distance)) + 1e-12)
    return R


def distances(R: Floats, m1: Floats, m2: Floats) -> Floats:
    """How far (n,) corners are from where a rotation R_21 takes them, in units of the rays."""
    there = m1 @ R.T
    return np.asarray(np.linalg.norm(there[:, :2] / there[:, 2:] - m2[:, :2], axis=1))
