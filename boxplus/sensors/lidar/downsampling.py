"""Voxel filter of a scan: a centroid and a representative point for every occupied voxel (docs/lidar_inertial_odometry.md).

The centroid carries the least noise and is what the scan is measured with. At an edge or a corner it lies off every
surface, so what the map takes is a point that was really seen: the one nearest to the centroid.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError

# What belongs to an occupied voxel lies together: sum or mean of its points, how many they are, which voxel it is, and the
# point nearest to the mean (its squared distance, as bits, above its index: the least number is the nearest, then the first).
_VOXEL = np.dtype(
    [(name, np.float32) for name in ("x", "y", "z", "count")] + [("key", np.uint64), ("nearest", np.uint64)], align=True
)
_EMPTY = np.uint32(0xFFFFFFFF)
_NONE = np.uint64(0xFFFFFFFFFFFFFFFF)
_INDEX = np.uint64(0xFFFFFFFF)
_CELL = np.int64(0x1FFFFF)  # 21 bits an axis
_ZERO, _ONE, _TWO, _THREE = np.uint64(0), np.uint64(1), np.uint64(2), np.uint64(3)
_Y_BITS, _Z_BITS, _DISTANCE_BITS = np.uint64(21), np.uint64(42), np.uint64(32)
_SPREAD = np.uint64(0x9E3779B97F4A7C15)  # an odd factor whose product's upper bits depend on all bits of a key


@kernel
def voxel_centroids(
    points: NDArray[np.float32],
    inverse_size: float,
    keys: NDArray[np.uint64],
    table: NDArray[np.uint32],
    shift: np.uint64,
    voxels: NDArray[np.void],
    voxel_of: NDArray[np.uint32],
) -> np.int64:
    """Centroids of the occupied voxels, in the order in which the voxels are first seen; returns their number.

    Returns −1 when the table would be more than half full; call again with a larger one.

    Args:
        points: (3 n,), point by point; inverse_size: one over the voxel's side [1/m].
        keys: (at least n,) scratch; voxel_of: (at least n,) receives the voxel of each point.
        table: (2^(64 − shift),) scratch; voxels: (half of that,) `_VOXEL`, receives the voxels.
    """
    total = np.uint64(points.shape[0]) // _THREE
    for n in range(total):
        i = _THREE * n
        x = np.uint64(np.int64(math.floor(points[i] * inverse_size)) & _CELL)
        y = np.uint64(np.int64(math.floor(points[i + _ONE] * inverse_size)) & _CELL)
        z = np.uint64(np.int64(math.floor(points[i + _TWO] * inverse_size)) & _CELL)
        keys[n] = x | (y << _Y_BITS) | (z << _Z_BITS)
    table[:] = _EMPTY
    mask = np.uint64(table.shape[0]) - _ONE
    most = np.uint64(voxels.shape[0])
    used = np.uint64(0)
    end = np.uint64(0)
    while end < total:
        begin, i = end, _THREE * end
        key, sum_x, sum_y, sum_z = keys[end], points[i], points[i + _ONE], points[i + _TWO]
        end += _ONE
        while end < total and keys[end] == key:  # neighbours in a scan often share their voxel
            i = _THREE * end
            sum_x += points[i]
            sum_y += points[i + _ONE]
            sum_z += points[i + _TWO]
            end += _ONE
        slot = (key * _SPREAD) >> shift
        while table[slot] != _EMPTY and voxels[table[slot]]["key"] != key:
            slot = (slot + _ONE) & mask
        if table[slot] == _EMPTY:
            if used == most:
                return np.int64(-1)
            table[slot] = np.uint32(used)
            voxel = voxels[used]
            voxel["key"] = key
            voxel["x"], voxel["y"], voxel["z"], voxel["count"] = sum_x, sum_y, sum_z, np.float32(end - begin)
            used += _ONE
        else:
            voxel = voxels[table[slot]]
            sum_x, sum_y, sum_z = voxel["x"] + sum_x, voxel["y"] + sum_y, voxel["z"] + sum_z
            count = voxel["count"] + np.float32(end - begin)
            voxel["x"], voxel["y"], voxel["z"], voxel["count"] = sum_x, sum_y, sum_z, count
        for k in range(begin, end):
            voxel_of[k] = table[slot]
    for k in range(used):
        voxel = voxels[k]
        share = np.float32(1.0) / voxel["count"]
        voxel["x"] *= share
        voxel["y"] *= share
        voxel["z"] *= share
        voxel["nearest"] = _NONE
    for n in range(total):
        i = _THREE * n
        voxel = voxels[voxel_of[n]]
        dx, dy, dz = points[i] - voxel["x"], points[i + _ONE] - voxel["y"], points[i + _TWO] - voxel["z"]
        distance = np.float32(dx * dx + dy * dy + dz * dz)
        voxel["nearest"] = min(voxel["nearest"], (np.uint64(distance.view(np.uint32)) << _DISTANCE_BITS) | n)
    return np.int64(used)


@kernel
def _collect(
    points: NDArray[np.float32], voxels: NDArray[np.void], centroids: NDArray[np.float32], representatives: NDArray[np.float32]
) -> None:
    """Centroids (m, 3) and representatives (m, 3) of the first m voxels, from the points (3 n,)."""
    for k in range(np.uint64(centroids.shape[0])):
        voxel = voxels[k]
        centroids[k, _ZERO], centroids[k, _ONE], centroids[k, _TWO] = voxel["x"], voxel["y"], voxel["z"]
        i = _THREE * (voxel["nearest"] & _INDEX)
        for axis in range(_THREE):
            representatives[k, axis] = points[i + axis]


@kernel
def _add_up(voxel_of: NDArray[np.uint32], values: NDArray[np.float64], sums: NDArray[np.float64]) -> None:
    """sums (m, k) += values (n, k) of the points of each voxel."""
    for n in range(np.uint64(values.shape[0])):
        voxel = voxel_of[n]
        for axis in range(np.uint64(values.shape[1])):
            sums[voxel, axis] += values[n, axis]


class VoxelFilter:
    """Thins scans; keeps its scratch memory from scan to scan.

    With `max_points` the voxels adapt to the surroundings: where a scan leaves more, they grow for the next one, and shrink
    back to `voxel_size` where there are fewer.

    Args:
        voxel_size: side of a voxel, the least one [m].
        max_points: how many voxels a scan should have at most, or None.

    Raises:
        InputError: `voxel_size` is not positive.
    """

    def __init__(self, voxel_size: float, max_points: int | None = None) -> None:
        if not (np.isfinite(voxel_size) and voxel_size > 0):
            raise InputError("voxel_size as a positive length in metres", f"{voxel_size}", "typical values are 0.2 to 1.0")
        self.voxel_size = voxel_size
        self._least = voxel_size
        self._max_points = max_points
        self._used = 0
        self._points = 0
        self._set_table_bits(13)
        self._reserve(1024)

    def _set_table_bits(self, bits: int) -> None:
        self._table_bits = bits
        self._table = np.zeros(1 << bits, dtype=np.uint32)
        self._voxels = np.zeros(1 << (bits - 1), dtype=_VOXEL)

    def _reserve(self, points: int) -> None:
        self._keys = np.zeros(points, dtype=np.uint64)
        self._voxel_of = np.zeros(points, dtype=np.uint32)

    def __call__(self, points: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Centroids and representatives, (m, 3) float32 each, of `points` (n, 3) float32.

        The points must be finite and within ±2^20 voxels of the origin.
        """
        if len(points) > len(self._keys):
            self._reserve(2 * len(points))
        flat, used = points.reshape(-1), -1
        while used < 0:
            shift = np.uint64(64 - self._table_bits)
            inverse_size = 1.0 / self.voxel_size
            used = int(voxel_centroids(flat, inverse_size, self._keys, self._table, shift, self._voxels, self._voxel_of))
            if used < 0:
                self._set_table_bits(self._table_bits + 1)
        if self._max_points is not None:
            # Surfaces fill voxels with the square of their size.
            fitting = self.voxel_size * (used / self._max_points) ** 0.5
            self.voxel_size = max(self._least, 0.5 * (self.voxel_size + fitting))
        self._used, self._points = used, len(points)
        centroids, representatives = np.empty((used, 3), np.float32), np.empty((used, 3), np.float32)
        _collect(flat, self._voxels, centroids, representatives)
        return centroids, representatives

    @property
    def representatives(self) -> NDArray[np.int64]:
        """(m,) which points of the last call the representatives were."""
        return (self._voxels["nearest"][: self._used] & _INDEX).astype(np.int64)

    def means(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Means (m, k) over the voxels of the last call of something (n, k) else that its points have."""
        sums = np.zeros((self._used, values.shape[1]))
        _add_up(self._voxel_of[: self._points], values, sums)
        sums /= self._voxels["count"][: self._used, None]
        return sums
