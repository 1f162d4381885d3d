"""Floor plans and heights of the map in the output folder of a run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from boxplus._arguments import as_settings
from boxplus.errors import InputError
from boxplus.formats.trajectory import read_trajectory
from boxplus.maps.floor_plan.occupancy import FloorPlanConfig, Occupancy
from boxplus.maps.floor_plan.raster import Floats, GroundHeights, Raster
from boxplus.maps.tiles.store import TileStore
from boxplus.runs.run_folder import RunFolder
from boxplus.runs.saved_map.map_trajectories import map_trajectories
from boxplus.runs.slam.gnss_output import read_origin

_STOREY = 2.0  # m between two heights of the path at one place that are two storeys
_SAME_PLACE = 2.0  # m
_STEP = 0.3  # m between the poses that are looked from
_HEAD_ROOM = 20.0  # m above the path that a height map still takes


class MapFromAbove:
    """The map of a run of `boxplus lio` or `boxplus slam`, or a joint map, cut around its paths, and the ground below them.

    Args:
        folder: the output folder.
        config: settings; each has a default.
        z: lowest and highest point of the path [m] that counts: one storey of several. None: all of it.

    Attributes:
        store: the map; path (n, 3): positions [m] at least 0.3 m from each other.
        frame: where on the Earth the map lies, of a run of `boxplus slam` with positions by satellite; else None.

    Raises:
        InputError: no run with a map; a path on several storeys, or none of it between `z`.
    """

    def __init__(self, folder: str | Path, config: FloorPlanConfig | None = None, z: tuple[float, float] | None = None) -> None:
        run = RunFolder(Path(folder))
        self._config = as_settings(FloorPlanConfig, config)
        self.store = TileStore.open(run.tiles)
        self.frame = read_origin(run.path)
        p = np.concatenate([trajectory.p for trajectory in map_trajectories(run.path) or [read_trajectory(run.trajectory)]])
        if z is not None and len(p):
            lowest, highest = p[:, 2].min(), p[:, 2].max()
            p = p[(p[:, 2] >= z[0]) & (p[:, 2] <= z[1])]
            if not len(p):
                raise InputError(
                    f"a storey (--z) on which the path runs, which lies between {lowest:.2f} and {highest:.2f} m",
                    f"{z[0]:g} to {z[1]:g} m",
                    "give heights of the path",
                )
        if not len(p) or not self.store.counts:
            raise InputError(
                "a path and a map", f"{len(p)} poses and {self.store.point_count} points in {run.path}", "see run.json"
            )
        self.path = _thinned(p)
        self._tree = cKDTree(self.path[:, :2])
        _check_one_storey(self.path, self._tree)
        low, high = np.array([np.inf, np.inf]), np.array([-np.inf, -np.inf])
        for points in self._points(self._config.sensor_height, _HEAD_ROOM):
            low, high = np.minimum(low, points[:, :2].min(axis=0)), np.maximum(high, points[:, :2].max(axis=0))
        self._corners = np.minimum(low, self.path[:, :2].min(axis=0)), np.maximum(high, self.path[:, :2].max(axis=0))
        self._raster = Raster.over(*self._corners, self._config.ground_cell)
        ground = GroundHeights(self._raster, self._config.slope)
        for points in self._points(self._config.sensor_height, 0.0):
            ground.add(points)
        self._ground = ground.heights()

    def _points(self, below: float, above: float) -> Iterator[NDArray[np.float32]]:
        """Points (n, 3) tile by tile, from `below` under the nearest place of the path to `above` over it."""
        for tile in self.store.iter_tiles():
            _, nearest = self._tree.query(tile.points[:, :2])
            height = tile.points[:, 2] - self.path[nearest, 2]
            chosen = tile.points[(height >= -below) & (height <= above)]
            if len(chosen):
                yield chosen

    def floor_plan(self) -> tuple[NDArray[np.uint8], Raster]:
        """Cells of UNKNOWN, FREE and OCCUPIED, and where they are."""
        config = self._config
        raster = Raster.over(*self._corners, config.resolution)
        occupancy = Occupancy(raster, self._ground, self._raster, config)
        for points in self._points(config.sensor_height, config.largest_height):
            occupancy.add(points)
        return occupancy.cells(self.path), raster

    def ground(self) -> tuple[Floats, Raster]:
        """Heights of the ground (rows, columns) [m], NaN where there is none, and where they are."""
        return self._ground, self._raster

    def above_ellipsoid(self, heights: Floats) -> Floats:
        """Heights as `ground` and `surface` give them, above the ellipsoid of WGS84 where the map lies on the Earth [m].

        The plane of east and north leaves the curved Earth: 8 cm at 1 km from the origin, 8 m at 10 km.
        """
        if self.frame is None:
            return heights
        row, column = np.nonzero(np.isfinite(heights))
        x, y = self._raster.x + (column + 0.5) * self._raster.cell, self._raster.y + (row + 0.5) * self._raster.cell
        found = np.full_like(heights, np.nan)
        found[row, column] = self.frame.to_geodetic(np.column_stack([x, y, heights[row, column]]))[:, 2]
        return found

    def surface(self) -> tuple[Floats, Raster]:
        """Heights of the highest point of every cell [m], up to 20 m above the path; NaN where there is none."""
        highest = np.full((self._raster.rows, self._raster.columns), -np.inf)
        for points in self._points(self._config.sensor_height, _HEAD_ROOM):
            row, column, inside = self._raster.index(points)
            np.maximum.at(highest, (row[inside], column[inside]), points[inside, 2])
        return np.where(np.isfinite(highest), highest, np.nan), self._raster


def _thinned(p: Floats) -> Floats:
    kept = [0]
    for k in range(1, len(p)):
        if np.linalg.norm(p[k] - p[kept[-1]]) >= _STEP:
            kept.append(k)
    return np.asarray(p[kept])


def _check_one_storey(path: Floats, tree: cKDTree) -> None:
    """The ground is found below the path: where that passes over itself, it would be a guess."""
    for k, near in enumerate(tree.query_ball_point(path[:, :2], _SAME_PLACE)):
        z = path[near, 2]
        if z.max() - z.min() > _STOREY:
            x, y = path[k, :2]
            raise InputError(
                "a path that is on one storey",
                f"heights from {z.min():.1f} to {z.max():.1f} m at x = {x:.1f}, y = {y:.1f} m",
                "choose one by the heights of the path there: --z LOW HIGH",
            )
