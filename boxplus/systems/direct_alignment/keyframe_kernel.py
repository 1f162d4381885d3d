"""Preparing a keyframe: pixels to compare, their gradients and Jacobians, and depth at half the resolution, in compiled code."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.cameras.pinhole import project_point
from boxplus.manifolds.quaternion import rotation_entries

LEAST_Y_Z = 1e-6  # of a ray with z = 1 in the image it lands in: a point at infinity 90° off the optical axis
_DEPTH_STEP = 0.05  # share by which depths of neighbours may differ on one surface


@kernel
def half_depth(depth: NDArray[np.float32], half: NDArray[np.float32]) -> None:
    """Depth at half the resolution: the mean of those of 2×2 pixels that have one, if all are of the same surface; else none."""
    for i in range(np.uint64(half.shape[0])):
        for j in range(np.uint64(half.shape[1])):
            count, total, nearest, farthest = 0, 0.0, np.inf, 0.0
            for k in range(4):
                z = np.float64(depth[np.uint64(2) * i + np.uint64(k // 2), np.uint64(2) * j + np.uint64(k % 2)])
                if z > 0.0:
                    count += 1
                    total += z
                    nearest, farthest = min(nearest, z), max(farthest, z)
            half[i, j] = total / count if count > 0 and farthest < (1.0 + _DEPTH_STEP) * nearest else 0.0


@kernel(inline=True)
def _gradient(grey: NDArray[np.float32], i: int, j: int) -> tuple[float, float]:
    """Central differences [1/px], at the border one-sided."""
    left, right = max(j - 1, 0), min(j + 1, grey.shape[1] - 1)
    above, below = max(i - 1, 0), min(i + 1, grey.shape[0] - 1)
    along_u = (np.float64(grey[i, right]) - np.float64(grey[i, left])) / (right - left)
    along_v = (np.float64(grey[below, j]) - np.float64(grey[above, j])) / (below - above)
    return along_u, along_v


@kernel(inline=True)
def _at_a_step(depth: NDArray[np.float32], i: int, j: int) -> bool:
    """Whether a neighbour is of another surface: the edge between them moves with the nearer one, or is not where depth says."""
    z = depth[i, j]
    for a in range(max(i - 1, 0), min(i + 2, depth.shape[0])):
        for b in range(max(j - 1, 0), min(j + 2, depth.shape[1])):
            other = depth[a, b]
            if other > 0.0 and abs(other - z) > _DEPTH_STEP * z:
                return True
    return False


@kernel
def select_pixels(
    grey: NDArray[np.float32],
    depth: NDArray[np.float32],
    cell: int,
    with_steps: bool,
    pixels: NDArray[np.float64],
    gradients: NDArray[np.float64],
    values: NDArray[np.float64],
) -> int:
    """The pixel of the steepest gradient of every cell of `cell`×`cell` pixels, among those with depth, none at a step.

    Writes (u, v), the gradient, and (grey, depth) into rows; returns how many.
    """
    height, width = grey.shape
    count = 0
    for top in range(0, height, cell):
        for left in range(0, width, cell):
            steepest, row, column = -1.0, 0, 0
            for i in range(top, min(top + cell, height)):
                for j in range(left, min(left + cell, width)):
                    if not depth[i, j] > 0.0:
                        continue
                    along_u, along_v = _gradient(grey, i, j)
                    square = along_u * along_u + along_v * along_v
                    if square > steepest and (with_steps or not _at_a_step(depth, i, j)):
                        steepest, row, column = square, i, j
            if steepest < 0.0:
                continue
            pixels[count, 0], pixels[count, 1] = column, row
            gradients[count, 0], gradients[count, 1] = _gradient(grey, row, column)
            values[count, 0], values[count, 1] = grey[row, column], depth[row, column]
            count += 1
    return count


@kernel(inline=True)
def _pixel_motion(x: float, y: float, rho: float, c: NDArray[np.float64], P: NDArray[np.float64]) -> None:
    """P (2, 6) = ∂π(Exp(ξ) X)/∂ξ at ξ = 0, X = m/ρ, m = (x, y, 1): rows [m × Pₘᵀ, ρ Pₘ] of Pₘ = ∂π/∂m."""
    _, _, p00, p01, p02, p10, p11, p12 = project_point(x, y, 1.0, c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8])
    P[0, 0], P[0, 1], P[0, 2] = y * p02 - p01, p00 - x * p02, x * p01 - y * p00
    P[1, 0], P[1, 1], P[1, 2] = y * p12 - p11, p10 - x * p12, x * p11 - y * p10
    P[0, 3], P[0, 4], P[0, 5] = rho * p00, rho * p01, rho * p02
    P[1, 3], P[1, 4], P[1, 5] = rho * p10, rho * p11, rho * p12


@kernel
def pixel_jacobians(
    rays: NDArray[np.float64],
    inverse_depth: NDArray[np.float64],
    gradients: NDArray[np.float64],
    c: NDArray[np.float64],
    J: NDArray[np.float64],
) -> None:
    """J (n, 6) = ∇I₁ᵀ ∂π(Exp(ξ) X)/∂ξ at ξ = 0."""
    P = np.empty((2, 6))
    for n in range(np.uint64(len(rays))):
        _pixel_motion(rays[n, 0], rays[n, 1], inverse_depth[n], c, P)
        for i in range(6):
            J[n, i] = gradients[n, 0] * P[0, i] + gradients[n, 1] * P[1, i]


@kernel
def motion_of_seen(
    T_21: NDArray[np.float64],
    rays: NDArray[np.float64],
    inverse_depth: NDArray[np.float64],
    c: NDArray[np.float64],
    z_min: float,
    height: int,
    width: int,
    N: NDArray[np.float64],
) -> None:
    """N (6, 6) = Σ PᵀP over the pixels that land in the image: the Hessian if every gradient were 1 in both directions."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_entries(T_21[0], T_21[1], T_21[2], T_21[3])
    N[:] = 0.0
    P = np.empty((2, 6))
    for n in range(np.uint64(len(rays))):
        mx, my, rho = rays[n, 0], rays[n, 1], inverse_depth[n]
        x = r00 * mx + r01 * my + r02 + rho * T_21[4]
        y = r10 * mx + r11 * my + r12 + rho * T_21[5]
        z = r20 * mx + r21 * my + r22 + rho * T_21[6]
        if not (z > z_min * rho and z > LEAST_Y_Z):
            continue
        u, v, _, _, _, _, _, _ = project_point(x, y, z, c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8])
        if not (u >= 0.0 and v >= 0.0 and u < width - 1 and v < height - 1):
            continue
        _pixel_motion(mx, my, rho, c, P)
        for i in range(6):
            for j in range(6):
                N[i, j] += P[0, i] * P[0, j] + P[1, i] * P[1, j]
