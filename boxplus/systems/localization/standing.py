"""What stands: points on vertical runs; and whether a scan sees through it.

Ground, floors and ceilings fit everywhere and tell no place from another.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.local_maps.visibility import directions, nearest_ranges

Floats = NDArray[np.float64]
Points = NDArray[np.float32]

_COLUMN, _LEVEL = 1.0, 0.5  # m, sides of the cells of the ground, and of height
_GAP, _LEAST = 2, 2  # levels that a run may leap, and that it has to reach over
_SEEN = 0.75  # of the range that was measured; what the map has nearer than this, and by a metre, is seen through
_FEWEST_DIRECTIONS = 30


def standing(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(N,) mask of points (N, 3), z up, in a column of ground whose points reach over 1 m of height without a gap of 1 m.

    Example:
        >>> import numpy as np
        >>> wall = np.column_stack([np.full(10, 0.5), np.full(10, 0.5), np.linspace(0.1, 3.0, 10)])
        >>> floor = np.column_stack([np.linspace(5.1, 9.9, 10), np.full(10, 0.5), np.zeros(10)])
        >>> standing(np.concatenate([wall, floor]).astype(np.float32)).sum()
        np.int64(10)
    """
    if not len(points):
        return np.zeros(0, dtype=np.bool_)
    cell = np.floor(points.astype(np.float64) / (_COLUMN, _COLUMN, _LEVEL)).astype(np.int64)
    cell -= cell.min(axis=0)
    # Heights lie in the low bits, so that the sorted keys run up column after column.
    keys, of = np.unique(cell[:, 0] << 42 | cell[:, 1] << 21 | cell[:, 2], return_inverse=True)
    begins = np.r_[True, np.diff(keys) > _GAP]
    run = np.cumsum(begins) - 1
    first = keys[begins]
    last = keys[np.r_[np.flatnonzero(begins)[1:] - 1, len(keys) - 1]]
    return np.asarray((last - first >= _LEAST)[run[of.ravel()]])


def seen_through(scan: Points, map_stands: Points, viewpoint: Floats) -> float:
    """Share of the directions of a scan in which something of the map stands nearer than what was measured; NaN for too few.

    Nearer than the nearest of the direction and those beside it: at the edge of a thing some rays pass and some do not.

    Args:
        scan: (M, 3) and map_stands: (N, 3) what stands in the map, both in the map's frame, as viewpoint (3,) is [m].
    """
    from scipy.ndimage import minimum_filter

    measured = nearest_ranges(*directions(scan, viewpoint), 0.0)
    there = nearest_ranges(*directions(map_stands, viewpoint), 0.0)
    asked = np.isfinite(measured) & np.isfinite(there)
    if np.count_nonzero(asked) < _FEWEST_DIRECTIONS:
        return float("nan")
    beside = minimum_filter(measured, size=3, mode=("nearest", "wrap"))
    return float(np.mean((there < _SEEN * beside - 1.0)[asked]))
