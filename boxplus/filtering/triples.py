"""Vectors and rotations as tuples of numbers, for kernels that are called once a point.

Numbers of a tuple stay in registers. Those of an array are loaded again after everything that is stored, as it may have been
stored there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

Triple = tuple[float, float, float]
Rotation = tuple[float, float, float, float, float, float, float, float, float]  # row by row


@kernel(inline=True)
def triple_of(values: NDArray[np.floating], first: int) -> Triple:
    """Three numbers of an array, from `first` on."""
    return np.float64(values[first]), np.float64(values[first + 1]), np.float64(values[first + 2])


@kernel(inline=True)
def rotation_of(x: NDArray[np.float64], first: int) -> Rotation:
    """Nine numbers of an array, from `first` on."""
    return (
        x[first], x[first + 1], x[first + 2], x[first + 3], x[first + 4], x[first + 5], x[first + 6], x[first + 7], x[first + 8]
    )  # fmt: skip


@kernel(inline=True, fastmath=True)
def dot(a: Triple, b: Triple) -> float:
    """aᵀ b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel(inline=True, fastmath=True)
def cross(a: Triple, b: Triple) -> Triple:
    """a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel(inline=True, fastmath=True)
def turned(rotation: Rotation, p: Triple) -> Triple:
    """R p."""
    return (
        rotation[0] * p[0] + rotation[1] * p[1] + rotation[2] * p[2],
        rotation[3] * p[0] + rotation[4] * p[1] + rotation[5] * p[2],
        rotation[6] * p[0] + rotation[7] * p[1] + rotation[8] * p[2],
    )


@kernel(inline=True, fastmath=True)
def turned_back(rotation: Rotation, p: Triple) -> Triple:
    """Rᵀ p."""
    return (
        rotation[0] * p[0] + rotation[3] * p[1] + rotation[6] * p[2],
        rotation[1] * p[0] + rotation[4] * p[1] + rotation[7] * p[2],
        rotation[2] * p[0] + rotation[5] * p[1] + rotation[8] * p[2],
    )


@kernel(inline=True, fastmath=True)
def placed(rotation: Rotation, place: Triple, p: Triple) -> Triple:
    """R p + t."""
    x, y, z = turned(rotation, p)
    return x + place[0], y + place[1], z + place[2]


@kernel(inline=True, fastmath=True)
def product(A: Rotation, B: Rotation) -> Rotation:
    """A B."""
    a, b, c = turned_back(B, (A[0], A[1], A[2])), turned_back(B, (A[3], A[4], A[5])), turned_back(B, (A[6], A[7], A[8]))
    return a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]
