"""Sums of points, and of their products, in the voxels of a grid: what planes and thicknesses need, without the points.

A voxel keeps ten numbers, of points x relative to its middle: their count, Σ x, and the upper triangle of Σ x xᵀ. Voxels are
found by open addressing on their three integer coordinates.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

COUNT, SUM, SQUARES = 0, 1, 4
SUMS = 10
EMPTY = np.int64(-1)
_BITS = 21
_OFFSET = 1 << (_BITS - 1)
_MASK = (1 << _BITS) - 1
_FIRST_CAPACITY = 1 << 14
_LOAD = 0.6


@kernel(inline=True)
def key_of(x: float, y: float, z: float, cell: float) -> int:
    """The voxel of a point as one number; −1 for one that is not finite or farther than 2²⁰ voxels from the origin."""
    i, j, k = np.floor(x / cell), np.floor(y / cell), np.floor(z / cell)
    if not (abs(i) < _OFFSET and abs(j) < _OFFSET and abs(k) < _OFFSET):
        return -1
    a, b, c = np.int64(i) + _OFFSET, np.int64(j) + _OFFSET, np.int64(k) + _OFFSET
    return int((a << (2 * _BITS)) | (b << _BITS) | c)


@kernel(inline=True)
def slot_of(key: int, keys: NDArray[np.int64]) -> int:
    """Where a voxel is in the table, or the empty place where it belongs."""
    mask = np.uint64(keys.shape[0] - 1)
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot = (mixed >> np.uint64(20)) & mask
    while keys[slot] != EMPTY and keys[slot] != key:
        slot = (slot + np.uint64(1)) & mask
    return int(slot)


@kernel(inline=True)
def add_point(total: NDArray[np.float64], x: float, y: float, z: float) -> None:
    """Add one point to the sums (10,) of 1, x, y, z and of their six products."""
    total[0] += 1.0
    total[1] += x
    total[2] += y
    total[3] += z
    total[4] += x * x
    total[5] += x * y
    total[6] += x * z
    total[7] += y * y
    total[8] += y * z
    total[9] += z * z


@kernel
def _add(
    points: NDArray[np.float32],
    R: NDArray[np.float64],
    p: NDArray[np.float64],
    cell: float,
    group: int,
    keys: NDArray[np.int64],
    sums: NDArray[np.float64],
    groups: NDArray[np.int32],
) -> int:
    """Add points (n, 3) at R x + p; returns how many voxels are new."""
    fresh = 0
    for n in range(points.shape[0]):
        a, b, c = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + p[0]
        y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + p[1]
        z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + p[2]
        key = key_of(x, y, z, cell)
        if key == EMPTY:
            continue
        slot = slot_of(key, keys)
        if keys[slot] == EMPTY:
            keys[slot] = key
            groups[slot, 0] = group
            fresh += 1
        groups[slot, 1] = group
        x -= (np.floor(x / cell) + 0.5) * cell
        y -= (np.floor(y / cell) + 0.5) * cell
        z -= (np.floor(z / cell) + 0.5) * cell
        add_point(sums[slot], x, y, z)
    return fresh


@kernel
def _move(
    keys: NDArray[np.int64],
    sums: NDArray[np.float64],
    groups: NDArray[np.int32],
    new_keys: NDArray[np.int64],
    new_sums: NDArray[np.float64],
    new_groups: NDArray[np.int32],
) -> None:
    for old in range(keys.shape[0]):
        if keys[old] != EMPTY:
            slot = slot_of(keys[old], new_keys)
            new_keys[slot] = keys[old]
            new_sums[slot] = sums[old]
            new_groups[slot] = groups[old]


class VoxelSums:
    """Sums of points in voxels, in memory that grows with the voxels and not with the points.

    Args:
        cell: edge of a voxel [m].

    Attributes:
        keys: (capacity,) int64, −1 where a place is empty; sums: (capacity, 10).
        groups: (capacity, 2) int32, the first and the last group of points that came into the voxel.
        count: voxels.
    """

    def __init__(self, cell: float) -> None:
        self.cell, self.count = cell, 0
        self.keys, self.sums, self.groups = self._empty(_FIRST_CAPACITY)

    def add(self, points: NDArray[np.float32], R: NDArray[np.float64], p: NDArray[np.float64], group: int = 0) -> None:
        """Add points (n, 3), placed by R (3, 3) and p (3,); groups come in ascending order."""
        capacity = len(self.keys)
        while self.count + len(points) > _LOAD * capacity:
            capacity *= 2
        if capacity > len(self.keys):
            grown = self._empty(capacity)
            _move(self.keys, self.sums, self.groups, *grown)
            self.keys, self.sums, self.groups = grown
        self.count += _add(points, R, p, self.cell, group, self.keys, self.sums, self.groups)

    def filled(self) -> NDArray[np.int64]:
        """Places of the voxels, in the order of their keys: independent of how the table grew."""
        slots = np.flatnonzero(self.keys != EMPTY)
        return slots[np.argsort(self.keys[slots])]

    @staticmethod
    def _empty(capacity: int) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int32]]:
        return np.full(capacity, EMPTY), np.zeros((capacity, SUMS)), np.zeros((capacity, 2), dtype=np.int32)


def coordinates(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """(n, 3) integer coordinates of voxels."""
    return np.stack([(keys >> (_BITS * shift)) & _MASK for shift in (2, 1, 0)], axis=1) - _OFFSET


def pack(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """(n,) keys of voxels by their coordinates (n, 3)."""
    x, y, z = (cells + _OFFSET).T
    keys: NDArray[np.int64] = (x << (2 * _BITS)) | (y << _BITS) | z
    return keys


def shifted(sums: NDArray[np.float64], by: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums (n, 10) of the same points after all of them moved by (n, 3)."""
    moved = sums.copy()
    count, total = sums[:, :1], sums[:, SUM:SQUARES]
    moved[:, SUM:SQUARES] += count * by
    for place, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        moved[:, SQUARES + place] += total[:, i] * by[:, j] + by[:, i] * total[:, j] + count[:, 0] * by[:, i] * by[:, j]
    return moved


def moments(sums: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean (n, 3) and covariance (n, 3, 3) of the points of sums (n, 10), over their number."""
    count = np.maximum(sums[:, COUNT], 1.0)
    mean = sums[:, SUM:SQUARES] / count[:, None]
    square = sums[:, SQUARES:][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3) / count[:, None, None]
    return mean, square - mean[:, :, None] * mean[:, None, :]


def clusters(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Σ [x; 1][x; 1]ᵀ (n, 4, 4) of sums (n, 10)."""
    C = np.empty((len(sums), 4, 4))
    C[:, :3, :3] = sums[:, SQUARES:][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    C[:, :3, 3] = C[:, 3, :3] = sums[:, SUM:SQUARES]
    C[:, 3, 3] = sums[:, COUNT]
    return C
