"""How far the points of a scan scatter about their planes, against what their weights take for granted.

The weights of `plane_information` say what a point is worth beside the others. As variances they are cautious: a plane of five
map points may lean, and a point that lies beside them counts for little, however well it fits. What the points do not know is in
their residuals z. The gradient Σ w z h of the cost has the covariance

    B = Σ_c g_c g_cᵀ,    g_c = Σ w z h over the points of c

with c the pieces of surfaces, cubes of `_PIECE_M` on which most of the normal lies along one axis: what is wrong with a piece,
all points on it share. A piece on which a direction hangs draws the estimate to itself, and its residuals vanish: g_c would be
A (A − A_c)⁻¹ g_c of the estimate without it, which is no more than 1 / (1 − tr A⁻¹A_c) as much, and counts as so much more. Where
that trace is 1, nothing but the piece may tell what is wrong with it, and all of the variance stays.

The weights alone say A = Σ w h hᵀ. The largest generalised eigenvalue of B against A is how many times the variance that A⁻¹
states is really there, in the direction that is worst (the sandwich of White, Econometrica 1980, with the clusters of Liang and
Zeger, Biometrika 1986, each left out as Bell and McCaffrey do, Survey Methodology 2002).

Residuals tell nothing of what moves all planes alike; `LEAST` of the stated variance stays for that. More than is stated is never
said.

Derivation: docs/lidar_inertial_odometry.md, section 10.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.nav_state import PL, RL, P, R
from boxplus.filtering.plane_information import USED
from boxplus.filtering.small_linalg import inverse_root_into, symmetric_eigen_into
from boxplus.filtering.triples import Triple, cross, dot, placed, rotation_of, triple_of, turned_back

LEAST = 0.05
_PIECE_M = 1.0
_SLOTS = 2048  # of the pieces; two that share one count as one


@kernel
def plane_scatter(
    x: NDArray[np.float64],
    p_lidar: NDArray[np.float32],
    planes: NDArray[np.float64],
    fate: NDArray[np.uint8],
    information: NDArray[np.float64],
) -> float:
    """Of the variance that the weights state, what the residuals at x bear out: `LEAST` to 1.

    Args:
        x: (36,) state; p_lidar: (n, 3) deskewed points, LiDAR frame.
        planes: (n, PLANE) with the weights of `accumulate_planes`; fate: (n,), USED where a point took part.
        information: (6, 6) A, what these weights made of them about the pose.
    """
    rotation, mounting, place, lever = rotation_of(x, R), rotation_of(x, RL), triple_of(x, P), triple_of(x, PL)
    root = np.zeros((6, 6))
    if not inverse_root_into(information, root):
        return 1.0  # what nothing measures cannot be held against residuals
    pieces, h = np.zeros((_SLOTS, 7)), np.empty(6)  # L⁻¹ Σ w z h, A = L Lᵀ, and the trace of A⁻¹ A_c
    for n in range(p_lidar.shape[0]):
        if fate[n] != USED:
            continue
        u, weight = triple_of(planes[n], 0), planes[n, 14]
        s = placed(mounting, lever, triple_of(p_lidar[n], 0))
        y = placed(rotation, place, s)
        turn, pull = cross(s, turned_back(rotation, u)), weight * (dot(u, y) - planes[n, 3])
        h[0], h[1], h[2], h[3], h[4], h[5] = turn[0], turn[1], turn[2], u[0], u[1], u[2]
        piece, leverage = _piece(y, u), 0.0
        for i in range(6):
            white = 0.0
            for k in range(i + 1):
                white += root[i, k] * h[k]
            leverage += white * white
            pieces[piece, i] += pull * white
        pieces[piece, 6] += weight * leverage
    B = np.zeros((6, 6))
    for n in range(_SLOTS):
        if pieces[n, 6] == 0.0:
            continue
        if pieces[n, 6] >= 1.0:
            return 1.0
        more = 1.0 / (1.0 - pieces[n, 6]) ** 2
        for i in range(6):
            for j in range(6):
                B[i, j] += more * pieces[n, i] * pieces[n, j]
    values, vectors = np.empty(6), np.empty((6, 6))
    symmetric_eigen_into(B, values, vectors)
    worst: float = values[5]
    return min(LEAST + max(worst, 0.0), 1.0)


@kernel(inline=True)
def _piece(y: Triple, u: Triple) -> int:
    """The slot of the piece of surface at y [m] with the normal u."""
    i, j, k = math.floor(y[0] / _PIECE_M), math.floor(y[1] / _PIECE_M), math.floor(y[2] / _PIECE_M)
    nx, ny, nz = abs(u[0]), abs(u[1]), abs(u[2])
    axis = 0 if nx >= ny and nx >= nz else (1 if ny >= nz else 2)
    mixed = (i * 73856093) ^ (j * 19349663) ^ (k * 83492791) ^ (axis * 39916801)
    return (mixed ^ (mixed >> 15)) & (_SLOTS - 1)
