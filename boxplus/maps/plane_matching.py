"""Find the plane of the map that each point of a scan lies on (docs/lidar_inertial_odometry.md, section 5)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.nav_state import PL, RL, P, R
from boxplus.filtering.plane_information import FEW_NEIGHBOURS, NOT_A_PLANE, ONE_LINE, USED
from boxplus.filtering.triples import Triple, cross, dot, placed, product, rotation_of, triple_of, turned
from boxplus.maps.ikd_tree.search import IkdView, copy_found, knn, knn5
from boxplus.maps.plane_fit import fit_plane_into

NEIGHBOURS = 5
# A matched plane: unit normal u (0 to 2), offset uᵀq in the world (3), variance of its points about it (4), and twice a
# vector g with its offset gᵀq (5 to 8, 9 to 12): the uncertainty of the normal, see `_normal_uncertainty`; and the variance of
# a point that counts for that uncertainty (13), here the plane's own; the weight that it was given last (WEIGHT).
WEIGHT = 14
PLANE = 15
# Where one ring of the LiDAR alone has seen a surface, the five points lie on a line, and range noise makes them span the
# plane of the beams: it would tie the sensor to its own scan pattern. Far away, where such a plane has the longest lever and
# the rings lie far apart, the neighbours must spread across their longest extent by this variance [m²].
_MIN_SPREAD = 0.02
_FAR = 15.0  # m
# Where such a line turns a corner its points do spread, still within the plane of the beams. No beam comes back from a surface
# it lies in: the sine of the angle between a point's ray and its plane must exceed this, and so many of its standard deviations.
_GRAZING = 0.04
_DEVIATIONS = 2.0
# Five points of one line say nothing across it; among so many neighbours are points of the next line.
MANY = 15
# Degrees of freedom that what a scan's neighbourhoods are like counts for; the five points of a plane leave two.
_PRIOR_DOF, _OWN_DOF = 1.0, 2.0
# A bound computed from rounded coordinates is widened by this, so that a warm start never loses a neighbour.
_SLACK = 1.0 + 1e-5


@kernel
def match_planes(
    view: IkdView,
    origin: NDArray[np.float64],
    x: NDArray[np.float64],
    p_lidar: NDArray[np.float32],
    begin: int,
    end: int,
    max_distance_sq: float,
    plane_threshold: float,
    warm: bool,
    neighbours: NDArray[np.float32],
    reach: NDArray[np.float32],
    planes: NDArray[np.float64],
    fate: NDArray[np.uint8],
    found_sq: NDArray[np.float32],
    stack: NDArray[np.void],
) -> None:
    """Match the points [begin, end): five nearest map points, then the plane through them, or, where they lie on a line, fifteen.

    Args:
        view, origin: the map; its coordinates are relative to `origin` (3,).
        x: (36,) state that places the points in the world.
        p_lidar: (n, 3) deskewed points, LiDAR frame.
        max_distance_sq: squared distance the fifth neighbour may have [m²].
        plane_threshold: largest distance of a neighbour from the plane [m].
        warm: `neighbours` and `reach` hold the result of an earlier call on the same map: their distances bound the search.
        neighbours: (n, 5, 3), relative to `origin`.
        reach: (n, 4) receives where a point was that has needed fifteen, and how far the last of them; 0 where five were enough.
        planes: (n, PLANE) receives the planes.
        fate: (n,) receives USED, FEW_NEIGHBOURS, NOT_A_PLANE or ONE_LINE.
        found_sq: (NEIGHBOURS,), stack: (STACK_DEPTH + MANY,), scratch of the calling thread.
    """
    fit = np.empty(9)
    many = np.empty((MANY, 3), dtype=np.float32)
    many_sq = np.empty(MANY, dtype=np.float32)
    rotation = rotation_of(x, R)
    R_world_lidar, p_world_lidar = product(rotation, rotation_of(x, RL)), placed(rotation, triple_of(x, P), triple_of(x, PL))
    p_map_lidar = p_world_lidar[0] - origin[0], p_world_lidar[1] - origin[1], p_world_lidar[2] - origin[2]
    for n in range(begin, end):
        ray = turned(R_world_lidar, triple_of(p_lidar[n], 0))
        y = ray[0] + p_map_lidar[0], ray[1] + p_map_lidar[1], ray[2] + p_map_lidar[2]
        near = neighbours[n]
        qx, qy, qz = np.float32(y[0]), np.float32(y[1]), np.float32(y[2])  # far from the origin, rounding exceeds the slack
        # What was near at an earlier call, or near the point before, which is close by, tells what to ask for and bounds it.
        known = n if warm else n - 1
        has_known = warm or n > begin
        seen = reach[known] if has_known else reach[n]
        asked = has_known and seen[3] > 0.0  # on a line there, on one here: one search for fifteen finds five as well
        found = np.int64(0)
        if asked:
            moved = math.sqrt((seen[0] - qx) ** 2 + (seen[1] - qy) ** 2 + (seen[2] - qz) ** 2)
            bound = min(max_distance_sq, (np.float64(seen[3]) + moved) ** 2 * _SLACK)
            found = knn(view, qx, qy, qz, np.float32(bound), many_sq, stack)
            copy_found(view, stack, MANY, found, many)
            count = min(found, NEIGHBOURS)
            for i in range(count):
                near[i] = many[i]
        else:
            bound = max_distance_sq
            if has_known and fate[known] != FEW_NEIGHBOURS:
                farthest = 0.0
                for i in range(NEIGHBOURS):
                    dx, dy, dz = neighbours[known, i, 0] - qx, neighbours[known, i, 1] - qy, neighbours[known, i, 2] - qz
                    farthest = max(farthest, np.float64(dx * dx + dy * dy + dz * dz))
                bound = min(bound, farthest * _SLACK)
            count = knn5(view, qx, qy, qz, np.float32(bound), near, found_sq, stack)
        seen = reach[n]
        seen[3] = 0.0
        if count < NEIGHBOURS:
            fate[n] = FEW_NEIGHBOURS
            continue
        if not fit_plane_into(near, NEIGHBOURS, plane_threshold, fit):
            fate[n] = NOT_A_PLANE
            continue
        on_line = _lies_on_line(fit, NEIGHBOURS, ray)
        fitted = near
        if on_line:
            if not asked:
                found = knn(view, qx, qy, qz, np.float32(max_distance_sq), many_sq, stack)
                copy_found(view, stack, MANY, found, many)
            if found == MANY:
                seen[0], seen[1], seen[2], seen[3] = qx, qy, qz, np.float32(math.sqrt(many_sq[MANY - 1]))
                on_line = not fit_plane_into(many, MANY, plane_threshold, fit) or _lies_on_line(fit, MANY, ray)
                fitted = many
        if on_line:
            fate[n] = ONE_LINE
            continue
        fate[n] = USED
        plane = planes[n]
        plane[0], plane[1], plane[2] = fit[0], fit[1], fit[2]
        plane[3] = fit[3] + fit[0] * origin[0] + fit[1] * origin[1] + fit[2] * origin[2]
        plane[4] = plane[13] = fit[7]
        _normal_uncertainty(fitted, fit, plane)
        for g in (5, 9):
            plane[g + 3] = (
                plane[g] * (fit[4] + origin[0]) + plane[g + 1] * (fit[5] + origin[1]) + plane[g + 2] * (fit[6] + origin[2])
            )


@kernel(inline=True, fastmath=True)
def _lies_on_line(fit: NDArray[np.float64], count: int, ray: Triple) -> bool:
    """Whether the points of a plane are those of one scan line, given the ray (3,) from the sensor to it."""
    range_sq, along_normal = dot(ray, ray), dot(triple_of(fit, 0), ray)
    too_thin = fit[8] < _MIN_SPREAD * count * min(1.0, range_sq * range_sq / _FAR**4)
    return bool(too_thin or along_normal * along_normal < _GRAZING * _GRAZING * range_sq)


@kernel
def settle_normals(
    x: NDArray[np.float64],
    p_lidar: NDArray[np.float32],
    plane_threshold: float,
    planes: NDArray[np.float64],
    fate: NDArray[np.uint8],
) -> None:
    """Say how uncertain the normals of a scan's planes are (column 13), and refuse those that may as well contain their ray.

    Two degrees of freedom say little: where surfaces are smaller than the distance of the points, five lie on a plane by chance
    every so often, and the better they do, the more the chance would count. What is known of all the neighbourhoods, those that
    are no planes included, tells how likely that is (empirical Bayes: Efron and Morris, 1973).

    Args:
        x, p_lidar, plane_threshold: of `match_planes`, which has matched all points.
        planes: (n, PLANE); column 13 is drawn from the plane's own variance towards that of all neighbourhoods.
        fate: (n,); planes that are refused change from USED to ONE_LINE.
    """
    total, count = 0.0, 0
    for n in range(len(fate)):
        if fate[n] == USED:
            total += planes[n, 4]
            count += 1
        elif fate[n] == NOT_A_PLANE:
            total += plane_threshold * plane_threshold
            count += 1
    common = total / max(count, 1)
    R_world_lidar = product(rotation_of(x, R), rotation_of(x, RL))
    for n in range(len(fate)):
        if fate[n] != USED:
            continue
        plane = planes[n]
        plane[13] = (_OWN_DOF * plane[4] + _PRIOR_DOF * common) / (_OWN_DOF + _PRIOR_DOF)
        ray = turned(R_world_lidar, triple_of(p_lidar[n], 0))
        across, first, second = dot(triple_of(plane, 0), ray), dot(triple_of(plane, 5), ray), dot(triple_of(plane, 9), ray)
        if across * across < _DEVIATIONS * _DEVIATIONS * plane[13] * (first * first + second * second):
            fate[n] = ONE_LINE


@kernel(inline=True, fastmath=True)
def _normal_uncertainty(near: NDArray[np.float32], fit: NDArray[np.float64], plane: NDArray[np.float64]) -> None:
    """Two vectors g₁, g₂ in the plane with Cov(u) = σ² (g₁g₁ᵀ + g₂g₂ᵀ), σ² the variance of a map point.

    Their sum of outer products is the inverse of the points' scatter within the plane.
    """
    ux, uy, uz = triple_of(fit, 0)
    if abs(ux) < 0.6:
        norm = 1.0 / math.sqrt(uy * uy + uz * uz)
        e = 0.0, uz * norm, -uy * norm
    else:
        norm = 1.0 / math.sqrt(ux * ux + uz * uz)
        e = -uz * norm, 0.0, ux * norm
    f = cross((ux, uy, uz), e)
    middle = triple_of(fit, 4)
    ee, ef, ff = 0.0, 0.0, 0.0
    for i in range(len(near)):
        p = triple_of(near[i], 0)
        d = p[0] - middle[0], p[1] - middle[1], p[2] - middle[2]
        along, aside = dot(e, d), dot(f, d)
        ee += along * along
        ef += along * aside
        ff += aside * aside
    # Cholesky factor of the inverse of [[ee, ef], [ef, ff]].
    first = math.sqrt(ff / (ee * ff - ef * ef))
    mixed = -first * ef / ff
    second = 1.0 / math.sqrt(ff)
    for i in range(3):
        plane[5 + i] = first * e[i] + mixed * f[i]
        plane[9 + i] = second * f[i]
