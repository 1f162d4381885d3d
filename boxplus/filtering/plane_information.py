"""Point-to-plane residuals of a scan and the information they carry about the state.

Derivation: docs/lidar_inertial_odometry.md, sections 5 and 6.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.nav_state import PL, RL, P, R

# What became of a point.
USED, FEW_NEIGHBOURS, NOT_A_PLANE, GATED, ONE_LINE, UNCONFIRMED = 0, 1, 2, 3, 4, 5
MEASURED_DOF = 12
# Variance of a map point as far as the tilt of a plane goes [m²]: five points of one or two scan lines are not independent,
# and what they say beside these lines is worth less than their noise suggests.
_TILT_VARIANCE = 0.1**2
# Variance of a plane's normal [rad²] beyond which the plane counts less and less: its points lie on little more than a line,
# and a normal that noise has chosen holds the sensor where it first saw that line.
_SURE_TILT = 0.1**2
# How often the variance of a plane's five points counts: once for the point itself, and by a fifth for their mean.
MISFITS = 1.2


@kernel(inline=True)
def pose_row(
    x: NDArray[np.float64],
    lidar: tuple[float, float, float],
    imu: tuple[float, float, float],
    u: tuple[float, float, float],
    with_extrinsic: bool,
    h: NDArray[np.float64],
) -> None:
    """h = [s × C, u, ℓ × R_LᵀC, C] with C = Rᵀu: how uᵀ y moves with the state (docs/lidar_inertial_odometry.md, section 6)."""
    lx, ly, lz = lidar
    sx, sy, sz = imu
    ux, uy, uz = u
    cx = x[R] * ux + x[R + 3] * uy + x[R + 6] * uz
    cy = x[R + 1] * ux + x[R + 4] * uy + x[R + 7] * uz
    cz = x[R + 2] * ux + x[R + 5] * uy + x[R + 8] * uz
    h[0], h[1], h[2] = sy * cz - sz * cy, sz * cx - sx * cz, sx * cy - sy * cx
    h[3], h[4], h[5] = ux, uy, uz
    if with_extrinsic:
        ex = x[RL] * cx + x[RL + 3] * cy + x[RL + 6] * cz
        ey = x[RL + 1] * cx + x[RL + 4] * cy + x[RL + 7] * cz
        ez = x[RL + 2] * cx + x[RL + 5] * cy + x[RL + 8] * cz
        h[6], h[7], h[8] = ly * ez - lz * ey, lz * ex - lx * ez, lx * ey - ly * ex
        h[9], h[10], h[11] = cx, cy, cz


@kernel(inline=True)
def _add_noise(
    x: NDArray[np.float64],
    lidar: tuple[float, float, float],
    imu: tuple[float, float, float],
    plane: NDArray[np.float64],
    beside: tuple[float, float],
    weight: float,
    with_extrinsic: bool,
    row: NDArray[np.float64],
    pull: NDArray[np.float64],
    noise: NDArray[np.float64],
) -> None:
    """pull += w M Cov(u) (y − q) of one plane, noise += w M Cov(u) Mᵀ, with h = M u (`pose_row`).

    Cov(u) = m² (g₁g₁ᵀ + g₂g₂ᵀ) with the variance m² that counts for the normal (column 13 of the record): as large as the noise
    really is, whatever the settings say. It is linear in the noise; a unit vector cannot tilt further than by a radian.

    Args:
        beside: gᵢᵀ (y − q), where the point lies beside the middle of the plane's own points.
    """
    size = MEASURED_DOF if with_extrinsic else 6
    for k in range(2):
        first = 5 + 4 * k
        gx, gy, gz = plane[first], plane[first + 1], plane[first + 2]
        factor = weight * plane[13] / (1.0 + plane[13] * (gx * gx + gy * gy + gz * gz))
        pose_row(x, lidar, imu, (gx, gy, gz), with_extrinsic, row)
        pulled = factor * beside[k]
        for i in range(size):
            pull[i] += pulled * row[i]
        for i in range(6):
            wh = factor * row[i]
            for j in range(i, 6):
                noise[i, j] += wh * row[j]


@kernel
def accumulate_planes(
    x: NDArray[np.float64],
    p_lidar: NDArray[np.float32],
    planes: NDArray[np.float64],
    fate: NDArray[np.uint8],
    range_variance: float,
    map_variance: float,
    with_extrinsic: bool,
    with_criterion: bool,
    A: NDArray[np.float64],
    b: NDArray[np.float64],
    pull: NDArray[np.float64],
    noise: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None:
    """Add a scan to A = Hᵀ R⁻¹ H and b = Hᵀ R⁻¹ z over [θ, p, θ_L, p_L], and to what tells weak directions of the pose.

    A normal that is off by ε sees a point that lies beside the middle of its plane off it by εᵀ (y − q), and the row has the
    same ε: their product does not even out. What is to be expected of it in b is `pull` (corrected score: Nakamura, 1990).

    Args:
        x: (36,) state; p_lidar: (n, 3) deskewed points, LiDAR frame.
        planes: (n, PLANE) records of `maps.plane_matching`, columns named there; the weights are written to the last one.
        fate: (n,), USED where a plane was found; the gate |z| < √‖ℓ‖ / 9 turns USED into GATED and back.
        range_variance, map_variance: of a point and of a map point, along the normal [m²].
        with_extrinsic: whether the six columns of the extrinsic are measured.
        A, b: (12, 12), (12,), added to.
        pull: (12,), added to: what noise of the normals is expected to make of b.
        with_criterion: whether `pull` and `noise` are wanted.
        noise: (6, 6), added to: what Cov(u) of these planes alone would give of A about the pose.
        sums: (2,) += [used points, Σ z²].
    """
    h = np.empty(MEASURED_DOF)
    row = np.empty(MEASURED_DOF)
    size = MEASURED_DOF if with_extrinsic else 6
    for n in range(p_lidar.shape[0]):
        if fate[n] != USED and fate[n] != GATED:
            continue
        plane = planes[n]
        lx, ly, lz = np.float64(p_lidar[n, 0]), np.float64(p_lidar[n, 1]), np.float64(p_lidar[n, 2])
        sx = x[RL] * lx + x[RL + 1] * ly + x[RL + 2] * lz + x[PL]
        sy = x[RL + 3] * lx + x[RL + 4] * ly + x[RL + 5] * lz + x[PL + 1]
        sz = x[RL + 6] * lx + x[RL + 7] * ly + x[RL + 8] * lz + x[PL + 2]
        yx = x[R] * sx + x[R + 1] * sy + x[R + 2] * sz + x[P]
        yy = x[R + 3] * sx + x[R + 4] * sy + x[R + 5] * sz + x[P + 1]
        yz = x[R + 6] * sx + x[R + 7] * sy + x[R + 8] * sz + x[P + 2]
        z = plane[0] * yx + plane[1] * yy + plane[2] * yz - plane[3]
        if not 81.0 * z * z < math.sqrt(lx * lx + ly * ly + lz * lz):
            fate[n] = GATED
            continue
        fate[n] = USED
        t0 = plane[5] * yx + plane[6] * yy + plane[7] * yz - plane[8]
        t1 = plane[9] * yx + plane[10] * yy + plane[11] * yz - plane[12]
        # The misfit of the plane's own points says how far to trust it; the Cauchy weight, how far to trust the point.
        spread_sq = t0 * t0 + t1 * t1
        variance = range_variance + 0.2 * map_variance + _TILT_VARIANCE * spread_sq + plane[4] * (MISFITS + spread_sq)
        weight = 1.0 / (variance + z * z)
        tilt = 0.0
        for first in (5, 9):
            tilt += plane[first] * plane[first] + plane[first + 1] * plane[first + 1] + plane[first + 2] * plane[first + 2]
        weight /= 1.0 + plane[13] * tilt / _SURE_TILT
        plane[14] = weight
        pose_row(x, (lx, ly, lz), (sx, sy, sz), (plane[0], plane[1], plane[2]), with_extrinsic, h)
        for i in range(size):
            wh = weight * h[i]
            b[i] += wh * z
            for j in range(i, size):
                A[i, j] += wh * h[j]
        if with_criterion:
            _add_noise(x, (lx, ly, lz), (sx, sy, sz), plane, (t0, t1), weight, with_extrinsic, row, pull, noise)
        sums[0] += 1.0
        sums[1] += z * z
    _mirror(A)
    if with_criterion:
        _mirror(noise)


@kernel
def accumulate_parts(
    x: NDArray[np.float64],
    p_lidar: NDArray[np.float32],
    planes: NDArray[np.float64],
    fate: NDArray[np.uint8],
    bounds: NDArray[np.int64],
    range_variance: float,
    map_variance: float,
    with_extrinsic: bool,
    with_criterion: bool,
    A: NDArray[np.float64],
    b: NDArray[np.float64],
    pull: NDArray[np.float64],
    noise: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None:
    """`accumulate_planes` part by part: A (m, 12, 12) and b (m, 12) are those of each, everything else that of all together.

    Args:
        bounds: (m + 1,) the first point of each part, and the end of the last.
    """
    for part in range(bounds.shape[0] - 1):
        begin, end = bounds[part], bounds[part + 1]
        accumulate_planes(
            x, p_lidar[begin:end], planes[begin:end], fate[begin:end], range_variance, map_variance, with_extrinsic,
            with_criterion, A[part], b[part], pull, noise, sums,
        )  # fmt: skip


@kernel(inline=True)
def _mirror(A: NDArray[np.float64]) -> None:
    """The lower triangle from the upper one."""
    for i in range(A.shape[0]):
        for j in range(i):
            A[i, j] = A[j, i]
