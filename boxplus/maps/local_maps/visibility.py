"""Which points of a map can be seen from a viewpoint: the nearest of each direction, and what lies little behind them.

A map holds what was seen from everywhere, a scan only what nothing hides. Before a place of a map is compared with what a sensor
sees there, other rooms, other storeys and the far sides of houses are taken out by a buffer of ranges over directions. Points are
splats as wide as they lie apart, so that a near wall has no holes.

Source: the z-buffer (Catmull, A Subdivision Algorithm for Computer Display of Curved Surfaces, 1974), over spherical directions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_SIDE = np.deg2rad(2.0)  # of a cell of directions
_COLUMNS, _ROWS = 180, 90
_WIDEST = 3  # cells to either side that a near point covers
_BEHIND, _BEHIND_M = 1.25, 0.5  # a point is seen up to this factor of the nearest range, and so much farther [m]


def visible(points: NDArray[np.float32], viewpoint: ArrayLike, max_range: float, spacing: float = 0.0) -> NDArray[np.bool_]:
    """(N,) mask of the points (N, 3) that are seen from a viewpoint (3,), all in one frame [m].

    Args:
        max_range: farther points are not seen [m].
        spacing: how far apart the points of a surface lie [m].

    Example:
        >>> import numpy as np
        >>> wall_and_behind = np.array([[5.0, 0.0, 0.0], [9.0, 0.0, 0.0], [0.0, 9.0, 0.0]], np.float32)
        >>> visible(wall_and_behind, [0.0, 0.0, 0.0], 50.0).tolist()
        [True, False, True]
    """
    u, v, r = directions(points, viewpoint)
    near = r <= max_range
    nearest = nearest_ranges(u[near], v[near], r[near], spacing)
    mask = near.copy()
    mask[near] = r[near] <= _BEHIND * nearest[v[near], u[near]] + _BEHIND_M
    return mask


def directions(
    points: NDArray[np.float32], viewpoint: ArrayLike
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Column and row of the cell of directions of each point, and its range from the viewpoint (N,) [m]."""
    d = points.astype(np.float64) - np.asarray(viewpoint, dtype=np.float64)
    level = np.hypot(d[:, 0], d[:, 1])
    u = np.floor((np.arctan2(d[:, 1], d[:, 0]) + np.pi) / _SIDE).astype(np.int64) % _COLUMNS
    v = np.clip(np.floor((np.arctan2(d[:, 2], level) + 0.5 * np.pi) / _SIDE).astype(np.int64), 0, _ROWS - 1)
    return u, v, np.hypot(level, d[:, 2])


def nearest_ranges(u: NDArray[np.int64], v: NDArray[np.int64], r: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """(rows, columns) range of the nearest point of every cell of directions, infinite where there is none [m]."""
    nearest = np.full((_ROWS, _COLUMNS), np.inf)
    np.minimum.at(nearest, (v, u), r)
    for k in range(1, _WIDEST + 1):
        wide = r * _SIDE * k < spacing
        if not wide.any():
            break
        for dv in range(-k, k + 1):
            for du in range(-k, k + 1):
                if max(abs(du), abs(dv)) == k:
                    rows = np.clip(v[wide] + dv, 0, _ROWS - 1)
                    np.minimum.at(nearest, (rows, (u[wide] + du) % _COLUMNS), r[wide])
    return nearest
