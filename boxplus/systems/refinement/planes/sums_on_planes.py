"""What the points of scans come to on planes.

Points are gone through once for each question, many scans at a time, and none is kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel, run_chunks
from boxplus.manifolds import quaternion
from boxplus.maps.plane_voxels.plane_map import PlaneMap

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Points = NDArray[np.float32]

_JUDGED = 5  # of so many points one takes no part and judges the result
_AT_ONCE = 64  # scans that a thread goes through in one call
_WINDOW = 16  # such calls whose results are held at once


@dataclass(frozen=True, slots=True, eq=False)
class Sighted:
    """What some scans see of planes.

    Attributes:
        scan: (k,) ascending, plane: (k,) numbers.
        clusters: (k, 4, 4) Σ [ℓ; 1][ℓ; 1]ᵀ of the points of the one on the other, in the LiDAR's frame then.
    """

    scan: Ints
    plane: Ints
    clusters: Floats


def sighted(
    points: Sequence[Points],
    T_lidar: Floats,
    planes: PlaneMap,
    threads: int = 1,
    begins: Ints | None = None,
    *,
    judge: bool = False,
) -> Iterator[Sighted]:
    """What scans see of planes, some scans at a time, in their order.

    Args:
        points: of each scan (n, 3), in the LiDAR's frame. T_lidar: (N, 7) where it was.
        threads: that share the work; the result does not depend on it.
        begins: ascending scans, 0 the first of them, before which a piece may begin; None for all.
        judge: of the points that take no part, instead of those that do.
    """
    count = len(points)
    allowed = np.arange(count) if begins is None else begins
    bounds = [0]
    while bounds[-1] < count:
        later = int(np.searchsorted(allowed, bounds[-1] + _AT_ONCE))
        bounds.append(int(allowed[later]) if later < len(allowed) else count)
    R = quaternion.to_matrix(T_lidar[:, :4])
    pieces = list(pairwise(bounds))
    for first in range(0, len(pieces), _WINDOW):
        window = pieces[first : first + _WINDOW]
        found: dict[int, Sighted] = {}

        def look(
            number: int, _begin: int, _end: int, window: list[tuple[int, int]] = window, found: dict[int, Sighted] = found
        ) -> None:
            begin, end = window[number]
            own = [points_that(points[k], judge=judge) for k in range(begin, end)]
            places = np.concatenate([[0], np.cumsum([len(one) for one in own])])
            scan, plane, clusters = planes.clusters_of_scans(
                np.concatenate(own), places, R[begin:end], np.ascontiguousarray(T_lidar[begin:end, 4:])
            )
            found[number] = Sighted(begin + scan, plane, clusters)

        run_chunks(look, len(window), 1, threads)
        yield from (found.pop(number) for number in range(len(window)))


def points_that(points: Points, *, judge: bool) -> Points:
    """Those of a scan (n, 3) that judge the result, or those that take part in finding it."""
    chosen = (np.arange(len(points)) % _JUDGED == 0) == judge
    return np.ascontiguousarray(points[chosen])


def moved_clusters(clusters: Floats, R: Floats, p: Floats) -> Floats:
    """Σ [x; 1][x; 1]ᵀ (k, 4, 4) of points moved to R x + p, by R (k, 3, 3) and p (k, 3)."""
    moved = np.empty_like(clusters)
    _move(clusters, R, p, moved)
    return moved


@kernel
def _move(clusters: Floats, R: Floats, p: Floats, moved: Floats) -> None:
    half = np.empty((4, 4))  # T C
    for k in range(clusters.shape[0]):
        C, T, t, to = clusters[k], R[k], p[k], moved[k]
        for j in range(4):
            for i in range(3):
                half[i, j] = T[i, 0] * C[0, j] + T[i, 1] * C[1, j] + T[i, 2] * C[2, j] + t[i] * C[3, j]
            half[3, j] = C[3, j]
        for i in range(4):
            for j in range(3):
                to[i, j] = half[i, 0] * T[j, 0] + half[i, 1] * T[j, 1] + half[i, 2] * T[j, 2] + half[i, 3] * t[j]
            to[i, 3] = half[i, 3]


@kernel
def add_weighed(of: Ints, clusters: Floats, weights: Floats, total: Floats, squares: Floats) -> None:
    """Σ w C to total[of], and Σ w² n to squares[of], of clusters C of n points (k, 4, 4) with weights w (k,)."""
    for k in range(of.shape[0]):
        w, C, to = weights[k], clusters[k], total[of[k]]
        for i in range(4):
            for j in range(4):
                to[i, j] += w * C[i, j]
        squares[of[k]] += w * w * C[3, 3]


@kernel
def add_to_sides(
    side: Ints,
    plane: Ints,
    keyframe: Ints,
    clusters: Floats,
    facing: Floats,
    world: Floats,
    facing_sum: Floats,
    latest: Ints,
    seen_by: Floats,
) -> None:
    """To planes as they are seen from either side, (2, P, …): clusters (k, 4, 4), and `facing` (k,) of each of their points.

    Args:
        keyframe: (k,) that saw them, ascending. latest: (2, P) the keyframe that saw a plane last; seen_by: how many have.
    """
    for k in range(plane.shape[0]):
        s, q, C = side[k], plane[k], clusters[k]
        to = world[s, q]
        for i in range(4):
            for j in range(4):
                to[i, j] += C[i, j]
        facing_sum[s, q] += C[3, 3] * facing[k]
        if latest[s, q] != keyframe[k]:
            latest[s, q] = keyframe[k]
            seen_by[s, q] += 1.0
