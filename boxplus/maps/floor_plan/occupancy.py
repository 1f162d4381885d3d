"""A floor plan: which cells are occupied between knee and head, and which were seen to be free."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from boxplus._jit import kernel
from boxplus._settings import Settings
from boxplus.maps.floor_plan.raster import Floats, Raster

UNKNOWN, FREE, OCCUPIED = 0, 1, 2
_RAYS = 1440  # of a turn


class FloorPlanConfig(Settings):
    """Settings of a floor plan.

    Raises:
        InputError: a setting is unknown or out of range.
    """

    resolution: float = Field(0.1, gt=0, description="side of a cell; not below the voxels of the map, or walls get holes [m]")
    least_height: float = Field(0.2, gt=0, description="what rises less above the ground is none [m]")
    largest_height: float = Field(1.8, gt=0, description="what is higher above the ground is passed below [m]")
    least_points: int = Field(2, ge=1, description="of an occupied cell")
    slope: float = Field(0.3, gt=0, description="steepest ground, rise by distance")
    ground_cell: float = Field(0.5, gt=0, description="side of the cells of the ground [m]")
    sensor_height: float = Field(3.0, gt=0, description="the ground is at most this far below the path [m]")
    max_range: float = Field(20.0, gt=0, description="longest ray from the path to a wall [m]")
    radius: float = Field(
        0.2, ge=0, description="of what moved along the path: free, whatever was seen there before or after [m]"
    )


class Occupancy:
    """Counts points over the ground, piece by piece, and looks from the path to what stands around it.

    Args:
        raster: of the floor plan.
        ground: its heights (rows, columns) of `ground_raster`, NaN where unknown.
    """

    def __init__(self, raster: Raster, ground: Floats, ground_raster: Raster, config: FloorPlanConfig) -> None:
        self.raster, self._config = raster, config
        self._ground, self._ground_raster = ground, ground_raster
        self._obstacles, self._floor = np.zeros((2, raster.rows, raster.columns), dtype=np.int32)

    def add(self, points: NDArray[np.float32]) -> None:
        """Take points (n, 3) of the map [m]."""
        config = self._config
        row, column, inside = self.raster.index(points)
        height = points[:, 2] - self._ground_at(points)
        obstacle = inside & (height >= config.least_height) & (height <= config.largest_height)
        floor = inside & (np.abs(height) < config.least_height)
        for chosen, counts in ((obstacle, self._obstacles), (floor, self._floor)):
            np.add.at(counts, (row[chosen], column[chosen]), 1)

    def _ground_at(self, points: NDArray[np.float32]) -> Floats:
        """Heights (n,) of the ground under points, between the middles of its cells; NaN where one of them is unknown."""
        raster, ground = self._ground_raster, self._ground
        u = np.clip((points[:, 0] - raster.x) / raster.cell - 0.5, 0.0, raster.columns - 1.0)
        v = np.clip((points[:, 1] - raster.y) / raster.cell - 0.5, 0.0, raster.rows - 1.0)
        j, i = np.minimum(u.astype(np.intp), raster.columns - 2), np.minimum(v.astype(np.intp), raster.rows - 2)
        i, j = np.maximum(i, 0), np.maximum(j, 0)
        a, b = u - j, v - i
        i1, j1 = np.minimum(i + 1, raster.rows - 1), np.minimum(j + 1, raster.columns - 1)
        lower = ground[i, j] * (1.0 - a) + ground[i, j1] * a
        upper = ground[i1, j] * (1.0 - a) + ground[i1, j1] * a
        return np.asarray(lower * (1.0 - b) + upper * b)

    def cells(self, path: Floats) -> NDArray[np.uint8]:
        """(rows, columns) of UNKNOWN, FREE and OCCUPIED, seen from a path (n, 2 or more) [m].

        A cell is free where a ray from the path passes through it to something occupied, where its ground was seen, and where
        the path itself went. A ray that meets nothing proves nothing.
        """
        config, raster = self._config, self.raster
        occupied = self._obstacles >= config.least_points
        cells = np.where(self._floor > 0, np.uint8(FREE), np.uint8(UNKNOWN))
        blocked = occupied.copy()  # thickened, so that no ray slips between two cells that touch at a corner
        blocked[1:] |= occupied[:-1]
        blocked[:-1] |= occupied[1:]
        blocked[:, 1:] |= occupied[:, :-1]
        blocked[:, :-1] |= occupied[:, 1:]
        starts = (path[:, :2] - [raster.x, raster.y]) / raster.cell
        _look_around(starts, blocked, cells, config.max_range / raster.cell, np.uint8(FREE))
        cells[occupied] = OCCUPIED
        _clear(starts, cells, config.radius / raster.cell, np.uint8(FREE))
        return cells


@kernel
def _look_around(starts, blocked, cells, reach, free):  # type: ignore[no-untyped-def]
    """Rays from every start (cells as units) until the first blocked cell; the cells before it are free, where there is one."""
    for n in range(starts.shape[0]):
        for k in range(_RAYS):
            angle = 2.0 * math.pi * (k + 0.5) / _RAYS
            dx, dy = math.cos(angle), math.sin(angle)
            end = _walk(starts[n, 0], starts[n, 1], dx, dy, reach, blocked, cells, free, False)
            if end:
                _walk(starts[n, 0], starts[n, 1], dx, dy, reach, blocked, cells, free, True)


@kernel
def _walk(x, y, dx, dy, reach, blocked, cells, free, is_marking):  # type: ignore[no-untyped-def]
    """Through all cells that a ray meets; True where one is blocked. The first cells, which may touch a wall, are not asked."""
    rows, columns = blocked.shape
    i, j = math.floor(y), math.floor(x)
    step_i, step_j = (1 if dy > 0 else -1), (1 if dx > 0 else -1)
    next_x = ((j + 1 - x) if dx > 0 else (x - j)) / max(abs(dx), 1e-12)
    next_y = ((i + 1 - y) if dy > 0 else (y - i)) / max(abs(dy), 1e-12)
    along, was_open = 0.0, False
    while along <= reach and 0 <= i < rows and 0 <= j < columns:
        if blocked[i, j]:
            if was_open or along > 2.0:
                return True
        else:
            was_open = True
            if is_marking:
                cells[i, j] = free
        if next_x < next_y:
            along = next_x
            next_x += 1.0 / max(abs(dx), 1e-12)
            j += step_j
        else:
            along = next_y
            next_y += 1.0 / max(abs(dy), 1e-12)
            i += step_i
    return False


@kernel
def _clear(starts, cells, radius, free):  # type: ignore[no-untyped-def]
    """Discs about all starts (cells as units)."""
    rows, columns = cells.shape
    for n in range(starts.shape[0]):
        x, y = starts[n, 0], starts[n, 1]
        for i in range(max(int(y - radius), 0), min(int(y + radius) + 1, rows)):
            for j in range(max(int(x - radius), 0), min(int(x + radius) + 1, columns)):
                if (i + 0.5 - y) ** 2 + (j + 0.5 - x) ** 2 <= radius**2 or (i == int(y) and j == int(x)):
                    cells[i, j] = free
