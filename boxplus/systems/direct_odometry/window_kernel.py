"""Patches of one keyframe looked up in another: residuals and normal equations, in compiled code (see `window.py`)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.cameras.pinhole import project_point
from boxplus.manifolds.quaternion import rotation_entries
from boxplus.systems.direct_alignment.keyframe_kernel import LEAST_Y_Z

PATCH = 8
_DOF = 7  # ξ, a
GOOD, OUTSIDE, OUTLIER = 0, 1, 2


@kernel(inline=True)
def _sample(image: NDArray[np.float32], u: float, v: float) -> tuple[bool, float, float, float]:
    """Whether all pixels are there; grey value, bilinear; central differences, bilinear as well [1/px].

    The noise of these differences has nothing in common with that of the grey value. That of the interpolant's own gradient has:
    it would pull every pixel to where interpolation smooths most, half-way between two.
    """
    if not (u >= 1.0 and v >= 1.0 and u < image.shape[1] - 2 and v < image.shape[0] - 2):
        return False, 0.0, 0.0, 0.0
    one = np.uint64(1)
    j, i = np.uint64(u), np.uint64(v)
    b, a = u - float(j), v - float(i)
    k, m = j + one, i + one
    p00, p01 = np.float64(image[i, j]), np.float64(image[i, k])
    p10, p11 = np.float64(image[m, j]), np.float64(image[m, k])
    value = (1.0 - a) * (p00 + b * (p01 - p00)) + a * (p10 + b * (p11 - p10))
    left, right = j - one, k + one
    upper = (1.0 - b) * (p01 - np.float64(image[i, left])) + b * (np.float64(image[i, right]) - p00)
    lower = (1.0 - b) * (p11 - np.float64(image[m, left])) + b * (np.float64(image[m, right]) - p10)
    top, bottom = i - one, m + one
    before = (1.0 - a) * (p10 - np.float64(image[top, j])) + a * (np.float64(image[bottom, j]) - p00)
    after = (1.0 - a) * (p11 - np.float64(image[top, k])) + a * (np.float64(image[bottom, k]) - p01)
    return True, value, 0.5 * ((1.0 - a) * upper + a * lower), 0.5 * ((1.0 - b) * before + b * after)


@kernel(fastmath=True)
def patch_pair(
    T_th: NDArray[np.float64],
    T_th_first: NDArray[np.float64],
    gain: float,
    rays: NDArray[np.float64],
    grey: NDArray[np.float64],
    share: NDArray[np.float64],
    tilt: NDArray[np.float64],
    rho: NDArray[np.float64],
    image: NDArray[np.float32],
    c: NDArray[np.float64],
    z_min: float,
    sigma: float,
    huber: float,
    most: float,
    with_jacobians: bool,
    H: NDArray[np.float64],
    g: NDArray[np.float64],
    H_cross: NDArray[np.float64],
    H_rho: NDArray[np.float64],
    g_rho: NDArray[np.float64],
    pulls: NDArray[np.float64],
    mean_error: NDArray[np.float64],
    state: NDArray[np.uint8],
) -> float:
    """Patches of host h in target t, each with a brightness offset of its own; returns half their robust cost.

    Args:
        T_th, T_th_first: (7,) where the residuals are taken, and where the geometry of their Jacobians is.
        gain: e^(a_t − a_h).
        rays: (n, 8, 2) of z = 1; grey, share: (n, 8) of the host, and weight of each pixel; tilt: (n, 8) inverse depth of each
            pixel by rho, (n,) [1/m], that of the patch.
        sigma: of residuals; huber: in units of it; most: mean |e| of an outlier, in units of it.
        H, g: (7, 7), (7,) of [ξ, a], ξ moving T_th on the left, a of the target; set.
        H_cross, H_rho, g_rho: (n, 7), (n,), (n,) with and of the inverse depths; set. pulls: (n, 7) Jᵀe by patch; set.
        mean_error: (n,) mean |e|; state: (n,) whether the patch counts; set. One outside of the image costs nothing.
    """
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_entries(T_th[0], T_th[1], T_th[2], T_th[3])
    s00, s01, s02, s10, s11, s12, s20, s21, s22 = rotation_entries(T_th_first[0], T_th_first[1], T_th_first[2], T_th_first[3])
    tx, ty, tz = T_th[4], T_th[5], T_th[6]
    sx, sy, sz = T_th_first[4], T_th_first[5], T_th_first[6]
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8]
    H[:] = 0.0
    g[:] = 0.0
    row, local, pull, sums = np.empty(_DOF), np.empty((_DOF, _DOF)), np.empty(_DOF), np.empty(_DOF)
    errors, along_u, along_v = np.empty(PATCH), np.empty(PATCH), np.empty(PATCH)
    information = 1.0 / (sigma * sigma)
    dearest = 0.5 * PATCH * huber * (2.0 * most - huber)
    cost = 0.0
    for n in range(np.uint64(len(rho))):
        H_rho[n] = g_rho[n] = mean_error[n] = 0.0
        for i in range(_DOF):
            H_cross[n, i] = pulls[n, i] = 0.0
        inverse_depth, mean, whole, is_seen = rho[n], 0.0, 0.0, True
        for k in range(PATCH):
            mx, my, own = rays[n, k, 0], rays[n, k, 1], inverse_depth * tilt[n, k]
            x = r00 * mx + r01 * my + r02 + own * tx
            y = r10 * mx + r11 * my + r12 + own * ty
            z = r20 * mx + r21 * my + r22 + own * tz
            if not (z > z_min * own and z > LEAST_Y_Z):
                is_seen = False
                break
            u, v, _, _, _, _, _, _ = project_point(x, y, z, fx, fy, cx, cy, k1, k2, p1, p2, k3)
            found, value, du, dv = _sample(image, u, v)
            if not found:
                is_seen = False
                break
            errors[k], along_u[k], along_v[k] = value - gain * grey[n, k], du, dv
            mean += share[n, k] * errors[k]
            whole += share[n, k]
        if not is_seen:
            state[n] = OUTSIDE
            continue
        mean, total = mean / whole, 0.0
        for k in range(PATCH):
            errors[k] -= mean
            total += abs(errors[k])
        mean_error[n] = total / PATCH
        if total > PATCH * most * sigma:
            state[n] = OUTLIER
            cost += dearest
            continue
        state[n] = GOOD
        patch_cost, h_rho, f_rho = 0.0, 0.0, 0.0
        sum_rho, sum_e, sum_w = 0.0, 0.0, 0.0
        if with_jacobians:
            local[:] = 0.0
            pull[:] = 0.0
            sums[:] = 0.0
        for k in range(PATCH):
            size = abs(errors[k]) / sigma
            weight = share[n, k]
            patch_cost += weight * (0.5 * size * size if size <= huber else huber * (size - 0.5 * huber))
            if not with_jacobians:
                continue
            weight *= information * (1.0 if size <= huber else huber / size)
            mx, my, own = rays[n, k, 0], rays[n, k, 1], inverse_depth * tilt[n, k]
            x = s00 * mx + s01 * my + s02 + own * sx
            y = s10 * mx + s11 * my + s12 + own * sy
            z = s20 * mx + s21 * my + s22 + own * sz
            _, _, p00, p01, p02, p10, p11, p12 = project_point(x, y, z, fx, fy, cx, cy, k1, k2, p1, p2, k3)
            q0 = along_u[k] * p00 + along_v[k] * p10
            q1 = along_u[k] * p01 + along_v[k] * p11
            q2 = along_u[k] * p02 + along_v[k] * p12
            row[0], row[1], row[2] = y * q2 - z * q1, z * q0 - x * q2, x * q1 - y * q0
            row[3], row[4], row[5] = own * q0, own * q1, own * q2
            row[6] = -gain * grey[n, k]
            by_rho = tilt[n, k] * (q0 * sx + q1 * sy + q2 * sz)
            sum_w += weight
            sum_rho += weight * by_rho
            sum_e += weight * errors[k]
            for i in range(_DOF):
                weighted = weight * row[i]
                sums[i] += weighted
                pull[i] += weighted * errors[k]
                H_cross[n, i] += weighted * by_rho
                for j in range(i + 1):
                    local[i, j] += weighted * row[j]
            h_rho += weight * by_rho * by_rho
            f_rho += weight * by_rho * errors[k]
        cost += min(patch_cost, dearest)
        if with_jacobians:
            # The offset of the patch is eliminated.
            for i in range(_DOF):
                H_cross[n, i] -= sums[i] * sum_rho / sum_w
                pull[i] -= sums[i] * sum_e / sum_w
                for j in range(i + 1):
                    local[i, j] -= sums[i] * sums[j] / sum_w
            h_rho -= sum_rho * sum_rho / sum_w
            f_rho -= sum_rho * sum_e / sum_w
            H_rho[n], g_rho[n] = h_rho, f_rho
            for i in range(_DOF):
                g[i] += pull[i]
                pulls[n, i] = pull[i]
                for j in range(i + 1):
                    H[i, j] += local[i, j]
    for i in range(_DOF):
        for j in range(i):
            H[j, i] = H[i, j]
    return cost


@kernel(fastmath=True)
def eliminate(
    W: NDArray[np.float64], H_rho: NDArray[np.float64], g_rho: NDArray[np.float64], H: NDArray[np.float64], g: NDArray[np.float64]
) -> None:
    """H (m, m) −= Σ w wᵀ/h and g (m,) −= Σ w f/h over rows w of W (n, m), h of H_rho and f of g_rho; none at h ≤ 0."""
    size = np.uint64(W.shape[1])
    for n in range(np.uint64(W.shape[0])):
        if not H_rho[n] > 0.0:
            continue
        w, inverse = W[n], 1.0 / H_rho[n]
        for i in range(size):
            factor = w[i] * inverse
            if factor == 0.0:
                continue
            g[i] -= factor * g_rho[n]
            for j in range(i + np.uint64(1)):
                H[i, j] -= factor * w[j]
    for i in range(size):
        for j in range(i):
            H[j, i] = H[i, j]


@kernel(fastmath=True)
def add_rows(
    rows: NDArray[np.float64],
    adjoint: NDArray[np.float64],
    scale: float,
    host: int,
    target: int,
    total: NDArray[np.float64],
) -> None:
    """total (n, m) += scale · rows (n, 7) of [ξ, a], mapped to the state (ξ = Ad ξ_h − ξ_t, a_t − a_h), at columns of h and t."""
    for n in range(np.uint64(rows.shape[0])):
        row, out = rows[n], total[n]
        for j in range(6):
            by_host = 0.0
            for i in range(6):
                by_host += row[i] * adjoint[i, j]
            out[host + j] += scale * by_host
            out[target + j] -= scale * row[j]
        out[host + 6] -= scale * row[6]
        out[target + 6] += scale * row[6]
