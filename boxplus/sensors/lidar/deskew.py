"""Motion compensation: every point is moved to the instant the scan ends (docs/lidar_inertial_odometry.md, section 3).

Between two nodes a point moves by out = M (Exp(ω s) (R_L ℓ + p_L)) + c₀ + c₁ s + c₂ s² with M = R_Lᵀ R_endᵀ R_node. The time
between nodes is cut into pieces in which the platform turns by little; in each, rotation and shift are cubic polynomials in
the time from the middle of the piece, so that the points of a piece take a few multiplications each and no branch.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.nav_state import PL, RL, P, R
from boxplus.filtering.propagation import N_A, N_P, N_R, N_TIME, N_V, N_W
from boxplus.manifolds.so3 import exp_into, product_into

# Exp(ω s) = Σ [ω]ᵏ sᵏ / k!; what follows k = 3 turns a point by at most θ⁴ / 24, θ = |ω s| (the remainder of a series whose
# derivatives are rotations times [ω]ᵏ). In half a piece θ ≤ 0.03: at most 3.4e-8 rad, half of what float32 resolves.
_PIECE_TURN = 0.06
_MOST_PIECES = 10_000.0  # of one node
# Of a piece, for each power of time: a matrix, row by row, and a shift.
_ROW = 12
_POWERS = 4
_K = tuple(np.int64(k) for k in range(_ROW))  # typed, as what takes a plain number is compiled for each number apart
_NS = 1e-9
_ONE, _TWO, _THREE = np.uint64(1), np.uint64(2), np.uint64(3)


@kernel
def deskew_into(
    p_lidar: NDArray[np.float32],
    time_ns: NDArray[np.int64],
    origin_ns: int,
    nodes: NDArray[np.float64],
    count: int,
    x_end: NDArray[np.float64],
    out: NDArray[np.float32],
) -> None:
    """Move every point to where the LiDAR would have seen it at the end of the scan (docs/lidar_inertial_odometry.md, section 3).

    Args:
        p_lidar: (n, 3), LiDAR frame, each at its own time.
        time_ns: (n,), in any order; in order of time, of each ring at least, is fastest. Before the first and after the
            last node the motion goes on as within it.
        origin_ns: the instant from which the times of the nodes count.
        nodes, count: from `propagate_interval`.
        x_end: (36,), the prior at the end of the scan.
        out: (n, 3), LiDAR frame at the end of the scan.
    """
    total = np.uint64(time_ns.shape[0])
    if not total:
        return
    low, high = time_ns[0], time_ns[0]
    for time in time_ns:
        low, high = min(low, time), max(high, time)
    begin_ns, pieces = _cut(origin_ns, nodes, count, x_end, low, high)
    points, moved = p_lidar.reshape(-1), out.reshape(-1)
    k, n = np.uint64(0), np.uint64(0)
    while n < total:
        while time_ns[n] < begin_ns[k]:
            k -= _ONE
        while time_ns[n] >= begin_ns[k + _ONE]:
            k += _ONE
        lower, upper = begin_ns[k], begin_ns[k + _ONE]
        end = n + _ONE
        while end < total and lower <= time_ns[end] < upper:
            end += _ONE
        _move(points, time_ns, _middle(lower, upper), pieces[k], n, end, moved)
        n = end


@kernel(inline=True)
def _middle(lower: int, upper: int) -> int:
    return lower + (upper - lower) // 2


@kernel(inline=True, fastmath=True)
def _cubic(c: NDArray[np.float64], k: int, s: float) -> float:
    value: float = c[k] + s * (c[k + _ROW] + s * (c[k + 2 * _ROW] + s * c[k + 3 * _ROW]))
    return value


@kernel(fastmath=True, inline=True)
def _move(
    points: NDArray[np.float32],
    time_ns: NDArray[np.int64],
    middle_ns: int,
    c: NDArray[np.float64],
    begin: int,
    end: int,
    moved: NDArray[np.float32],
) -> None:
    """The points [begin, end), all of one piece; points and moved are flat, as a second stride would stop vectorisation."""
    for n in range(begin, end):
        i, j, k = _THREE * n, _THREE * n + _ONE, _THREE * n + _TWO
        s = np.float64(time_ns[n] - middle_ns)
        x, y, z = np.float64(points[i]), np.float64(points[j]), np.float64(points[k])
        moved[i] = np.float32(_cubic(c, _K[0], s) * x + _cubic(c, _K[1], s) * y + _cubic(c, _K[2], s) * z + _cubic(c, _K[9], s))
        moved[j] = np.float32(_cubic(c, _K[3], s) * x + _cubic(c, _K[4], s) * y + _cubic(c, _K[5], s) * z + _cubic(c, _K[10], s))
        moved[k] = np.float32(_cubic(c, _K[6], s) * x + _cubic(c, _K[7], s) * y + _cubic(c, _K[8], s) * z + _cubic(c, _K[11], s))


@kernel
def _cut(
    origin_ns: int, nodes: NDArray[np.float64], count: int, x_end: NDArray[np.float64], low_ns: int, high_ns: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Pieces of the motion that cover [low_ns, high_ns]: begin of each and end of the last (n + 1,), polynomials (n, 48)."""
    node_ns = np.empty(count + 1, np.int64)
    for m in range(count):
        node_ns[m] = origin_ns + np.int64(np.rint(nodes[m, N_TIME] * 1e9))
    first_ns = node_ns[0]
    node_ns[0] = min(first_ns, low_ns)
    node_ns[count] = max(node_ns[count - 1], high_ns) + 1
    parts = np.empty(count, np.int64)
    total = 0
    for m in range(count):
        rate = math.sqrt(nodes[m, N_W] ** 2 + nodes[m, N_W + 1] ** 2 + nodes[m, N_W + 2] ** 2)
        cuts = rate * (node_ns[m + 1] - node_ns[m]) * _NS / _PIECE_TURN
        parts[m] = 1 + np.int64(cuts if cuts < _MOST_PIECES else _MOST_PIECES)
        total += parts[m]
    begin_ns = np.empty(total + 1, np.int64)
    begin_ns[total] = node_ns[count]
    pieces = np.empty((total, _POWERS * _ROW))

    R_L, R_back = np.empty((3, 3)), np.empty((3, 3))  # R_back = R_Lᵀ R_endᵀ
    for i in range(3):
        for j in range(3):
            R_L[i, j] = x_end[RL + 3 * i + j]
            R_back[i, j] = 0.0
            for k in range(3):
                R_back[i, j] += x_end[RL + 3 * k + i] * x_end[R + 3 * j + k]
    M, hat, turn = np.empty((3, 3)), np.zeros((3, 3)), np.empty((3, 3))
    E, next_E = np.empty((3, 3)), np.empty((3, 3))
    c = np.empty((3, 3))
    at = 0
    for m in range(count):
        node = nodes[m]
        wx, wy, wz = node[N_W], node[N_W + 1], node[N_W + 2]
        hat[0, 1], hat[0, 2], hat[1, 2] = -wz, wy, -wx
        hat[1, 0], hat[2, 0], hat[2, 1] = wz, -wy, wx
        product_into(R_back, node[N_R : N_R + 9].reshape(3, 3), M)
        for i in range(3):
            c[0, i], c[1, i], c[2, i] = 0.0, 0.0, 0.0
            for k in range(3):
                c[0, i] += R_back[i, k] * (node[N_P + k] - x_end[P + k]) - R_L[k, i] * x_end[PL + k]
                c[1, i] += R_back[i, k] * node[N_V + k]
                c[2, i] += 0.5 * R_back[i, k] * node[N_A + k]
        length = node_ns[m + 1] - node_ns[m]
        for part in range(parts[m]):
            begin_ns[at] = node_ns[m] + length * part // parts[m]
            middle_ns = _middle(begin_ns[at], node_ns[m] + length * (part + 1) // parts[m])
            s = (middle_ns - (first_ns if m == 0 else node_ns[m])) * _NS
            exp_into(wx * s, wy * s, wz * s, turn)
            product_into(M, turn, E)
            scale = 1.0
            for power in range(_POWERS):  # E = M Exp(ω s) [ω]^power, scale = 1 ns^power / power!
                polynomial = pieces[at, power * _ROW : (power + 1) * _ROW]
                product_into(E, R_L, next_E)
                for i in range(3):
                    for j in range(3):
                        polynomial[3 * i + j] = scale * next_E[i, j]
                    polynomial[9 + i] = scale * (E[i, 0] * x_end[PL] + E[i, 1] * x_end[PL + 1] + E[i, 2] * x_end[PL + 2])
                product_into(E, hat, next_E)
                E, next_E = next_E, E
                scale *= _NS / (power + 1)
            for i in range(3):
                pieces[at, 9 + i] += c[0, i] + s * (c[1, i] + s * c[2, i])
                pieces[at, _ROW + 9 + i] += (c[1, i] + 2.0 * s * c[2, i]) * _NS
                pieces[at, 2 * _ROW + 9 + i] += c[2, i] * _NS**2
            at += 1
    return begin_ns, pieces
