"""Planes that earlier scans have found, kept for as long as the map around them stays as it is.

Of two scans in a row most points lie at the same places, and find the same planes there: five neighbours, principal components, a
second search where they lie on a line. So the plane that was found last in a cell, half as wide as those of the map, is kept, and
a point that falls into this cell and lies on the plane, within what its own points may lie off it, takes it over. (In cells as
wide as the map's, planes are of points so far beside that errors grow by a tenth.) Whether a plane may be no more than a line of
the scan depends on the ray, and is asked anew; so is everything that depends on the point: weight, gate, leverage. Where the map
stores or loses a point, the planes of this cell and of those within two cells are forgotten.

The table has one place for a cell, and the cell that came last has it; a cell that has lost its place is searched again. What a
scan finds is written after all its points have been matched, in their order, so that threads do not matter.

Source: docs/lidar_inertial_odometry.md, section 5.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

# A matched plane: unit normal u (0 to 2), offset uᵀq in the world (3), variance of its points about it (4), and twice a
# vector g with its offset gᵀq (5 to 8, 9 to 12): the uncertainty of the normal, see `plane_matching`; the variance of a point
# that counts for that uncertainty (13), here the plane's own; the weight that it was given last (WEIGHT); and the variance of
# its points across their longest extent within it (SPREAD).
WEIGHT, SPREAD = 14, 15
PLANE = 16
NEIGHBOURS = 5
NO_CELL = np.uint64(0)
_SHARE, _REACH = 0.5, 2  # side of a cell by that of the map's; cells around a change
_BITS = 15  # places of the table: ten times the points of a scan with the default settings
_CELL_BITS, _CELL_MASK = np.uint64(21), np.int64(0x1FFFFF)
_OCCUPIED = np.uint64(1 << 63)  # no key is NO_CELL
# Of the product with an odd factor, upper bits depend on nearly all bits of a key; there are 20 from here on.
_UPPER_BITS, _FACTOR = np.uint64(44), np.uint64(0x9E3779B97F4A7C15)


@kernel(inline=True)
def key_of(i: int, j: int, k: int) -> np.uint64:
    """A number for the cell (i, j, k), modulo 2²¹ on each axis; never NO_CELL."""
    x, y, z = np.uint64(i & _CELL_MASK), np.uint64(j & _CELL_MASK), np.uint64(k & _CELL_MASK)
    return np.uint64(_OCCUPIED | (((x << _CELL_BITS) | y) << _CELL_BITS) | z)


@kernel(inline=True)
def place_of(key: np.uint64, places: int) -> np.uint64:
    """Where a table of so many places, a power of two up to 2²⁰, keeps a cell."""
    return np.uint64(((key * _FACTOR) >> _UPPER_BITS) & np.uint64(places - 1))


@kernel
def _remember(
    cells: NDArray[np.uint64],
    planes: NDArray[np.float64],
    neighbours: NDArray[np.float32],
    keys: NDArray[np.uint64],
    known: NDArray[np.float64],
    known_neighbours: NDArray[np.float32],
) -> None:
    """Put the planes (n, PLANE) of `cells` (n,) into the table, those of NO_CELL left out."""
    for n in range(len(cells)):
        if cells[n] == NO_CELL:
            continue
        place = place_of(cells[n], len(keys))
        keys[place] = cells[n]
        for column in range(PLANE):
            known[place, column] = planes[n, column]
        for i in range(NEIGHBOURS):
            for axis in range(3):
                known_neighbours[place, i, axis] = neighbours[n, i, axis]


@kernel
def _forget(points: NDArray[np.float64], cell: float, keys: NDArray[np.uint64]) -> None:
    """Empty the places of the cells of points (n, 3) and of those within `_REACH` of them."""
    for n in range(len(points)):
        x = np.int64(math.floor(points[n, 0] / cell))
        y = np.int64(math.floor(points[n, 1] / cell))
        z = np.int64(math.floor(points[n, 2] / cell))
        for i in range(x - _REACH, x + _REACH + 1):
            for j in range(y - _REACH, y + _REACH + 1):
                for k in range(z - _REACH, z + _REACH + 1):
                    key = key_of(i, j, k)
                    place = place_of(key, len(keys))
                    if keys[place] == key:
                        keys[place] = NO_CELL


class KnownPlanes:
    """The planes of one map that grows; `PlaneMeasurement` looks them up and adds to them.

    Args:
        bits: the table has 2^bits places.

    Attributes:
        cell: side of its cells [m].
        keys, planes, neighbours: (2^bits,), (2^bits, PLANE) and (2^bits, 5, 3), for kernels.
    """

    def __init__(self, bits: int = _BITS) -> None:
        self.cell = 1.0
        self.keys: NDArray[np.uint64] = np.full(1 << bits, NO_CELL)
        self.planes: NDArray[np.float64] = np.empty((1 << bits, PLANE))
        self.neighbours: NDArray[np.float32] = np.empty((1 << bits, NEIGHBOURS, 3), np.float32)

    def use_cells(self, cell: float) -> None:
        """The map's cells have this side [m] from now on; planes of a map with others are forgotten."""
        if _SHARE * cell != self.cell:
            self.forget_all()
            self.cell = _SHARE * cell

    def remember(self, cells: NDArray[np.uint64], planes: NDArray[np.float64], neighbours: NDArray[np.float32]) -> None:
        """Take what a scan has found: keys of cells (n,), NO_CELL where there is nothing to keep, planes and neighbours."""
        _remember(cells, planes, neighbours, self.keys, self.planes, self.neighbours)

    def forget_near(self, points: NDArray[np.float64]) -> None:
        """The map has stored or lost these points (n, 3) [m]."""
        _forget(points, self.cell, self.keys)

    def forget_all(self) -> None:
        """The map has changed anywhere."""
        self.keys[:] = NO_CELL
