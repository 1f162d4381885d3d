"""The points of a map around a position, tile by tile, with bounded memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.maps.tiles.layout import TileIndex, split_by_tile
from boxplus.maps.tiles.voxel_thinning import first_per_voxel

Points = NDArray[np.float32]

_KEPT = 5_000_000  # points in memory
_TILE = 32.0  # m, of a cloud in memory


class TiledPoints:
    """Reads tiles where they are asked for, and keeps those used last.

    Args:
        tiles: the tiles there are; tile (i, j, k) begins at (i, j, k) · size.
        size: edge of a tile [m].
        read: the points (N, 3) float32 of a tile, thinned.
    """

    def __init__(self, tiles: Iterable[TileIndex], size: float, read: Callable[[TileIndex], Points]) -> None:
        self.tiles = sorted(tiles)
        self.size = size
        self._read = read
        self._low = np.array(self.tiles, dtype=np.float64).reshape(-1, 3) * size
        self._kept: OrderedDict[TileIndex, Points] = OrderedDict()
        self._points = 0

    @classmethod
    def of(cls, points: Points, voxel: float) -> TiledPoints:
        """Of a cloud (N, 3) in memory, thinned to one point a voxel [m]."""
        tiles = dict(split_by_tile(points[first_per_voxel(points, voxel)], _TILE))
        return cls(tiles, _TILE, lambda index: tiles[index])

    def near(self, centre: ArrayLike, radius: float) -> Points:
        """(N, 3) float32 within `radius` [m] of `centre` (3,)."""
        c = np.asarray(centre, dtype=np.float64)
        gap = np.maximum(np.maximum(self._low - c, c - self._low - self.size), 0.0)
        found = [np.zeros((0, 3), np.float32)]
        for k in np.flatnonzero((gap**2).sum(axis=1) <= radius**2):
            points = self.tile(self.tiles[k])
            d = points - c.astype(np.float32)
            found.append(points[np.einsum("na,na->n", d, d) <= radius**2])
        return np.concatenate(found)

    def tile(self, index: TileIndex) -> Points:
        """(N, 3) float32 of one tile."""
        if index in self._kept:
            self._kept.move_to_end(index)
            return self._kept[index]
        points = self._read(index)
        self._kept[index] = points
        self._points += len(points)
        while self._points > _KEPT and len(self._kept) > 1:
            self._points -= len(self._kept.popitem(last=False)[1])
        return points
