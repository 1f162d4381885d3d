"""Voxel filter of a scan: a centroid and a representative point for every occupied voxel (SPEC.md 9.11, step 5).

The centroid carries the least noise and is what the scan is measured with. At an edge or a corner it lies off every
surface, so what the map takes is a point that was really seen: the one nearest to the centroid.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError

_EMPTY = np.int32(-1)
# Large odd factors spread neighbouring voxels over the table.
_HASH_X, _HASH_Y, _HASH_Z = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xC2B2AE3D27D4EB4F), np.uint64(0x165667B19E3779F9)


@kernel
def voxel_centroids(
    points: NDArray[np.float32],
    inverse_size: float,
    table: NDArray[np.int32],
    keys: NDArray[np.int64],
    sums: NDArray[np.float32],
    counts: NDArray[np.int32],
    voxel_of: NDArray[np.int32],
    nearest: NDArray[np.int32],
    distances: NDArray[np.float32],
) -> int:
    """Centroids of the occupied voxels, in the order in which the voxels are first seen; returns their number.

    Returns −1 when the table would be more than half full; call again with a larger one.

    Args:
        points: (n, 3); inverse_size: one over the voxel's side [1/m].
        table: (a power of two,) filled with −1; keys: (n,), sums: (n, 3), counts: (n,) scratch.
        sums: receives the centroids.
        voxel_of: (n,) receives the voxel of each point; nearest: (n,) the point nearest to each centroid;
            distances: (n,) scratch.
    """
    mask = np.uint64(table.shape[0] - 1)
    most = table.shape[0] // 2
    used = 0
    voxel: np.int32 | int = _EMPTY
    last_key = np.int64(-1)
    for n in range(points.shape[0]):
        ix = np.int64(math.floor(points[n, 0] * inverse_size))
        iy = np.int64(math.floor(points[n, 1] * inverse_size))
        iz = np.int64(math.floor(points[n, 2] * inverse_size))
        key = (ix & 0x1FFFFF) | ((iy & 0x1FFFFF) << 21) | ((iz & 0x1FFFFF) << 42)
        if key == last_key:  # neighbours in a scan mostly share their voxel
            sums[voxel, 0] += points[n, 0]
            sums[voxel, 1] += points[n, 1]
            sums[voxel, 2] += points[n, 2]
            counts[voxel] += 1
            voxel_of[n] = voxel
            continue
        last_key = key
        mixed = np.uint64(ix) * _HASH_X ^ np.uint64(iy) * _HASH_Y ^ np.uint64(iz) * _HASH_Z
        slot = (mixed ^ (mixed >> np.uint64(29))) & mask
        while True:
            voxel = table[slot]
            if voxel == _EMPTY:
                if used == most:
                    return -1
                voxel = np.int32(used)
                table[slot] = voxel
                keys[used] = key
                sums[used, 0] = points[n, 0]
                sums[used, 1] = points[n, 1]
                sums[used, 2] = points[n, 2]
                counts[used] = 1
                used += 1
                break
            if keys[voxel] == key:
                sums[voxel, 0] += points[n, 0]
                sums[voxel, 1] += points[n, 1]
                sums[voxel, 2] += points[n, 2]
                counts[voxel] += 1
                break
            slot = (slot + np.uint64(1)) & mask
        voxel_of[n] = voxel
    for voxel in range(used):
        share = np.float32(1.0) / np.float32(counts[voxel])
        sums[voxel, 0] *= share
        sums[voxel, 1] *= share
        sums[voxel, 2] *= share
        distances[voxel] = np.float32(np.inf)
    for n in range(points.shape[0]):
        voxel = voxel_of[n]
        dx, dy, dz = points[n, 0] - sums[voxel, 0], points[n, 1] - sums[voxel, 1], points[n, 2] - sums[voxel, 2]
        distance = dx * dx + dy * dy + dz * dz
        if distance < distances[voxel]:
            distances[voxel] = distance
            nearest[voxel] = n
    return used


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
        self._table = np.full(8192, _EMPTY, dtype=np.int32)
        self._reserve(1024)

    def _reserve(self, points: int) -> None:
        self._keys = np.zeros(points, dtype=np.int64)
        self._sums = np.zeros((points, 3), dtype=np.float32)
        self._counts = np.zeros(points, dtype=np.int32)
        self._voxel_of = np.zeros(points, dtype=np.int32)
        self._nearest = np.zeros(points, dtype=np.int32)
        self._distances = np.zeros(points, dtype=np.float32)

    def __call__(self, points: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Centroids and representatives, (m, 3) float32 each, of `points` (n, 3) float32.

        The points must be finite and within ±2^20 voxels of the origin.
        """
        if len(points) > len(self._counts):
            self._reserve(2 * len(points))
        used = -1
        while used < 0:
            self._table.fill(_EMPTY)
            used = voxel_centroids(
                points,
                1.0 / self.voxel_size,
                self._table,
                self._keys,
                self._sums,
                self._counts,
                self._voxel_of,
                self._nearest,
                self._distances,
            )
            if used < 0:
                self._table = np.full(2 * len(self._table), _EMPTY, dtype=np.int32)
        if self._max_points is not None:
            # Surfaces fill voxels with the square of their size.
            fitting = self.voxel_size * (used / self._max_points) ** 0.5
            self.voxel_size = max(self._least, 0.5 * (self.voxel_size + fitting))
        return self._sums[:used].copy(), points[self._nearest[:used]]
