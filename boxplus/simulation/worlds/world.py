"""A world of solids that rays can be cast into."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.simulation.worlds import raycast

Solid = NDArray[np.float64]
"""One row of numbers, made by `box`, `rectangle`, `cylinder` or `sphere`; its layout is described in raycast.py."""

_LARGE_CELLS = 400
"""A solid over more grid cells than this is tested for every ray instead of being listed in each of them."""


def _solid(
    kind: float, centre: ArrayLike, R_world_solid: ArrayLike, half: ArrayLike, enclosing: float, reflectivity: float
) -> Solid:
    row = np.concatenate([[kind], np.ravel(centre), np.ravel(R_world_solid), np.ravel(half), [enclosing, reflectivity]])
    if row.shape != (raycast.SOLID_WIDTH,) or not np.isfinite(row).all() or min(np.ravel(half)) < 0:
        raise InputError(
            "a centre of 3 numbers and sizes that are not negative",
            f"centre {np.asarray(centre).tolist()}, half sizes {np.asarray(half).tolist()}",
            "give finite metres",
        )
    return row.astype(np.float64)


def _about_z(yaw: float) -> NDArray[np.float64]:
    return so3.exp(np.array([0.0, 0.0, yaw]))


def box(
    centre: ArrayLike, size: ArrayLike, yaw: float = 0.0, reflectivity: float = 0.5, R_world_box: ArrayLike | None = None
) -> Solid:
    """A box, seen from outside or inside.

    Args:
        centre: (3,) world [m].
        size: (3,) full side lengths in the frame of the box [m].
        yaw: turn about the vertical [rad]; or `R_world_box` (3, 3) for any orientation.
        reflectivity: 0 to 1.
    """
    half = 0.5 * np.asarray(size, dtype=np.float64)
    R = _about_z(yaw) if R_world_box is None else np.asarray(R_world_box, dtype=np.float64)
    return _solid(raycast.BOX, centre, R, half, float(np.linalg.norm(half)), reflectivity)


def rectangle(centre: ArrayLike, size: ArrayLike, R_world_rectangle: ArrayLike | None = None, reflectivity: float = 0.5) -> Solid:
    """A flat rectangle of `size` (2,) [m] in the x-y plane of its frame; horizontal without a rotation."""
    width, depth = np.ravel(size)
    R = np.eye(3) if R_world_rectangle is None else R_world_rectangle
    return box(centre, (width, depth, 0.0), reflectivity=reflectivity, R_world_box=R)


def cylinder(foot: ArrayLike, radius: float, height: float, reflectivity: float = 0.5) -> Solid:
    """A closed vertical cylinder that stands on `foot` (3,) [m]."""
    centre = np.asarray(foot, dtype=np.float64) + np.array([0.0, 0.0, 0.5 * height])
    half = (radius, radius, 0.5 * height)
    return _solid(raycast.CYLINDER, centre, np.eye(3), half, float(np.hypot(radius, 0.5 * height)), reflectivity)


def sphere(centre: ArrayLike, radius: float, reflectivity: float = 0.5) -> Solid:
    """A ball."""
    return _solid(raycast.SPHERE, centre, np.eye(3), (radius, radius, radius), radius, reflectivity)


class World:
    """Solids, and a grid over them for fast rays. z points up.

    Args:
        solids: made by `box`, `rectangle`, `cylinder`, `sphere`.
        cell_m: side of a grid cell [m].

    Attributes:
        solids: (S, 18) float64, see raycast.py.
    """

    def __init__(self, solids: Sequence[Solid], cell_m: float = 4.0) -> None:
        if not len(solids):
            raise InputError("at least one solid", "none", "add a floor")
        self.solids = np.ascontiguousarray(np.stack(list(solids)))
        low, high = _extent(self.solids)
        sizes = np.prod(np.ceil((high - low) / cell_m) + 1, axis=1)
        is_large = sizes > _LARGE_CELLS
        self._large = np.flatnonzero(is_large).astype(np.uint32)
        self._list_in_cells(low, high, np.flatnonzero(~is_large), cell_m)

    def _list_in_cells(self, low: NDArray[np.float64], high: NDArray[np.float64], small: NDArray[np.intp], cell_m: float) -> None:
        if not len(small):
            self._grid = np.array([0.0, 0.0, cell_m, 0.0, 0.0])
            self._cell_begin, self._cell_solids = np.zeros(1, np.uint32), np.zeros(0, np.uint32)
            return
        # The margin keeps surfaces that lie exactly on a cell's border in the cells of both sides.
        margin = 1e-3
        origin = low[small].min(axis=0) - 2 * margin
        first = np.floor((low[small] - margin - origin) / cell_m).astype(np.int64)
        last = np.floor((high[small] + margin - origin) / cell_m).astype(np.int64)
        columns, rows = (last.max(axis=0) + 1).tolist()
        cells: list[NDArray[np.int64]] = []
        owners: list[NDArray[np.int64]] = []
        for solid, begin, end in zip(small, first, last, strict=True):
            x, y = np.meshgrid(np.arange(begin[0], end[0] + 1), np.arange(begin[1], end[1] + 1))
            cells.append((y * columns + x).ravel())
            owners.append(np.full(x.size, solid))
        cell, owner = np.concatenate(cells), np.concatenate(owners)
        order = np.argsort(cell, kind="stable")
        self._grid = np.array([origin[0], origin[1], cell_m, columns, rows], dtype=np.float64)
        self._cell_begin = np.searchsorted(cell[order], np.arange(columns * rows + 1)).astype(np.uint32)
        self._cell_solids = owner[order].astype(np.uint32)

    def __len__(self) -> int:
        return len(self.solids)

    def cast(
        self,
        directions_lidar: NDArray[np.float64],
        R_world_lidar: NDArray[np.float64],
        p_world_lidar: NDArray[np.float64],
        max_range: float = 200.0,
    ) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
        """Cast rays from moving poses.

        Args:
            directions_lidar: (N, 3) unit vectors, LiDAR frame.
            R_world_lidar: (M, 3, 3), M a divisor of N; consecutive groups of N / M rays share a pose.
            p_world_lidar: (M, 3) [m].
            max_range: rays that meet nothing nearer are misses [m].

        Returns:
            ranges (N,) [m], infinite for a miss, and the solid hit (N,) uint32.

        Raises:
            InputError: numbers of rays and poses that do not fit.
        """
        count, poses = len(directions_lidar), len(p_world_lidar)
        if not poses or count % poses or R_world_lidar.shape != (poses, 3, 3) or directions_lidar.shape != (count, 3):
            raise InputError(
                "directions (N, 3) and M poses (M, 3, 3), (M, 3) with N a multiple of M",
                f"shapes {directions_lidar.shape}, {R_world_lidar.shape} and {p_world_lidar.shape}",
                "give the same number of rays to every pose",
            )
        ranges, hits = np.empty(count), np.empty(count, np.uint32)
        raycast.cast_rays(
            np.ascontiguousarray(directions_lidar, dtype=np.float64),
            count // poses,
            np.ascontiguousarray(R_world_lidar, dtype=np.float64),
            np.ascontiguousarray(p_world_lidar, dtype=np.float64),
            self.solids,
            self._large,
            self._grid,
            self._cell_begin,
            self._cell_solids,
            float(max_range),
            ranges,
            hits,
        )
        return ranges, hits

    def distance(self, p_world: ArrayLike) -> NDArray[np.float64]:
        """Distance (N,) [m] of points (N, 3) to the nearest surface; every solid is looked at."""
        points = np.ascontiguousarray(p_world, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError("p_world of shape (N, 3)", f"shape {points.shape}", "give one row x, y, z per point")
        distances = np.empty(len(points))
        raycast.surface_distances(points, self.solids, distances)
        return distances

    def reflectivity(self, hits: NDArray[np.uint32]) -> NDArray[np.float64]:
        """Reflectivity (N,), 0 to 1, of the solids `hits` (N,)."""
        found: NDArray[np.float64] = self.solids[hits, raycast.REFLECTIVITY]
        return found


def _extent(solids: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Low and high corner (S, 2) of every solid's bounding box in x and y."""
    R = solids[:, raycast.ROTATION : raycast.HALF].reshape(-1, 3, 3)
    reach = np.einsum("sij,sj->si", np.abs(R), solids[:, raycast.HALF : raycast.ENCLOSING])[:, :2]
    centre = solids[:, raycast.CENTRE : raycast.CENTRE + 2]
    return centre - reach, centre + reach
