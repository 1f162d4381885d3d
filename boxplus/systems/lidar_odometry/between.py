"""The motion between two states, compiled: a cubic of the position, and one of the turning since the first.

`ends` (7, 3), one row each: turn rate at the first state, turning to the last one and its rate there, position and velocity of
the first state, and of the last one. Derivation: docs/lidar_odometry.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.propagation import N_A, N_P, N_R, N_TIME, N_V, N_W
from boxplus.manifolds.so3 import exp_into, log_into, product_into, right_jacobian_into, right_jacobian_inverse_into

_RATE, _TURN, _TURN_RATE, _FIRST = 0, 1, 2, 3
_DOF = 12


@kernel(inline=True)
def _hermite(t: float, T: float) -> tuple[float, float, float, float]:
    """Factors of the first value, its rate, the last value, and its rate, after t of T seconds."""
    s = t / T
    return 1.0 - 3.0 * s * s + 2.0 * s**3, T * (s - 2.0 * s * s + s**3), 3.0 * s * s - 2.0 * s**3, T * (s**3 - s * s)


@kernel
def poses_into(
    ends: NDArray[np.float64],
    duration: float,
    seconds: NDArray[np.float64],
    turn: NDArray[np.float64],
    p: NDArray[np.float64],
    v: NDArray[np.float64],
) -> None:
    """Turning since the first state, position and velocity (n, 3) so many seconds (n,) after it, of a motion of this duration."""
    T = duration
    for n in range(len(seconds)):
        s = seconds[n] / T
        a, b, c, d = _hermite(seconds[n], T)
        da, db, dc, dd = (
            (6.0 * s * s - 6.0 * s) / T,
            1.0 - 4.0 * s + 3.0 * s * s,
            (6.0 * s - 6.0 * s * s) / T,
            3.0 * s * s - 2.0 * s,
        )
        for i in range(3):
            p0, v0, p1, v1 = ends[_FIRST, i], ends[_FIRST + 1, i], ends[_FIRST + 2, i], ends[_FIRST + 3, i]
            turn[n, i] = b * ends[_RATE, i] + c * ends[_TURN, i] + d * ends[_TURN_RATE, i]
            p[n, i] = a * p0 + b * v0 + c * p1 + d * v1
            v[n, i] = da * p0 + db * v0 + dc * p1 + dd * v1


@kernel
def nodes_into(
    ends: NDArray[np.float64],
    duration: float,
    R_world_first: NDArray[np.float64],
    seconds: NDArray[np.float64],
    nodes: NDArray[np.float64],
) -> None:
    """Nodes (n − 1, NODE) at so many seconds (n,) after the first state, as the deskewing of points takes them."""
    count = len(seconds)
    turn, p, v = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 3))
    poses_into(ends, duration, seconds, turn, p, v)
    since, R, R_next, between = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    log = np.empty(3)
    for n in range(count):
        exp_into(turn[n, 0], turn[n, 1], turn[n, 2], since)
        product_into(R_world_first, since, R_next)
        if n:
            node, step = nodes[n - 1], seconds[n] - seconds[n - 1]
            for i in range(3):
                for j in range(3):
                    between[i, j] = R[0, i] * R_next[0, j] + R[1, i] * R_next[1, j] + R[2, i] * R_next[2, j]
                    node[N_R + 3 * i + j] = R[i, j]
            log_into(between, log)
            node[N_TIME] = seconds[n - 1]
            for i in range(3):
                node[N_P + i], node[N_V + i] = p[n - 1, i], v[n - 1, i]
                node[N_A + i] = 2.0 * (p[n, i] - p[n - 1, i] - step * v[n - 1, i]) / (step * step)
                node[N_W + i] = log[i] / step
        R, R_next = R_next, R


@kernel
def jacobians_into(
    ends: NDArray[np.float64],
    duration: float,
    R_world_first: NDArray[np.float64],
    R_world_last: NDArray[np.float64],
    last_rate: NDArray[np.float64],
    seconds: NDArray[np.float64],
    J: NDArray[np.float64],
) -> None:
    """J (n, 6, 24): how a point seen so long after the first state moves with both states' errors, as one of the last pose."""
    count = len(seconds)
    turn, p, v = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 3))
    poses_into(ends, duration, seconds, turn, p, v)
    work = np.empty((11, 3, 3))
    after, before, since, bend, along = work[0], work[1], work[2], work[3], work[4]
    attitude, about_last, moving, own, bent, product = work[5], work[6], work[7], work[8], work[9], work[10]
    tx, ty, tz = ends[_TURN, 0], ends[_TURN, 1], ends[_TURN, 2]
    right_jacobian_inverse_into(tx, ty, tz, after)
    right_jacobian_inverse_into(-tx, -ty, -tz, before)
    for n in range(count):
        a, b, c, d = _hermite(seconds[n], duration)
        exp_into(turn[n, 0], turn[n, 1], turn[n, 2], since)
        # How the turning at a point's time follows what it is interpolated from; then the attitude, on its right.
        right_jacobian_into(turn[n, 0], turn[n, 1], turn[n, 2], bend)
        # The turning to the last state moves what lies between directly, and by the last rate as seen along it (to first order).
        wx, wy, wz = 0.5 * d * last_rate[0], 0.5 * d * last_rate[1], 0.5 * d * last_rate[2]
        along[0, 0] = along[1, 1] = along[2, 2] = c
        along[0, 1], along[0, 2], along[1, 2] = wz, -wy, wx
        along[1, 0], along[2, 0], along[2, 1] = -wz, wy, -wx
        product_into(bend, along, bent)
        # From the point's own turning to the last pose's: about its axes, and as a motion of what lies away from it.
        product_into(R_world_first, since, attitude)
        rx, ry, rz = p[n, 0] - ends[_FIRST + 2, 0], p[n, 1] - ends[_FIRST + 2, 1], p[n, 2] - ends[_FIRST + 2, 2]
        for j in range(3):
            gx, gy, gz = attitude[0, j], attitude[1, j], attitude[2, j]
            for i in range(3):
                about_last[i, j] = R_world_last[0, i] * gx + R_world_last[1, i] * gy + R_world_last[2, i] * gz
            moving[0, j], moving[1, j], moving[2, j] = ry * gz - rz * gy, rz * gx - rx * gz, rx * gy - ry * gx
        for i in range(6):
            for j in range(2 * _DOF):
                J[n, i, j] = 0.0
        product_into(bent, before, product)
        for i in range(3):
            for j in range(3):
                own[i, j] = since[j, i] - product[i, j]
        _set_columns(J[n], 0, 1.0, about_last, moving, own)
        _set_columns(J[n], 6, b, about_last, moving, bend)
        product_into(bent, after, own)
        _set_columns(J[n], _DOF, 1.0, about_last, moving, own)
        product_into(bend, after, own)
        _set_columns(J[n], _DOF + 6, d, about_last, moving, own)
        for i in range(3):
            J[n, 3 + i, 3 + i], J[n, 3 + i, 9 + i] = a, b
            J[n, 3 + i, _DOF + 3 + i], J[n, 3 + i, _DOF + 9 + i] = c, d


@kernel
def _set_columns(
    J: NDArray[np.float64],
    column: int,
    factor: float,
    about_last: NDArray[np.float64],
    moving: NDArray[np.float64],
    own: NDArray[np.float64],
) -> None:
    """Three columns of J (6, 24): `factor` times what a point's own turning (3, 3) makes of the last pose."""
    for j in range(3):
        x, y, z = factor * own[0, j], factor * own[1, j], factor * own[2, j]
        for i in range(3):
            J[i, column + j] = about_last[i, 0] * x + about_last[i, 1] * y + about_last[i, 2] * z
            J[3 + i, column + j] = moving[i, 0] * x + moving[i, 1] * y + moving[i, 2] * z
