"""One small step along one direction of a tangent, in compiled code: what numeric differentiation of one residual needs.

A step along a single direction is cheaper than a whole ⊞: a rotation about one axis has a constant half-angle cosine and sine,
a translation leaves the rotation as it is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.lines import Line3D
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import UnitQuaternion, UnitQuaternionLeft, multiply_scalars, rotate
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3, SE3Left
from boxplus.manifolds.sim3 import Sim3
from boxplus.manifolds.so3 import SO3
from boxplus.manifolds.sphere import S2, basis_scalars

ADD, TURN_RIGHT, TURN_LEFT, MOVE_LOCAL, TURN_MATRIX, MOVE_PLANE, MOVE_SCALED, GROW, TILT, TURN_ALONE = range(10)


def tangent_steps(manifold: Manifold) -> NDArray[np.int64] | None:
    """For every tangent direction (dof, 3): kind of step, first stored number it concerns, axis. None for foreign manifolds."""
    if isinstance(manifold, Euclidean):
        rows = [(ADD, k, 0) for k in range(manifold.n)]
    elif manifold == UnitQuaternion:
        rows = [(TURN_RIGHT, 0, k) for k in range(3)]
    elif manifold == UnitQuaternionLeft:
        rows = [(TURN_ALONE, 0, k) for k in range(3)]
    elif manifold == SE3:
        rows = [(TURN_RIGHT, 0, k) for k in range(3)] + [(MOVE_LOCAL, 0, k) for k in range(3)]
    elif manifold == SE3Left:
        rows = [(TURN_LEFT, 0, k) for k in range(3)] + [(ADD, 4 + k, 0) for k in range(3)]
    elif manifold == SO3:
        rows = [(TURN_MATRIX, 0, k) for k in range(3)]
    elif manifold == SE2:
        rows = [(ADD, 0, 0)] + [(MOVE_PLANE, 0, k) for k in range(2)]
    elif manifold == Line3D:
        rows = [(TURN_RIGHT, 0, k) for k in range(3)] + [(ADD, 4, 0)]
    elif manifold == S2:
        rows = [(TILT, 0, k) for k in range(2)]
    elif manifold == Sim3:
        rows = [(TURN_RIGHT, 0, k) for k in range(3)] + [(MOVE_SCALED, 0, k) for k in range(3)] + [(GROW, 7, 0)]
    elif isinstance(manifold, Product):
        parts, start = [], 0
        for component in manifold.components:
            part = tangent_steps(component)
            if part is None:
                return None
            parts.append(part + np.array([0, start, 0]))
            start += component.size
        return np.concatenate(parts)
    else:
        return None
    return np.array(rows, dtype=np.int64)


@kernel(inline=True)
def copy_into(x: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """out = x, element by element: for a handful of numbers faster than a slice."""
    for i in range(np.uint64(x.shape[0])):
        out[i] = x[i]


@kernel(inline=True)
def step_into(
    steps: NDArray[np.int64],
    direction: int,
    h: float,
    cos_half: float,
    sin_half: float,
    x: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """out = x ⊞ h e_direction, with cos_half = cos h/2 and sin_half = sin h/2."""
    kind, s, axis = steps[direction, 0], np.uint64(steps[direction, 1]), steps[direction, 2]
    copy_into(x, out)
    if kind == ADD:
        out[s] += h
        return
    e0 = 1.0 if axis == 0 else 0.0
    e1 = 1.0 if axis == 1 else 0.0
    e2 = 1.0 if axis == 2 else 0.0
    if kind == TURN_RIGHT:
        out[s], out[s + 1], out[s + 2], out[s + 3] = multiply_scalars(
            x[s], x[s + 1], x[s + 2], x[s + 3], cos_half, sin_half * e0, sin_half * e1, sin_half * e2
        )
    elif kind == TURN_LEFT or kind == TURN_ALONE:  # noqa: SIM109 - a tuple is slower
        w, a, b, c = cos_half, sin_half * e0, sin_half * e1, sin_half * e2
        out[s], out[s + 1], out[s + 2], out[s + 3] = multiply_scalars(w, a, b, c, x[s], x[s + 1], x[s + 2], x[s + 3])
        if kind == TURN_LEFT:
            out[s + 4], out[s + 5], out[s + 6] = rotate(w, a, b, c, x[s + 4], x[s + 5], x[s + 6])
    elif kind == MOVE_LOCAL:
        a, b, c = rotate(x[s], x[s + 1], x[s + 2], x[s + 3], h * e0, h * e1, h * e2)
        out[s + 4], out[s + 5], out[s + 6] = x[s + 4] + a, x[s + 5] + b, x[s + 6] + c
    elif kind == MOVE_SCALED:
        h *= x[s + 7]
        a, b, c = rotate(x[s], x[s + 1], x[s + 2], x[s + 3], h * e0, h * e1, h * e2)
        out[s + 4], out[s + 5], out[s + 6] = x[s + 4] + a, x[s + 5] + b, x[s + 6] + c
    elif kind == GROW:
        out[s] *= np.exp(h)
    elif kind == TILT:
        cosine, sine = 1.0 - 2.0 * sin_half * sin_half, 2.0 * sin_half * cos_half
        B = basis_scalars(x[s], x[s + 1], x[s + 2])
        out[s] = cosine * x[s] + sine * (e0 * B[0] + e1 * B[3])
        out[s + 1] = cosine * x[s + 1] + sine * (e0 * B[1] + e1 * B[4])
        out[s + 2] = cosine * x[s + 2] + sine * (e0 * B[2] + e1 * B[5])
    elif kind == MOVE_PLANE:
        cosine, sine = np.cos(x[s]), np.sin(x[s])
        out[s + 1] += h * (cosine * e0 - sine * e1)
        out[s + 2] += h * (sine * e0 + cosine * e1)
    else:  # TURN_MATRIX: the two columns beside the axis turn
        cosine, sine = 1.0 - 2.0 * sin_half * sin_half, 2.0 * sin_half * cos_half
        first, second = np.uint64((axis + 1) % 3), np.uint64((axis + 2) % 3)
        for row in range(np.uint64(3)):
            a, b = x[s + 3 * row + first], x[s + 3 * row + second]
            out[s + 3 * row + first] = cosine * a + sine * b
            out[s + 3 * row + second] = cosine * b - sine * a
