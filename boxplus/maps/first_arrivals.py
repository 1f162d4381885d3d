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
from boxplus.maps.ikd_tree import IkdTree

_SOON_NS = 1_000_000_000
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
        key = level
        for axis in range(3):
            key = (key << _INDEX_BITS) | np.uint64(np.int64(math.floor(points[n, axis] / size)) & _INDEX)
        cells[n] = key


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


def _among(cells: NDArray[np.uint64], waiting: NDArray[np.uint64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which of `cells` (n,) are among the `waiting` ones (m,), and which of these among those."""
    waited, met = np.zeros(len(cells), np.bool_), np.zeros(len(waiting), np.bool_)
    bits = (2 * len(met) + 1).bit_length()
    _meet(cells, waiting, np.full(1 << bits, _EMPTY), np.uint64(64 - bits), waited, met)
    return waited, met


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
        waited, again = _among(cells, self._cells)
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

    def are_newest(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which points (n, 3) of the map, in the world [m], are in cells where the last scan has left one."""
        return _among(self._in_cells(points, self._newest_side), self._newest)[0]

    def _in_cells(self, p_world: NDArray[np.float64], cell: float) -> NDArray[np.uint64]:
        cells = np.empty(len(p_world), np.uint64)
        _cells_of(np.ascontiguousarray(p_world), cell, np.uint64(max(round(math.log2(self._largest_cell / cell)), 0)), cells)
        return cells

    def _keep(self, which: NDArray[np.bool_]) -> None:
        if not which.all():
            self._cells, self._points, self._time_ns = self._cells[which], self._points[which], self._time_ns[which]
