"""The second scan that sees a cell of the map replaces the point that the first one left there.

As a surface comes into view its cells are reached by the noise of single points first: where the sensor moves slowly against the
spacing of the cells, a cell waits for many scans just beyond what can be seen, and the first point in it is the one that noise
has carried farthest. It lies off the surface by a standard deviation of the range and more, to the side from which the view
grows: undersides of stairs by 0.2 to 1.6 cm (3 cm of range noise), all the same way, while a person climbs towards them. What the
next scan sees there is a fair sample. The first point serves until then, and for good where no other comes soon: a point that
is replaced long after would move the map with the drift of the estimate.

Most points of a scan fall into cells that hold a point already. Which those are is kept in a table of cells (one place for each,
the cell that came last has it), so that these points need not ask the tree.

Source: docs/lidar_inertial_odometry.md, section 9.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.nav_state import PL, RL, R
from boxplus.filtering.plane_information import USED
from boxplus.filtering.triples import cross, placed, rotation_of, triple_of, turned_back
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.plane_matching import WEIGHT

_SOON_NS = 1_000_000_000
_ASKED = 1000  # points of a scan, of what they rest on
_INDEX_BITS = np.uint64(20)
_INDEX = np.int64(0xFFFFF)
_SPREAD = np.uint64(0x9E3779B97F4A7C15)  # an odd factor whose product's upper bits depend on all bits of a key
_EMPTY = np.uint32(0xFFFFFFFF)
_ONE = np.uint64(1)
_TAKEN_BITS, _UPPER, _NO_CELL = 16, np.uint64(48), np.uint64(0xFFFFFFFFFFFFFFFF)


@kernel
def _cells_of(points: NDArray[np.float64], size: float, level: np.uint64, cells: NDArray[np.uint64]) -> None:
    """`cells` (n,) of points (n, 3): which cell of this side [m], modulo 2²⁰ on each axis, with the level of the side."""
    for n in range(len(points)):
        cells[n] = _cell_of(points[n, 0], points[n, 1], points[n, 2], size, level)


@kernel(inline=True)
def _cell_of(x: float, y: float, z: float, size: float, level: np.uint64) -> np.uint64:
    key = (level << _INDEX_BITS) | np.uint64(np.int64(math.floor(x / size)) & _INDEX)
    key = (key << _INDEX_BITS) | np.uint64(np.int64(math.floor(y / size)) & _INDEX)
    return (key << _INDEX_BITS) | np.uint64(np.int64(math.floor(z / size)) & _INDEX)


@kernel
def _meet(
    cells: NDArray[np.uint64],
    waiting: NDArray[np.uint64],
    table: NDArray[np.uint32],
    shift: np.uint64,
    waited: NDArray[np.bool_],
    met: NDArray[np.bool_],
) -> None:
    """Which of `cells` (n,) are among the `waiting` ones (m,), `waited` (n,), and which of these among those, `met` (m,).

    `table` (2^(64 − shift),) is scratch, all empty.
    """
    mask = np.uint64(table.shape[0]) - _ONE
    for k in range(len(waiting)):
        slot = (waiting[k] * _SPREAD) >> shift
        while table[slot] != _EMPTY:
            slot = (slot + _ONE) & mask
        table[slot] = np.uint32(k)
    for n in range(len(cells)):
        slot = (cells[n] * _SPREAD) >> shift
        while table[slot] != _EMPTY and waiting[table[slot]] != cells[n]:
            slot = (slot + _ONE) & mask
        if table[slot] != _EMPTY:
            waited[n] = met[table[slot]] = True


@kernel(inline=True)
def _place_of(cell: np.uint64) -> np.uint64:
    return np.uint64((cell * _SPREAD) >> _UPPER)


@kernel
def _are_taken(cells: NDArray[np.uint64], table: NDArray[np.uint64], taken: NDArray[np.bool_]) -> None:
    """Which of `cells` (n,) are in the table of those that hold a point."""
    for n in range(len(cells)):
        taken[n] = table[_place_of(cells[n])] == cells[n]


@kernel
def _take(cells: NDArray[np.uint64], table: NDArray[np.uint64]) -> None:
    """`cells` (n,) hold a point from now on."""
    for n in range(len(cells)):
        table[_place_of(cells[n])] = cells[n]


@kernel
def _information_on(
    cells: NDArray[np.uint64],
    side: float,
    level: np.uint64,
    origin: NDArray[np.float64],
    x: NDArray[np.float64],
    p_lidar: NDArray[np.float32],
    planes: NDArray[np.float64],
    fate: NDArray[np.uint8],
    neighbours: NDArray[np.float32],
) -> NDArray[np.float64]:
    """(2, 6, 6): information about the pose of every n-th plane, and what of it rests on points in `cells` (k,)."""
    shift = np.uint64(62)  # of a table that is a quarter full at most
    while 4 * len(cells) > 1 << np.int64(np.uint64(64) - shift):
        shift -= _ONE
    table = np.full(1 << np.int64(np.uint64(64) - shift), _NO_CELL)
    mask = np.uint64(table.shape[0]) - _ONE
    for k in range(len(cells)):
        slot = (cells[k] * _SPREAD) >> shift
        while table[slot] != _NO_CELL:
            slot = (slot + _ONE) & mask
        table[slot] = cells[k]
    rotation, mounting, lever = rotation_of(x, R), rotation_of(x, RL), triple_of(x, PL)
    A, h, corners = np.zeros((2, 6, 6)), np.empty(6), neighbours.shape[1]
    stride = max(p_lidar.shape[0] // _ASKED, 1)
    for n in range(0, p_lidar.shape[0], stride):
        if fate[n] != USED:
            continue
        count = 0
        for i in range(corners):
            q = triple_of(neighbours[n, i], 0)
            cell = _cell_of(q[0] + origin[0], q[1] + origin[1], q[2] + origin[2], side, level)
            slot = (cell * _SPREAD) >> shift
            while table[slot] != _NO_CELL and table[slot] != cell:
                slot = (slot + _ONE) & mask
            count += table[slot] == cell
        s, u = placed(mounting, lever, triple_of(p_lidar[n], 0)), triple_of(planes[n], 0)
        turn, weight, share = cross(s, turned_back(rotation, u)), planes[n, WEIGHT], count / corners
        h[0], h[1], h[2], h[3], h[4], h[5] = turn[0], turn[1], turn[2], u[0], u[1], u[2]
        for i in range(6):
            for j in range(6):
                said = weight * h[i] * h[j]
                A[0, i, j] += said
                A[1, i, j] += share * said
    return A


class FirstArrivals:
    """What was the first in its cell of a downsampled map, for a second, and where the last scan has left points.

    Args:
        largest_cell: side of the map's cells, which may be halved from scan to scan [m].
    """

    def __init__(self, largest_cell: float) -> None:
        self._largest_cell = largest_cell
        self._cells = np.empty(0, np.uint64)
        self._points = np.empty((0, 3))
        self._time_ns = np.empty(0, np.int64)
        self._taken, self._taken_side = np.full(1 << _TAKEN_BITS, _NO_CELL), largest_cell
        self._newest, self._newest_side = np.empty(0, np.uint64), largest_cell

    def forget_map(self) -> None:
        """The map has lost points otherwise than here: nothing is known of its cells."""
        self._taken[:] = _NO_CELL

    def insert_into(self, tree: IkdTree, p_world: NDArray[np.float64], time_ns: int) -> tuple[int, int]:
        """Insert a scan into the map; how many of its points were stored, and how many of these in the place of others.

        Args:
            tree: the map, with the side of the cells that suits this scan.
            p_world: (n, 3) [m]; time_ns: when they were measured.
        """
        self._keep(time_ns - self._time_ns <= _SOON_NS)
        side = tree.cell_size or self._largest_cell
        if side != self._taken_side:  # a point that made room for another may have left a smaller cell empty
            self._taken[:] = _NO_CELL
            self._taken_side = side
        cells = self._in_cells(p_world, side)
        waited, again = self._seen_again(cells)
        tree.delete_points(self._points[again])
        self._keep(~again)
        taken = np.empty(len(cells), np.bool_)
        _are_taken(cells, self._taken, taken)
        asked = np.flatnonzero(~taken | waited)
        stored = asked[tree.insert(p_world[asked], downsample=True).stored]
        _take(cells[asked], self._taken)
        self._newest, self._newest_side = cells[stored], side
        first = stored[~waited[stored]]
        self._cells = np.concatenate([self._cells, cells[first]])
        self._points = np.concatenate([self._points, p_world[first]])
        self._time_ns = np.concatenate([self._time_ns, np.full(len(first), time_ns)])
        return len(stored), int(np.count_nonzero(again))

    def information_on_newest(
        self,
        x: NDArray[np.float64],
        origin: NDArray[np.float64],
        p_lidar: NDArray[np.float32],
        planes: NDArray[np.float64],
        fate: NDArray[np.uint8],
        neighbours: NDArray[np.float32],
    ) -> NDArray[np.float64]:
        """(2, 6, 6): what some planes of a scan say of the pose at x (36,), and what of that rests on points of the scan before.

        Args:
            origin: (3,) of the map.
            p_lidar, planes, fate, neighbours: of all points, as `PlaneMeasurement` has them.
        """
        side, level = self._newest_side, self._level_of(self._newest_side)
        on_newest: NDArray[np.float64] = _information_on(self._newest, side, level, origin, x, p_lidar, planes, fate, neighbours)
        return on_newest

    def _level_of(self, cell: float) -> np.uint64:
        return np.uint64(max(round(math.log2(self._largest_cell / cell)), 0))

    def _in_cells(self, p_world: NDArray[np.float64], cell: float) -> NDArray[np.uint64]:
        cells = np.empty(len(p_world), np.uint64)
        _cells_of(np.ascontiguousarray(p_world), cell, self._level_of(cell), cells)
        return cells

    def _seen_again(self, cells: NDArray[np.uint64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which of these cells (n,) hold a first arrival, and which of the first arrivals lie in them."""
        waited, again = np.zeros(len(cells), np.bool_), np.zeros(len(self._cells), np.bool_)
        bits = (2 * len(again) + 1).bit_length()
        _meet(cells, self._cells, np.full(1 << bits, _EMPTY), np.uint64(64 - bits), waited, again)
        return waited, again

    def _keep(self, which: NDArray[np.bool_]) -> None:
        if not which.all():
            self._cells, self._points, self._time_ns = self._cells[which], self._points[which], self._time_ns[which]
