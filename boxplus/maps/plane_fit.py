"""A plane through a handful of points, by principal components (docs/lidar_inertial_odometry.md, section 5)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.filtering.small_linalg import symmetric_eigen_into

COINCIDENT_M = 1e-6
COLLINEAR_RATIO = 0.05
_MOST_STEPS, _EXACT = 50, 1e-15  # of two roots that are one, each step halves the distance; of three, leaves two thirds of it


@kernel(inline=True)
def fit_plane_into(points: NDArray[np.float32], count: int, max_distance: float, plane: NDArray[np.float64]) -> bool:
    """Fit a plane to `points[:count]` (n, 3); False if they are coincident, collinear or off the plane by `max_distance`.

    `plane` (9,) receives the unit normal u, the offset uᵀq, the centroid q, the variance of the points about the plane, and
    their sum of squares across their longest extent within it.
    """
    qx, qy, qz = 0.0, 0.0, 0.0
    for i in range(count):
        qx += points[i, 0]
        qy += points[i, 1]
        qz += points[i, 2]
    share = 1.0 / count
    qx, qy, qz = qx * share, qy * share, qz * share
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(count):
        dx, dy, dz = points[i, 0] - qx, points[i, 1] - qy, points[i, 2] - qz
        xx += dx * dx
        xy += dx * dy
        xz += dx * dz
        yy += dy * dy
        yz += dy * dz
        zz += dz * dz
    # Eigenvalues of the scatter matrix: the roots of λ³ − tλ² + mλ − d. Below the smallest one the cubic bends one way only:
    # Newton's method climbs to it from 0, in three to five steps where it is small against the others, as that of a plane is.
    t, m = xx + yy + zz, xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    d = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    if t < COINCIDENT_M * COINCIDENT_M or not m >= COLLINEAR_RATIO * COLLINEAR_RATIO * t * t / 9.0:
        return False  # in one place, or of two roots that are nothing beside the largest
    smallest = 0.0
    for _ in range(_MOST_STEPS):
        left = d - ((smallest - t) * smallest + m) * smallest
        if not left > _EXACT * (d + (t * smallest + m) * smallest):
            break  # where roots are one the slope is nothing as well, and what rounding leaves would throw it anywhere
        step = left / ((3.0 * smallest - 2.0 * t) * smallest + m)
        smallest += step
        if not step > _EXACT * t:
            break
    both = t - smallest
    largest = 0.5 * (both + math.sqrt(max(both * both - 4.0 * (m - smallest * both), 0.0)))
    middle = both - largest
    if not middle >= COLLINEAR_RATIO * COLLINEAR_RATIO * largest:
        return False
    # The normal is orthogonal to the rows of M − λI: the longest of their three cross products.
    ax, ay, az = xx - smallest, yy - smallest, zz - smallest
    ux, uy, uz = xy * yz - xz * ay, xz * xy - ax * yz, ax * ay - xy * xy
    best = ux * ux + uy * uy + uz * uz
    vx, vy, vz = xy * az - xz * yz, xz * xz - ax * az, ax * yz - xy * xz
    norm = vx * vx + vy * vy + vz * vz
    if norm > best:
        ux, uy, uz, best = vx, vy, vz, norm
    vx, vy, vz = ay * az - yz * yz, yz * xz - xy * az, xy * yz - ay * xz
    norm = vx * vx + vy * vy + vz * vz
    if norm > best:
        ux, uy, uz, best = vx, vy, vz, norm
    if not best > 0.0:
        return False
    inverse = 1.0 / math.sqrt(best)
    ux, uy, uz = ux * inverse, uy * inverse, uz * inverse
    for i in range(count):
        distance = ux * (points[i, 0] - qx) + uy * (points[i, 1] - qy) + uz * (points[i, 2] - qz)
        if not abs(distance) <= max_distance:
            return False
    plane[0], plane[1], plane[2] = ux, uy, uz
    plane[3] = ux * qx + uy * qy + uz * qz
    plane[4], plane[5], plane[6] = qx, qy, qz
    plane[7] = max(smallest, 0.0) / max(count - 3, 1)
    plane[8] = middle
    return True


class Planes(NamedTuple):
    """Planes through N handfuls of points, in the points' frame."""

    middles: NDArray[np.float64]  #: (N, 3) mean of the points [m]
    normals: NDArray[np.float64]  #: (N, 3) unit
    thickness_sq: NDArray[np.float64]  #: (N,) variance of the points along the normal [m²]
    width_sq: NDArray[np.float64]  #: (N,) variance across their longest extent within the plane [m²]


def planes_through(points: NDArray[np.float64], counts: NDArray[np.int64] | None = None) -> Planes:
    """The planes through handfuls of points (N, k, 3) [m], in any frame, of each the first `counts` (N,); all when not given.

    Where the points lie on a line or in one place, the normal is any across them.

    Raises:
        InputError: a handful of none, or of more than k.

    Example:
        >>> square = np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 2.0], [1.0, 1.0, 2.0], [0.0, 1.0, 2.0]])
        >>> found = planes_through(square[None])
        >>> abs(found.normals[0]).tolist(), found.middles[0].tolist()
        ([0.0, 0.0, 1.0], [0.5, 0.5, 2.0])
    """
    n, k = points.shape[:2]
    counts = np.full(n, k) if counts is None else counts
    if n and not 1 <= counts.min() <= counts.max() <= k:
        raise InputError(f"1 to {k} points of each plane", f"{counts.min()} to {counts.max()}", "leave out those without any")
    found = Planes(np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n))
    _planes_into(np.ascontiguousarray(points), counts, *found)
    return found


@kernel
def _planes_into(
    points: NDArray[np.float64],
    counts: NDArray[np.int64],
    middles: NDArray[np.float64],
    normals: NDArray[np.float64],
    thickness_sq: NDArray[np.float64],
    width_sq: NDArray[np.float64],
) -> None:
    scatter, axes, values = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for n in range(len(points)):
        middle = middles[n]
        middle[:] = 0.0
        for j in range(counts[n]):
            for i in range(3):
                middle[i] += points[n, j, i]
        for i in range(3):
            middle[i] /= counts[n]
        scatter[:] = 0.0
        for j in range(counts[n]):
            for i in range(3):
                for m in range(i + 1):
                    scatter[i, m] += (points[n, j, i] - middle[i]) * (points[n, j, m] - middle[m])
        for i in range(3):
            for m in range(i + 1):
                scatter[i, m] /= counts[n]
                scatter[m, i] = scatter[i, m]
        symmetric_eigen_into(scatter, values, axes)
        thickness_sq[n], width_sq[n] = max(values[0], 0.0), max(values[1], 0.0)
        for i in range(3):
            normals[n, i] = axes[i, 0]
