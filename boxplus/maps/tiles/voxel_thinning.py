"""One point per voxel: exactly, for points in memory, and with a fixed amount of memory, for an endless stream."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

_WAYS = 4  # entries per bucket of the stream filter: one half of a cache line


def first_per_voxel(points: NDArray[np.float32], voxel: float) -> NDArray[np.intp]:
    """Rows of the first point in each voxel of a grid through the origin, in their order.

    Args:
        points: (N, 3 or more) float32 [m]; only the first three columns count. Their extent must be below 2²¹ voxels.
        voxel: edge of the voxels [m].
    """
    if not len(points):
        return np.empty(0, dtype=np.intp)
    cell = np.floor(points[:, :3].astype(np.float64) * (1.0 / voxel)).astype(np.int64)
    cell -= cell.min(axis=0)
    _, first = np.unique(cell[:, 0] | cell[:, 1] << 21 | cell[:, 2] << 42, return_index=True)
    return np.sort(first)


@kernel
def _mark_new(points, inverse_voxel, table, keep):  # type: ignore[no-untyped-def]
    """Set `keep[i]` where the voxel of point i is not among the recent ones in `table`, and remember it there."""
    buckets = np.uint64(table.shape[0]) - np.uint64(1)
    for i in range(np.uint64(points.shape[0])):
        x = np.uint64(np.int64(math.floor(points[i, 0] * inverse_voxel)))
        y = np.uint64(np.int64(math.floor(points[i, 1] * inverse_voxel)))
        z = np.uint64(np.int64(math.floor(points[i, 2] * inverse_voxel)))
        # A sum, not an exclusive or: that would confuse (x, y) with (−x, −y). Different voxels of a map share all 64 bits
        # about once in 10^19 pairs; one point less is then the only harm.
        key = x * np.uint64(0x9E3779B97F4A7C15) + y * np.uint64(0xC2B2AE3D27D4EB4F) + z * np.uint64(0x165667B19E3779F9)
        key = (key ^ key >> np.uint64(31)) * np.uint64(0xBF58476D1CE4E5B9)
        key ^= key >> np.uint64(29)
        bucket = key & buckets
        known = False
        for way in range(np.uint64(_WAYS)):
            if table[bucket, way] == key:
                known = True
        keep[i] = not known
        if not known:
            for way in range(np.uint64(_WAYS - 1), np.uint64(0), -1):
                table[bucket, way] = table[bucket, way - np.uint64(1)]
            table[bucket, np.uint64(0)] = key


class RecentVoxels:
    """Drops the points of a stream whose voxel already has a point, as far as a fixed memory remembers.

    It forgets the voxels that were added longest ago when its table is full; a point may therefore pass twice, but none is lost.

    Args:
        voxel: edge of the voxels [m].
        capacity_bits: the table remembers up to 2 to this power voxels, at 8 bytes each.
    """

    def __init__(self, voxel: float, capacity_bits: int = 21) -> None:
        self.voxel = voxel
        self._table = np.full((2**capacity_bits // _WAYS, _WAYS), 2**64 - 1, dtype=np.uint64)  # no voxel has this key

    def new(self, points: NDArray[np.float32]) -> NDArray[np.bool_]:
        """(N,) mask of the points whose voxel is new, for (N, 3 or more) float32 contiguous finite points [m]."""
        keep = np.empty(len(points), dtype=np.bool_)
        with np.errstate(over="ignore"):  # the hash wraps around on purpose; seen only when the kernel runs uncompiled
            _mark_new(points, 1.0 / self.voxel, self._table, keep)
        return keep
