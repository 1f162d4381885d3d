"""Motion compensation: every point is moved to the instant the scan ends (SPEC.md 9.5, step 4)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.nav_state import PL, RL, P, R
from boxplus.filtering.propagation import N_A, N_P, N_R, N_TIME, N_V, N_W
from boxplus.manifolds.so3 import exp_coefficients


@kernel
def deskew_into(
    p_lidar: NDArray[np.float32],
    time: NDArray[np.float64],
    nodes: NDArray[np.float64],
    count: int,
    x_end: NDArray[np.float64],
    out: NDArray[np.float32],
) -> None:
    """Move every point to where the LiDAR would have seen it at the end of the scan (SPEC.md 9.5, step 4).

    Args:
        p_lidar: (n, 3), LiDAR frame, each at its own time.
        time: (n,), seconds on the clock of the nodes, in any order.
        nodes, count: from `propagate_interval`.
        x_end: (36,), the prior at the end of the scan.
        out: (n, 3), LiDAR frame at the end of the scan.
    """
    # For one node: out = M (Exp(ω s) (R_L ℓ + p_L)) + c0 + c1 s + c2 s², with M = R_Lᵀ R_endᵀ R_node.
    M = np.empty((count, 3, 3))
    c = np.empty((count, 3, 3))
    R_back = np.empty((3, 3))  # R_Lᵀ R_endᵀ
    for i in range(3):
        for j in range(3):
            R_back[i, j] = 0.0
            for k in range(3):
                R_back[i, j] += x_end[RL + 3 * k + i] * x_end[R + 3 * j + k]
    for m in range(count):
        for i in range(3):
            for j in range(3):
                M[m, i, j] = 0.0
                for k in range(3):
                    M[m, i, j] += R_back[i, k] * nodes[m, N_R + 3 * k + j]
            c[m, 0, i] = 0.0
            c[m, 1, i] = 0.0
            c[m, 2, i] = 0.0
            for k in range(3):
                c[m, 0, i] += R_back[i, k] * (nodes[m, N_P + k] - x_end[P + k]) - x_end[RL + 3 * k + i] * x_end[PL + k]
                c[m, 1, i] += R_back[i, k] * nodes[m, N_V + k]
                c[m, 2, i] += 0.5 * R_back[i, k] * nodes[m, N_A + k]
    last = count - 1
    m = 0
    for n in range(p_lidar.shape[0]):
        t = time[n]
        if t < nodes[m, N_TIME]:
            while m > 0 and t < nodes[m, N_TIME]:
                m -= 1
        else:
            while m < last and t >= nodes[m + 1, N_TIME]:
                m += 1
        s = t - nodes[m, N_TIME]
        lx, ly, lz = np.float64(p_lidar[n, 0]), np.float64(p_lidar[n, 1]), np.float64(p_lidar[n, 2])
        qx = x_end[RL] * lx + x_end[RL + 1] * ly + x_end[RL + 2] * lz + x_end[PL]
        qy = x_end[RL + 3] * lx + x_end[RL + 4] * ly + x_end[RL + 5] * lz + x_end[PL + 1]
        qz = x_end[RL + 6] * lx + x_end[RL + 7] * ly + x_end[RL + 8] * lz + x_end[PL + 2]
        wx, wy, wz = nodes[m, N_W] * s, nodes[m, N_W + 1] * s, nodes[m, N_W + 2] * s
        angle_sq = wx * wx + wy * wy + wz * wz
        if angle_sq < 1e-4:  # below 0.6 degrees two terms of the series are exact to 1e-12
            a = 1.0 - angle_sq / 6.0
            b = 0.5 - angle_sq / 24.0
        else:
            a, b, _ = exp_coefficients(angle_sq)
        ux, uy, uz = wy * qz - wz * qy, wz * qx - wx * qz, wx * qy - wy * qx
        rx = qx + a * ux + b * (wy * uz - wz * uy)
        ry = qy + a * uy + b * (wz * ux - wx * uz)
        rz = qz + a * uz + b * (wx * uy - wy * ux)
        for i in range(3):
            out[n, i] = np.float32(
                M[m, i, 0] * rx + M[m, i, 1] * ry + M[m, i, 2] * rz + c[m, 0, i] + s * (c[m, 1, i] + s * c[m, 2, i])
            )
