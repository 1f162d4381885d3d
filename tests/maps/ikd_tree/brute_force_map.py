"""What an ikd-tree must do, in a few lines of NumPy: a list of points, each live or deleted."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.maps.ikd_tree.tree import DELETE_TOLERANCE, MAX_EXTENT


def round_up(value: float) -> np.float32:
    """The smallest float32 not less than a value."""
    rounded = np.float32(value)
    return np.nextafter(rounded, np.float32(np.inf)) if float(rounded) < value else rounded


class BruteForceMap:
    """Same operations, same results, no tree. Coordinates are float32 relative to `origin`."""

    def __init__(self, cell_size: float, delete_ratio: float = 0.5) -> None:
        self.cell_size = cell_size
        self.delete_ratio = delete_ratio
        self.origin = np.zeros(3)
        self.xyz = np.empty((0, 3), np.float32)
        self.live = np.empty(0, bool)
        self.revivable = 0

    def relative(self, points: ArrayLike) -> NDArray[np.float32]:
        world = np.asarray(points, float).reshape(-1, 3)
        relative = world[np.isfinite(world).all(axis=1)] - self.origin
        return relative[(np.abs(relative) <= MAX_EXTENT).all(axis=1)].astype(np.float32)

    def append(self, xyz: NDArray[np.float32]) -> None:
        self.xyz = np.concatenate([self.xyz, xyz])
        self.live = np.concatenate([self.live, np.ones(len(xyz), bool)])

    def insert(self, points: ArrayLike) -> int:
        xyz = self.relative(points)
        self.append(xyz)
        return len(xyz)

    def cell(self, point: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Low and high corner of a point's cell."""
        low, high = np.empty(3, np.float32), np.empty(3, np.float32)
        for axis in range(3):
            size, origin = self.cell_size, self.origin[axis]
            guess = np.floor((origin + float(point[axis])) / size)
            for index in (guess - 1, guess, guess + 1):
                bounds = round_up(index * size - origin), round_up((index + 1) * size - origin)
                if bounds[0] <= point[axis] < bounds[1]:
                    low[axis], high[axis] = bounds
        return low, high

    def insert_downsampled(self, points: ArrayLike) -> None:
        for point in self.relative(points):
            low, high = self.cell(point)
            stored = ((self.xyz >= low) & (self.xyz < high)).all(axis=1)
            if not (stored & self.live).any():
                self.xyz, self.live = self.xyz[~stored], self.live[~stored]
                self.append(point[None])

    def in_box(self, lo: ArrayLike, hi: ArrayLike) -> NDArray[np.bool_]:
        xyz = self.xyz.astype(float)
        return ((xyz >= np.asarray(lo) - self.origin) & (xyz < np.asarray(hi) - self.origin)).all(axis=1)

    def delete(self, chosen: NDArray[np.bool_]) -> int:
        deleted = int(np.sum(chosen & self.live))
        self.live &= ~chosen
        self.revivable += deleted
        if self.revivable > self.delete_ratio * (self.live.sum() + self.revivable):
            self.xyz, self.live = self.xyz[self.live], self.live[self.live]
            self.revivable = 0
        return deleted

    def delete_box(self, lo: ArrayLike, hi: ArrayLike) -> int:
        return self.delete(self.in_box(lo, hi))

    def delete_points(self, points: ArrayLike) -> int:
        chosen = np.zeros(len(self.xyz), bool)
        for point in self.relative(points):
            chosen |= (np.abs(self.xyz.astype(float) - point.astype(float)) <= DELETE_TOLERANCE).all(axis=1)
        return self.delete(chosen)

    def reinsert_box(self, lo: ArrayLike, hi: ArrayLike) -> int:
        chosen = self.in_box(lo, hi) & ~self.live
        self.live |= chosen
        self.revivable -= int(chosen.sum())
        return int(chosen.sum())

    def world(self, xyz: NDArray[np.float32]) -> NDArray[np.float64]:
        return xyz[np.lexsort(xyz.T[::-1])].astype(float) + self.origin

    def points(self) -> NDArray[np.float64]:
        return self.world(self.xyz[self.live])

    def box_search(self, lo: ArrayLike, hi: ArrayLike) -> NDArray[np.float64]:
        return self.world(self.xyz[self.in_box(lo, hi) & self.live])

    def radius_search(self, center: ArrayLike, radius: float) -> NDArray[np.float64]:
        offset = self.xyz - (np.asarray(center) - self.origin).astype(np.float32)
        return self.world(self.xyz[(squares(offset) <= radius**2) & self.live])

    def nearest(self, queries: ArrayLike, k: int, limit: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        live = self.xyz[self.live]
        relative = (np.asarray(queries) - self.origin).astype(np.float32)
        distances, points = np.full((len(relative), k), np.inf), np.full((len(relative), k, 3), np.nan)
        for row, query in enumerate(relative):
            sq = squares(live - query)
            order = np.lexsort((*live.T[::-1], sq))
            order = order[sq[order].astype(float) <= limit**2][:k]
            distances[row, : len(order)] = np.sqrt(sq[order].astype(float))
            points[row, : len(order)] = live[order].astype(float) + self.origin
        return distances, points


def squares(offsets: NDArray[np.float32]) -> NDArray[np.float32]:
    """Squared lengths in float32, added in the order x, y, z."""
    x, y, z = np.moveaxis(offsets, -1, 0)
    return x * x + y * y + z * z
