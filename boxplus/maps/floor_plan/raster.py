"""A grid of square cells over the ground, and the heights of the ground on it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError

Floats = NDArray[np.float64]

_LARGEST = 200_000_000  # cells
_LOW = 3  # the ground is the third lowest point of a cell: one that a mirror put below does not count


@dataclass(frozen=True, slots=True)
class Raster:
    """Cells [row, column] over x to the right and y upwards.

    Attributes:
        x, y: of the corner of cell [0, 0] [m].
        cell: side of a cell [m].
        rows, columns: how many.
    """

    x: float
    y: float
    cell: float
    rows: int
    columns: int

    @classmethod
    def over(cls, low: Floats, high: Floats, cell: float) -> Raster:
        """The raster over a rectangle, from (x, y) to (x, y) [m]; its lines go through the origin.

        Raises:
            InputError: more than 200 million cells.
        """
        first, last = np.floor(low / cell), np.floor(high / cell)
        columns, rows = (last - first + 1).astype(np.int64).tolist()
        if rows * columns > _LARGEST:
            raise InputError(
                f"at most {_LARGEST:,} cells", f"{columns:,} × {rows:,} of {cell:g} m", "take larger cells (--resolution)"
            )
        return cls(float(first[0] * cell), float(first[1] * cell), cell, rows, columns)

    def index(self, xy: NDArray[np.floating]) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
        """Row and column of points (n, 2 or more), and whether they lie inside; outside they are clipped."""
        column = np.floor((xy[:, 0] - self.x) / self.cell).astype(np.intp)
        row = np.floor((xy[:, 1] - self.y) / self.cell).astype(np.intp)
        inside = (row >= 0) & (row < self.rows) & (column >= 0) & (column < self.columns)
        return np.clip(row, 0, self.rows - 1), np.clip(column, 0, self.columns - 1), inside


class GroundHeights:
    """The ground under points that come piece by piece.

    Of every cell the third lowest point counts. What stands on the ground hides it: the height of a cell is at most that of any
    other plus the steepest slope times the distance, the largest surface that is nowhere steeper and below all of them. A slope
    keeps its height, a car, a shelf or a wall does not.

    Args:
        raster: of the heights.
        slope: steepest ground, rise by distance.
        reach: how far ground is continued where none was seen [m].
    """

    def __init__(self, raster: Raster, slope: float = 0.3, reach: float = 2.0) -> None:
        self.raster, self._slope, self._reach = raster, slope, reach
        self._lowest = np.full((raster.rows, raster.columns, _LOW), np.inf)

    def add(self, points: NDArray[np.float32]) -> None:
        """Take points (n, 3) that may lie on the ground, or above it [m]."""
        row, column, inside = self.raster.index(points)
        _keep_lowest(row[inside], column[inside], points[inside, 2].astype(np.float64), self._lowest)

    def heights(self) -> Floats:
        """(rows, columns) [m]; NaN where no ground is near."""
        seen = self._lowest[:, :, -1]
        ground, far = seen.copy(), np.where(np.isfinite(seen), 0.0, np.inf)
        _spread(ground, self._slope * self.raster.cell)
        _spread(far, self.raster.cell)
        return np.where(far <= self._reach, ground, np.nan)


@kernel
def _keep_lowest(row, column, z, lowest):  # type: ignore[no-untyped-def]
    """The lowest heights of every cell, in ascending order."""
    for n in range(np.uint64(len(z))):
        value = z[n]
        for k in range(_LOW):
            if value < lowest[row[n], column[n], k]:
                value, lowest[row[n], column[n], k] = lowest[row[n], column[n], k], value


@kernel
def _spread(height, rise):  # type: ignore[no-untyped-def]
    """Lower every cell to at most any other plus `rise` for each cell of way between them (8 neighbours), in two sweeps."""
    rows, columns = height.shape
    diagonal = rise * math.sqrt(2.0)
    for i in range(rows):
        for j in range(columns):
            best = height[i, j]
            if j > 0:
                best = min(best, height[i, j - 1] + rise)
            if i > 0:
                best = min(best, height[i - 1, j] + rise)
                if j > 0:
                    best = min(best, height[i - 1, j - 1] + diagonal)
                if j < columns - 1:
                    best = min(best, height[i - 1, j + 1] + diagonal)
            height[i, j] = best
    for i in range(rows - 1, -1, -1):
        for j in range(columns - 1, -1, -1):
            best = height[i, j]
            if j < columns - 1:
                best = min(best, height[i, j + 1] + rise)
            if i < rows - 1:
                best = min(best, height[i + 1, j] + rise)
                if j > 0:
                    best = min(best, height[i + 1, j - 1] + diagonal)
                if j < columns - 1:
                    best = min(best, height[i + 1, j + 1] + diagonal)
            height[i, j] = best
