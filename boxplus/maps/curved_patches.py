"""Where five points are no plane, a patch that bends through fifteen: the tangent at the point takes the plane's place.

Trunks, columns and pipes are about as thick as a cell of the map is wide. A plane through five points of one is a chord, which
lies inside the surface by a good part of its misfit, and points of the next scan lie before it. A LiDAR that looks one way sees
only one side of all of them, so that every scan is pushed the same way, by centimetres, and none contradicts another. Of such
a LiDAR planes are bent where the map is sparser, too.

A height over the plane of the five is laid through the fifteen nearest map points,

    η(e, f) = a + b e + c f + ½ (d e² + 2 g e f + k f²),    variance of a point  σ² exp(r²/s²),    d, √2 g, k ~ N(0, 1/s²)

with e and f from the point itself: least squares that trust what is near (Cleveland, JASA 1979; Levin, Math. Comp. 1998), with
surfaces taken to bend by radii of about a cell, s, or wider. Where the map is sparser, points count from farther away, and s of
the variance grows, that of the curvature does not. What it leaves, and how well it is determined, say how far to believe it; it
counts where it fits the fifteen better than the plane its five.

Source: docs/lidar_inertial_odometry.md, section 5.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.nav_state import PL, RL, P, R
from boxplus.filtering.plane_information import MISFITS, USED
from boxplus.filtering.small_linalg import cholesky_inverse_into
from boxplus.filtering.triples import placed, rotation_of, triple_of
from boxplus.maps.ikd_tree.search import IkdView, copy_found, knn
from boxplus.maps.plane_confirmation import leverage_of
from boxplus.maps.plane_matching import WEIGHT

PATCH = 15
_TERMS = 6
MEAN_LEVERAGE = 0.3  # times the mean: planes on which less hangs stay as they are
# On a surface whose cells are all filled, the 15th neighbour of a point lies 2.2 cells away. Farther apart are the lines of
# scans, between which nothing is known of a curvature.
FILLED_CELLS = 2.5
# A LiDAR that sees one way: the mean of the unit vectors towards its points is longer than that over a cone of 133 degrees. Its
# chords do not even out, and its points lie scattered: where as little as a third of the cells is filled, patches are still
# nearer to the surface than chords.
ONE_WAY = 0.7
SPARSE_CELLS = 4.0


@kernel
def bend_planes(
    view: IkdView,
    origin: NDArray[np.float64],
    x: NDArray[np.float64],
    p_lidar: NDArray[np.float32],
    covariance: NDArray[np.float64],
    least_leverage: float,
    max_distance_sq: float,
    reach: float,
    map_variance: float,
    planes: NDArray[np.float64],
    fate: NDArray[np.uint8],
    which: NDArray[np.int64],
    bent: NDArray[np.float64],
    found_sq: NDArray[np.float32],
    stack: NDArray[np.void],
) -> int:
    """Lay patches where planes of some leverage fit their points worse than noise explains; returns how many there are.

    Args:
        view, origin: the map; its coordinates are relative to `origin` (3,).
        x: (36,) state at which the planes were weighed.
        p_lidar: (n, 3) deskewed points, LiDAR frame.
        covariance: (6, 6) of the pose [θ, p] from all planes.
        least_leverage: of a plane that is looked at.
        max_distance_sq: squared distance within which neighbours are looked for [m²].
        reach: s, where points count less, and the radius that surfaces bend by [m]. Where the last of the fifteen is farther away
            than on a filled map, points count as much farther.
        map_variance: of a map point along the normal, as the settings have it [m²].
        planes: (n, PLANE) records of `plane_matching`, with their weights; fate: (n,). Both stay as they are.
        which: (n,) receives the planes that are to be replaced, bent: (n, PLANE) what by.
        found_sq: (PATCH,), stack: (STACK_DEPTH + PATCH,), scratch.
    """
    near = np.empty((PATCH, 3), dtype=np.float32)
    rotation, mounting, place, lever = rotation_of(x, R), rotation_of(x, RL), triple_of(x, P), triple_of(x, PL)
    y = np.empty(3)
    heights, rows = np.empty((PATCH, 2)), np.empty((PATCH, _TERMS))
    square, sums = np.empty((3, _TERMS, _TERMS)), np.empty((2, _TERMS))
    count = 0
    for n in range(len(fate)):
        if fate[n] != USED or not planes[n, 4] > map_variance:
            continue
        s = placed(mounting, lever, triple_of(p_lidar[n], 0))
        if not leverage_of(planes[n, WEIGHT], s, triple_of(planes[n], 0), rotation, covariance) > least_leverage:
            continue
        p_world = placed(rotation, place, s)
        y[0], y[1], y[2] = p_world[0] - origin[0], p_world[1] - origin[1], p_world[2] - origin[2]
        found = knn(view, np.float32(y[0]), np.float32(y[1]), np.float32(y[2]), np.float32(max_distance_sq), found_sq, stack)
        if found < PATCH:
            continue
        copy_found(view, stack, PATCH, PATCH, near)
        wider = max(1.0, math.sqrt(np.float64(found_sq[PATCH - 1])) / (FILLED_CELLS * reach))
        if _fit_patch(near, y, planes[n], reach, wider * reach, map_variance, heights, rows, square, sums, bent[count]):
            for offset, g in ((3, 0), (8, 5), (12, 9)):
                for i in range(3):
                    bent[count, offset] += bent[count, g + i] * origin[i]
            which[count] = n
            count += 1
    return count


@kernel
def _fit_patch(
    near: NDArray[np.float32],
    y: NDArray[np.float64],
    plane: NDArray[np.float64],
    radius: float,
    reach: float,
    map_variance: float,
    heights: NDArray[np.float64],
    rows: NDArray[np.float64],
    square: NDArray[np.float64],
    sums: NDArray[np.float64],
    bent: NDArray[np.float64],
) -> bool:
    """The record of the patch's tangent at y (3,), relative to the same origin as `near`; False where the plane fits as well.

    Scratch: `heights` (PATCH, 2) with the weights beside them, `rows` (PATCH, 6), `square` (3, 6, 6), `sums` (2, 6).
    """
    ux, uy, uz = plane[0], plane[1], plane[2]
    if abs(ux) < 0.6:
        norm = 1.0 / math.sqrt(uy * uy + uz * uz)
        ex, ey, ez = 0.0, uz * norm, -uy * norm
    else:
        norm = 1.0 / math.sqrt(ux * ux + uz * uz)
        ex, ey, ez = -uz * norm, 0.0, ux * norm
    fx, fy, fz = uy * ez - uz * ey, uz * ex - ux * ez, ux * ey - uy * ex
    A, inverse, right, solution = square[0], square[1], sums[0], sums[1]
    A[:], right[:], solution[:] = 0.0, 0.0, 0.0
    for j in range(PATCH):
        dx, dy, dz = near[j, 0] - y[0], near[j, 1] - y[1], near[j, 2] - y[2]
        e = dx * ex + dy * ey + dz * ez
        f = dx * fx + dy * fy + dz * fz
        height, weight = dx * ux + dy * uy + dz * uz, math.exp(-(dx * dx + dy * dy + dz * dz) / (reach * reach))
        heights[j, 0], heights[j, 1] = height, weight
        row = rows[j]
        row[0], row[1], row[2], row[3], row[4], row[5] = 1.0, e, f, 0.5 * e * e, e * f, 0.5 * f * f
        for i in range(_TERMS):
            weighted = weight * row[i]
            right[i] += weighted * height
            for k in range(i + 1):
                A[i, k] += weighted * row[k]
    prior = map_variance * radius * radius
    A[3, 3] += prior
    A[4, 4] += 2.0 * prior  # then it does not matter which way e and f lie
    A[5, 5] += prior
    if not cholesky_inverse_into(A, inverse, square[2]):
        return False
    for i in range(_TERMS):
        for k in range(_TERMS):
            solution[i] += inverse[i, k] * right[k]
    squares, total = 0.0, 0.0
    for j in range(PATCH):
        off = heights[j, 0]
        for i in range(_TERMS):
            off -= solution[i] * rows[j, i]
        squares += heights[j, 1] * off * off
        total += heights[j, 1]
    variance = squares / total * (PATCH / (PATCH - _TERMS))
    if not variance < plane[4]:
        return False
    a, b, c = solution[0], solution[1], solution[2]
    inverse_norm = 1.0 / math.sqrt(1.0 + b * b + c * c)
    bent[0] = (ux - b * ex - c * fx) * inverse_norm
    bent[1] = (uy - b * ey - c * fy) * inverse_norm
    bent[2] = (uz - b * ez - c * fz) * inverse_norm
    bent[3] = bent[0] * y[0] + bent[1] * y[1] + bent[2] * y[2] + a * inverse_norm
    # What accumulate_planes makes of it: MISFITS times this, and nothing for the tilt (the tangent is taken at the point).
    bent[4] = variance * (1.0 + inverse[0, 0]) / MISFITS
    # Cov(b, c) = σ² C: its Cholesky factor, along e and f.
    first = math.sqrt(inverse[1, 1])
    mixed = inverse[2, 1] / first
    second = math.sqrt(max(inverse[2, 2] - mixed * mixed, 0.0))
    bent[5], bent[6], bent[7] = first * ex + mixed * fx, first * ey + mixed * fy, first * ez + mixed * fz
    bent[9], bent[10], bent[11] = second * fx, second * fy, second * fz
    bent[8] = bent[5] * y[0] + bent[6] * y[1] + bent[7] * y[2]
    bent[12] = bent[9] * y[0] + bent[10] * y[1] + bent[11] * y[2]
    bent[13] = variance
    return True
