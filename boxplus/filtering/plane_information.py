"""Point-to-plane residuals of a scan and the information they carry about the state.

Derivation: docs/lidar_inertial_odometry.md, sections 5 and 6.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.nav_state import PL, RL, P, R
from boxplus.filtering.triples import Triple, cross, dot, placed, rotation_of, triple_of, turned_back

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


@kernel(inline=True, fastmath=True)
def _add_square(sums: NDArray[np.float64], w: float, a: Triple, c: Triple, z: float) -> None:
    """Add w h [h, z], h = [a, c], row by row from the diagonal on: 27 numbers, each with a place that is known when compiled."""
    a0, a1, a2, c0, c1, c2 = a[0], a[1], a[2], c[0], c[1], c[2]
    w0, w1, w2, w3, w4, w5 = w * a0, w * a1, w * a2, w * c0, w * c1, w * c2
    sums[0] += w0 * a0
    sums[1] += w0 * a1
    sums[2] += w0 * a2
    sums[3] += w0 * c0
    sums[4] += w0 * c1
    sums[5] += w0 * c2
    sums[6] += w0 * z
    sums[7] += w1 * a1
    sums[8] += w1 * a2
    sums[9] += w1 * c0
    sums[10] += w1 * c1
    sums[11] += w1 * c2
    sums[12] += w1 * z
    sums[13] += w2 * a2
    sums[14] += w2 * c0
    sums[15] += w2 * c1
    sums[16] += w2 * c2
    sums[17] += w2 * z
    sums[18] += w3 * c0
    sums[19] += w3 * c1
    sums[20] += w3 * c2
    sums[21] += w3 * z
    sums[22] += w4 * c1
    sums[23] += w4 * c2
    sums[24] += w4 * z
    sums[25] += w5 * c2
    sums[26] += w5 * z


@kernel(inline=True, fastmath=True)
def _add_product(sums: NDArray[np.float64], w: float, left: Triple, right: Triple) -> None:
    """`sums` (9,), row by row, += w left rightᵀ."""
    for i in range(3):
        weighted = w * left[i]
        sums[3 * i] += weighted * right[0]
        sums[3 * i + 1] += weighted * right[1]
        sums[3 * i + 2] += weighted * right[2]


@kernel(inline=True, fastmath=True)
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
    # As far as a compiler knows, what is stored may be what is loaded: the state is read once, the sums are written at the end.
    rotation, mounting, place, lever = rotation_of(x, R), rotation_of(x, RL), triple_of(x, P), triple_of(x, PL)
    of_pose, of_noise, of_mounting, crossed, pulled = np.zeros(27), np.zeros(27), np.zeros(27), np.zeros((4, 9)), np.zeros(6)
    used, squares = 0.0, 0.0
    for n in range(p_lidar.shape[0]):
        if fate[n] != USED and fate[n] != GATED:
            continue
        plane = planes[n]
        u, g, k, p = triple_of(plane, 0), triple_of(plane, 5), triple_of(plane, 9), triple_of(p_lidar[n], 0)
        s = placed(mounting, lever, p)
        y = placed(rotation, place, s)
        z = dot(u, y) - plane[3]
        if not (81.0 * z * z) ** 2 < dot(p, p):  # 81 z² < ‖ℓ‖
            fate[n] = GATED
            continue
        fate[n] = USED
        t0, t1 = dot(g, y) - plane[8], dot(k, y) - plane[12]
        # The misfit of the plane's own points says how far to trust it; the Cauchy weight, how far to trust the point.
        spread_sq = t0 * t0 + t1 * t1
        variance = range_variance + 0.2 * map_variance + _TILT_VARIANCE * spread_sq + plane[4] * (MISFITS + spread_sq)
        gg, kk = dot(g, g), dot(k, k)
        weight = 1.0 / ((variance + z * z) * (1.0 + plane[13] * (gg + kk) / _SURE_TILT))
        plane[14] = weight
        C = turned_back(rotation, u)
        turn = cross(s, C)
        _add_square(of_pose, weight, turn, u, z)
        if with_extrinsic:
            turn_on_it = cross(p, turned_back(mounting, C))
            _add_square(of_mounting, weight, turn_on_it, C, z)
            _add_product(crossed[0], weight, turn, turn_on_it)
            _add_product(crossed[1], weight, turn, C)
            _add_product(crossed[2], weight, u, turn_on_it)
            _add_product(crossed[3], weight, u, C)
        if with_criterion:
            # Cov(u) = m² (ggᵀ + kkᵀ) with the variance m² that counts for the normal (column 13 of the record): as large as the
            # noise really is, whatever the settings say. It is linear in the noise; a unit vector tilts by a radian at most.
            for v, vv, beside in ((g, gg, t0), (k, kk, t1)):
                factor = weight * plane[13] / (1.0 + plane[13] * vv)
                C = turned_back(rotation, v)
                turn = cross(s, C)
                _add_square(of_noise, factor, turn, v, beside)
                if with_extrinsic:
                    turn_on_it = cross(p, turned_back(mounting, C))
                    for i in range(3):
                        pulled[i] += factor * beside * turn_on_it[i]
                        pulled[3 + i] += factor * beside * C[i]
        used += 1.0
        squares += z * z
    sums[0] += used
    sums[1] += squares
    _unpack(of_pose, A[:6, :6], b[:6])
    if with_extrinsic:
        _unpack(of_mounting, A[6:, 6:], b[6:])
        for i in range(3):
            for j in range(3):
                for block in range(4):
                    A[3 * (block // 2) + i, 6 + 3 * (block % 2) + j] += crossed[block, 3 * i + j]
    if with_criterion:
        _unpack(of_noise, noise, pull[:6])
        for i in range(6):
            pull[6 + i] += pulled[i]
    _mirror(A)
    if with_criterion:
        _mirror(noise)


@kernel
def _unpack(sums: NDArray[np.float64], square: NDArray[np.float64], vector: NDArray[np.float64]) -> None:
    """What `_add_square` has added up, to the upper triangle of `square` (6, 6) and to `vector` (6,)."""
    k = 0
    for i in range(6):
        for j in range(i, 6):
            square[i, j] += sums[k]
            k += 1
        vector[i] += sums[k]
        k += 1


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


@kernel
def shared_information(
    x: NDArray[np.float64],
    p_lidar: NDArray[np.float32],
    planes: NDArray[np.float64],
    fate: NDArray[np.uint8],
    counts: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """(2, 6, 6): the information of planes about the pose, and what of it rests on those of their points that count.

    Args:
        x: (36,) state; p_lidar: (n, 3) deskewed points, LiDAR frame.
        planes: (n, PLANE) with the weights of `accumulate_planes`; fate: (n,), USED where a point took part.
        counts: (n, k), of each of the points a plane was laid through.
    """
    rotation, mounting, lever = rotation_of(x, R), rotation_of(x, RL), triple_of(x, PL)
    A, h = np.zeros((2, 6, 6)), np.empty(6)
    for n in range(p_lidar.shape[0]):
        if fate[n] != USED:
            continue
        s, u = placed(mounting, lever, triple_of(p_lidar[n], 0)), triple_of(planes[n], 0)
        turn, share = cross(s, turned_back(rotation, u)), counts[n].sum() / counts.shape[1]
        h[0], h[1], h[2], h[3], h[4], h[5] = turn[0], turn[1], turn[2], u[0], u[1], u[2]
        for i in range(6):
            for j in range(6):
                said = planes[n, 14] * h[i] * h[j]
                A[0, i, j] += said
                A[1, i, j] += share * said
    return A
