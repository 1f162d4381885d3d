"""One level of direct alignment: residuals, weighted normal equations and damped steps, in compiled code.

The keyframe's pixels bring their rays, inverse depths, grey values and Jacobians; of the image only grey values are looked up
(see `keyframe.py` for the derivation).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.cameras.pinhole import project_point
from boxplus.manifolds.quaternion import rotation_entries
from boxplus.manifolds.se3 import compose_into, exp_into
from boxplus.optimization.losses import loss_at
from boxplus.residuals.camera.photometric_sampling import sample_bilinear
from boxplus.systems.direct_alignment.keyframe_kernel import LEAST_Y_Z

CONVERGED, ITERATION_LIMIT, LITTLE_OVERLAP, NO_GRADIENT = 0, 1, 2, 3
_Nine = tuple[float, float, float, float, float, float, float, float, float]
_DOF = 8  # ξ = [w, v] of the pose, then relative gain and offset of the brightness
_FIRST_DAMPING, _LEAST_DAMPING, _LARGEST_DAMPING = 1e-4, 1e-9, 1e4
_SCALED_ON = 4096  # a median over so many residuals is known to 2 %
_SCALE_MOVED = 0.1  # relative change of σ from which on the weights are computed anew
_SHORTEST_GAIN = 0.2  # of the brightness in one step


@kernel(inline=True, borrow=True)
def _warped(
    R: _Nine,
    T_21: NDArray[np.float64],
    mx: float,
    my: float,
    rho: float,
    image_2: NDArray[np.float32],
    c: NDArray[np.float64],
    z_min: float,
) -> tuple[bool, float]:
    """Whether the point of a ray (mx, my, 1) at the inverse depth ρ is seen in image 2, and the grey value there."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = R
    x = r00 * mx + r01 * my + r02 + rho * T_21[4]
    y = r10 * mx + r11 * my + r12 + rho * T_21[5]
    z = r20 * mx + r21 * my + r22 + rho * T_21[6]
    if not (z > z_min * rho and z > LEAST_Y_Z):
        return False, 0.0
    u, v, _, _, _, _, _, _ = project_point(x, y, z, c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8])
    found, value, _, _ = sample_bilinear(image_2, u, v)
    return found, value


@kernel
def linearize(
    T_21: NDArray[np.float64],
    gain: float,
    offset: float,
    rays_1: NDArray[np.float64],
    inverse_depth_1: NDArray[np.float64],
    grey_1: NDArray[np.float64],
    J_1: NDArray[np.float64],
    share_1: NDArray[np.float64],
    image_2: NDArray[np.float32],
    c: NDArray[np.float64],
    z_min: float,
    loss_code: int,
    loss_scale: float,
    sigma: float,
    e: NDArray[np.float64],
    H: NDArray[np.float64],
    g: NDArray[np.float64],
) -> tuple[int, float, float, float]:
    """Residuals e (n,) = I₁ − (gain I₂ + offset), those that count first; H = Σ s ρ' JᵀJ/σ² (8, 8), g = Σ s ρ' Jᵀe/σ² (8,),
    with s (n,) of the keyframe, see `Level.share`.

    Returns:
        number of pixels that count, Σ s ρ((e/σ)²), Σ |e|, Σ s ρ'.
    """
    R = rotation_entries(T_21[0], T_21[1], T_21[2], T_21[3])
    H[:] = 0.0
    g[:] = 0.0
    row = np.empty(_DOF)
    count, cost, total, weights = np.uint64(0), 0.0, 0.0, 0.0
    information = 1.0 / (sigma * sigma)
    for n in range(np.uint64(len(grey_1))):
        found, value = _warped(R, T_21, rays_1[n, 0], rays_1[n, 1], inverse_depth_1[n], image_2, c, z_min)
        if not found:
            continue
        grey = grey_1[n]
        error = grey - gain * value - offset
        e[count] = error
        count += np.uint64(1)
        loss, slope, _ = loss_at(loss_code, loss_scale, error * error * information)
        share = share_1[n]
        cost += share * loss
        total += abs(error)
        weights += share * slope
        weight = share * slope * information
        for i in range(6):
            row[i] = J_1[n, i]
        row[6], row[7] = grey, 1.0
        for i in range(_DOF):
            weighted = weight * row[i]
            g[i] += weighted * error
            for j in range(i + 1):
                H[i, j] += weighted * row[j]
    for i in range(_DOF):
        for j in range(i):
            H[j, i] = H[i, j]
    return int(count), cost, total, weights


@kernel
def cell_scores(
    T_21: NDArray[np.float64],
    gain: float,
    offset: float,
    pixels_1: NDArray[np.float64],
    rays_1: NDArray[np.float64],
    inverse_depth_1: NDArray[np.float64],
    grey_1: NDArray[np.float64],
    J_1: NDArray[np.float64],
    share_1: NDArray[np.float64],
    image_2: NDArray[np.float32],
    c: NDArray[np.float64],
    z_min: float,
    loss_code: int,
    loss_scale: float,
    sigma: float,
    cell: float,
    across: int,
    scores: NDArray[np.float64],
) -> tuple[float, float]:
    """scores (cells, 8): Σ s ρ' Jᵀe/σ² over the pixels of each square cell of the keyframe, row by row, `across` of them in one.

    Returns:
        Σ s ρ' and Σ s (ρ' + 2 ρ'' e²/σ²), whose ratio is that of the weights to the slope of the influence ρ' e.
    """
    R = rotation_entries(T_21[0], T_21[1], T_21[2], T_21[3])
    scores[:] = 0.0
    information, weights, slopes = 1.0 / (sigma * sigma), 0.0, 0.0
    for n in range(np.uint64(len(grey_1))):
        found, value = _warped(R, T_21, rays_1[n, 0], rays_1[n, 1], inverse_depth_1[n], image_2, c, z_min)
        if not found:
            continue
        grey = grey_1[n]
        error = grey - gain * value - offset
        square = error * error * information
        _, slope, curvature = loss_at(loss_code, loss_scale, square)
        share = share_1[n]
        weights += share * slope
        slopes += share * (slope + 2.0 * curvature * square)
        row = np.uint64(pixels_1[n, 1] / cell) * np.uint64(across) + np.uint64(pixels_1[n, 0] / cell)
        pull = share * slope * information * error
        for i in range(6):
            scores[row, i] += pull * J_1[n, i]
        scores[row, 6] += pull * grey
        scores[row, 7] += pull
    return weights, slopes


@kernel
def _sigma(e: NDArray[np.float64], count: int, least: float) -> float:
    """Robust standard deviation of e[:count] by the median of |e|."""
    step = max(count // _SCALED_ON, 1)
    return max(1.4826 * float(np.median(np.abs(e[:count:step]))), least)


@kernel
def _solve(
    H: NDArray[np.float64], g: NDArray[np.float64], damping: float, dof: int, L: NDArray[np.float64], x: NDArray[np.float64]
) -> bool:
    """x = −(H + damping diag H)⁻¹ g of the first `dof` unknowns by Cholesky, the others 0; False where H is not positive."""
    largest = 0.0
    for i in range(dof):
        largest = max(largest, H[i, i])
    x[:] = 0.0
    for i in range(dof):
        for j in range(i + 1):
            entry = H[i, j]
            if i == j:
                entry += damping * entry + 1e-15 * largest
            for k in range(j):
                entry -= L[i, k] * L[j, k]
            if i == j:
                if not entry > 0.0:
                    return False
                L[i, i] = math.sqrt(entry)
            else:
                L[i, j] = entry / L[j, j]
    for i in range(dof):
        x[i] = -g[i]
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] /= L[i, i]
    for i in range(dof - 1, -1, -1):
        for k in range(i + 1, dof):
            x[i] -= L[k, i] * x[k]
        x[i] /= L[i, i]
    return True


@kernel
def align_level(
    T_21: NDArray[np.float64],
    light: NDArray[np.float64],
    rays_1: NDArray[np.float64],
    inverse_depth_1: NDArray[np.float64],
    grey_1: NDArray[np.float64],
    J_1: NDArray[np.float64],
    share_1: NDArray[np.float64],
    image_2: NDArray[np.float32],
    c: NDArray[np.float64],
    z_min: float,
    loss_code: int,
    loss_scale: float,
    with_brightness: bool,
    max_iterations: int,
    tolerance: float,
    reach: float,
    least_sigma: float,
    fewest: int,
    H: NDArray[np.float64],
    figures: NDArray[np.float64],
) -> int:
    """Levenberg-Marquardt at one level; moves `T_21` (7,) and `light` (2,), gain and offset, in place.

    `H` (8, 8) and `figures` (6,), count, Σ s ρ, Σ |e|, Σ s ρ', σ and iterations, are those at the pose that is left.
    """
    e, H_trial, g, g_trial = np.empty(len(grey_1)), np.empty((_DOF, _DOF)), np.empty(_DOF), np.empty(_DOF)
    L, x, step, trial = np.zeros((_DOF, _DOF)), np.empty(_DOF), np.empty(7), np.empty(7)
    dof = _DOF if with_brightness else 6
    gain, offset, damping, iterations = light[0], light[1], _FIRST_DAMPING, 0
    sigma, status = 1.0, ITERATION_LIMIT
    count, cost, total, weights = linearize(
        T_21,
        gain,
        offset,
        rays_1,
        inverse_depth_1,
        grey_1,
        J_1,
        share_1,
        image_2,
        c,
        z_min,
        loss_code,
        loss_scale,
        sigma,
        e,
        H,
        g,
    )
    stale = True
    while True:
        if count < fewest:
            status = LITTLE_OVERLAP
            break
        new_sigma = _sigma(e, count, least_sigma)
        if stale or abs(new_sigma - sigma) > _SCALE_MOVED * sigma:
            sigma, stale = new_sigma, False
            count, cost, total, weights = linearize(
                T_21, gain, offset, rays_1, inverse_depth_1, grey_1, J_1, share_1, image_2, c, z_min, loss_code, loss_scale,
                sigma, e, H, g,
            )  # fmt: skip
        if status == CONVERGED or iterations >= max_iterations:
            break
        iterations += 1
        is_better = is_small = False
        while not (is_better or is_small) and damping <= _LARGEST_DAMPING:
            if not _solve(H, g, damping, dof, L, x):
                status = NO_GRADIENT
                break
            is_small = (
                max(abs(x[0]), abs(x[1]), abs(x[2])) < tolerance and max(abs(x[3]), abs(x[4]), abs(x[5])) < tolerance * reach
            )
            exp_into(-x[0], -x[1], -x[2], -x[3], -x[4], -x[5], step)
            compose_into(T_21, step, trial)
            scale = max(1.0 + x[6], _SHORTEST_GAIN)
            new_gain, new_offset = gain / scale, (offset - x[7]) / scale
            new_count, new_cost, new_total, new_weights = linearize(
                trial, new_gain, new_offset, rays_1, inverse_depth_1, grey_1, J_1, share_1, image_2, c, z_min, loss_code,
                loss_scale, sigma, e, H_trial, g_trial,
            )  # fmt: skip
            # Means, as pixels enter and leave the image; at least half must stay, as an empty sum is no success.
            is_better = 2 * new_count > count and new_cost * count < cost * new_count
            damping = max(0.1 * damping, _LEAST_DAMPING) if is_better else 10.0 * damping
        if status == NO_GRADIENT:
            break
        if is_better:
            for i in range(T_21.shape[0]):
                T_21[i] = trial[i]
            gain, offset, count, cost, total, weights = new_gain, new_offset, new_count, new_cost, new_total, new_weights
            for i in range(g.shape[0]):
                g[i] = g_trial[i]
                for j in range(g.shape[0]):
                    H[i, j] = H_trial[i, j]
        if is_small or not is_better:
            status = CONVERGED
        if not is_better:
            break  # e holds the residuals of the step that was refused, all else those of the pose that stays
    light[0], light[1] = gain, offset
    figures[0], figures[1], figures[2], figures[3], figures[4], figures[5] = count, cost, total, weights, sigma, iterations
    return status
