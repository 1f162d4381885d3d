"""Search along epipolar lines for the inverse depth of patches, in compiled code (see `epipolar_search.py`)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.cameras.pinhole import project_point
from boxplus.manifolds.quaternion import rotation_entries
from boxplus.residuals.camera.photometric_sampling import sample_bilinear
from boxplus.systems.direct_alignment.keyframe_kernel import LEAST_Y_Z

FOUND, OUTSIDE, DIFFERENT, AMBIGUOUS, NO_GRADIENT = 0, 1, 2, 3, 4
_MOST_STEPS = 512
_APART = 3  # steps from the best one on which another minimum is another place
_REFINEMENTS = 4


@kernel
def search_lines(
    T_21: NDArray[np.float64],
    rays: NDArray[np.float64],
    grey: NDArray[np.float64],
    nearest: NDArray[np.float64],
    farthest: NDArray[np.float64],
    image: NDArray[np.float32],
    c: NDArray[np.float64],
    most_error: float,
    ratio: float,
    least_sigma: float,
    rho: NDArray[np.float64],
    sigma_rho: NDArray[np.float64],
    state: NDArray[np.uint8],
) -> None:
    """Inverse depths ρ (n,) of patches (n, K) of image 1, the centre of each first, between `farthest` and `nearest` [1/m].

    Steps of a pixel along the line; cost Σ |e| of the patch without its mean; then Gauss-Newton of ρ below a pixel. `sigma_rho`
    (n,) is its standard deviation by the gradient along the line and the patch's residuals, at least `least_sigma`.
    """
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_entries(T_21[0], T_21[1], T_21[2], T_21[3])
    tx, ty, tz = T_21[4], T_21[5], T_21[6]
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8]
    size = grey.shape[1]
    du, dv, own, seen, slope = np.empty(size), np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    costs, places = np.empty(_MOST_STEPS), np.empty(_MOST_STEPS)
    for n in range(np.uint64(len(rho))):
        rho[n], sigma_rho[n], state[n] = 0.0, np.inf, OUTSIDE
        mean = 0.0
        for k in range(size):
            mean += grey[n, k]
        mean /= size
        # Where the other pixels of the patch lie around its centre: by their rays, for a point at the middle of the range.
        middle = 0.5 * (nearest[n] + farthest[n])
        u0, v0, is_good = 0.0, 0.0, True
        for k in range(size):
            own[k] = grey[n, k] - mean
            mx, my = rays[n, k, 0], rays[n, k, 1]
            z = r20 * mx + r21 * my + r22 + middle * tz
            if not z > LEAST_Y_Z:
                is_good = False
                break
            x, y = r00 * mx + r01 * my + r02 + middle * tx, r10 * mx + r11 * my + r12 + middle * ty
            u, v, _, _, _, _, _, _ = project_point(x, y, z, fx, fy, cx, cy, k1, k2, p1, p2, k3)
            if k == 0:
                u0, v0 = u, v
            du[k], dv[k] = u - u0, v - v0
        if not is_good:
            continue
        mx, my = rays[n, 0, 0], rays[n, 0, 1]
        ax, ay, az = r00 * mx + r01 * my + r02, r10 * mx + r11 * my + r12, r20 * mx + r21 * my + r22
        at, count = farthest[n], 0
        best, least = -1, np.inf
        while at <= nearest[n] and count < _MOST_STEPS:
            z = az + at * tz
            if not z > LEAST_Y_Z:
                break
            u, v, p00, p01, p02, p10, p11, p12 = project_point(
                ax + at * tx, ay + at * ty, z, fx, fy, cx, cy, k1, k2, p1, p2, k3
            )  # fmt: skip
            along_u, along_v = p00 * tx + p01 * ty + p02 * tz, p10 * tx + p11 * ty + p12 * tz
            speed = math.sqrt(along_u * along_u + along_v * along_v)
            if not speed > 0.0:
                break
            total, mean, is_inside = 0.0, 0.0, True
            for k in range(size):
                found, value, _, _ = sample_bilinear(image, u + du[k], v + dv[k])
                if not found:
                    is_inside = False
                    break
                seen[k] = value
                mean += value
            if is_inside:
                mean /= size
                for k in range(size):
                    total += abs(seen[k] - mean - own[k])
                if total < least:
                    best, least = count, total
            costs[count], places[count] = total if is_inside else np.inf, at
            count += 1
            at += 1.0 / speed
        if best < 0:
            continue
        if least > most_error * size:
            state[n] = DIFFERENT
            continue
        second = np.inf
        for i in range(count):
            if abs(i - best) >= _APART:
                second = min(second, costs[i])
        if least > ratio * second or second - least < least_sigma * size:
            state[n] = AMBIGUOUS
            continue
        at, squares, gradient = places[best], 0.0, 0.0
        for _ in range(_REFINEMENTS):
            z = az + at * tz
            u, v, p00, p01, p02, p10, p11, p12 = project_point(
                ax + at * tx, ay + at * ty, z, fx, fy, cx, cy, k1, k2, p1, p2, k3
            )  # fmt: skip
            along_u, along_v = p00 * tx + p01 * ty + p02 * tz, p10 * tx + p11 * ty + p12 * tz
            mean, mean_slope = 0.0, 0.0
            is_good = True
            for k in range(size):
                found, value, gu, gv = sample_bilinear(image, u + du[k], v + dv[k])
                if not found:
                    is_good = False
                    break
                seen[k], slope[k] = value, gu * along_u + gv * along_v
                mean += value
                mean_slope += slope[k]
            if not is_good:
                break
            mean, mean_slope = mean / size, mean_slope / size
            pull, gradient, squares = 0.0, 0.0, 0.0
            for k in range(size):
                e, j = seen[k] - mean - own[k], slope[k] - mean_slope
                pull += j * e
                gradient += j * j
                squares += e * e
            if not gradient > 0.0:
                is_good = False
                break
            step = -pull / gradient
            limit = 1.0 / math.sqrt(along_u * along_u + along_v * along_v)
            at += min(max(step, -limit), limit)
        if not is_good or not gradient > 0.0 or not (farthest[n] <= at <= nearest[n]):
            state[n] = NO_GRADIENT
            continue
        variance = max(squares / (size - 2), least_sigma * least_sigma) / gradient
        rho[n], sigma_rho[n], state[n] = at, math.sqrt(variance), FOUND
