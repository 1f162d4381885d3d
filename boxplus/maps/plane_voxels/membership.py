"""Which points lie on which planes, and their sums, scan by scan (`PlaneMap`).

Voxels that a plane is in, and those beside them, lie in blocks of 4 × 4 × 4 that are found by open addressing: points that are
near each other are looked up in the same few lines of the cache, and those far from any plane in one step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.maps.plane_voxels.voxel_sums import EMPTY, add_point, coordinates, pack, slot_of

_SHIFT = 2
_EDGE = 1 << _SHIFT
_VOXELS = _EDGE**3
_BITS, _OFFSET = 21, 1 << 20  # of a coordinate in a key, as in `voxel_sums`
_FIRST_CAPACITY = 1 << 10
_LOAD = 0.5
_ROUNDING = 1.000001  # of a reach in single precision


@dataclass(frozen=True, slots=True, eq=False)
class PlaneBlocks:
    """Planes by voxels, in B blocks.

    Attributes:
        keys: (capacity,) of blocks, `EMPTY` where there is none; block: (capacity,) int32, their numbers.
        plane: (B, 64) int32, of each voxel, −1 for none.
        reach: (B, 64) float32, how far from a face a point of the voxel may lie to be on another plane beyond it [m].
    """

    keys: NDArray[np.int64]
    block: NDArray[np.int32]
    plane: NDArray[np.int32]
    reach: NDArray[np.float32]

    @classmethod
    def of(cls, voxels: NDArray[np.int64], plane_of: NDArray[np.int32], gate: NDArray[np.float64]) -> Self:
        """From keys (v,) of voxels, the plane (v,) of each, and how far from each plane a point may lie on it (P,) [m]."""
        cells = coordinates(voxels)
        capacity, count = _FIRST_CAPACITY, -1
        while capacity < len(np.unique(pack(cells >> _SHIFT))) / _LOAD:
            capacity *= 2
        while count < 0:  # beside them there are more
            keys, block = np.full(capacity, EMPTY), np.zeros(capacity, dtype=np.int32)
            count, capacity = _number_blocks(cells, int(_LOAD * capacity), keys, block), 2 * capacity
        blocks = cls(keys, block, np.full((count, _VOXELS), -1, dtype=np.int32), np.zeros((count, _VOXELS), dtype=np.float32))
        _fill(cells, plane_of, gate, keys, block, blocks.plane, blocks.reach)
        return blocks


@kernel(inline=True)
def _key(i: int, j: int, k: int) -> int:
    """Of the block of a voxel."""
    a, b, c = (i >> _SHIFT) + _OFFSET, (j >> _SHIFT) + _OFFSET, (k >> _SHIFT) + _OFFSET
    return int((a << (2 * _BITS)) | (b << _BITS) | c)


@kernel(inline=True)
def _inside(i: int, j: int, k: int) -> int:
    """The place of a voxel in its block."""
    return int((((i & 3) << _SHIFT) | (j & 3)) << _SHIFT | (k & 3))


@kernel(inline=True)
def _block_of(i: int, j: int, k: int, keys: NDArray[np.int64], block: NDArray[np.int32]) -> int:
    """The number of the block of a voxel; −1 for none."""
    key = _key(i, j, k)
    slot = slot_of(key, keys)
    return int(block[slot]) if keys[slot] == key else -1


@kernel
def _number_blocks(cells: NDArray[np.int64], most: int, keys: NDArray[np.int64], block: NDArray[np.int32]) -> int:
    """Number the blocks of voxels (v, 3) and of those beside them; −1 where there are more than `most`."""
    count = 0
    for n in range(cells.shape[0]):
        for side in range(7):
            i, j, k = cells[n, 0], cells[n, 1], cells[n, 2]
            step = 1 if side % 2 == 0 else -1
            i, j, k = i + step * (side // 2 == 0), j + step * (side // 2 == 1), k + step * (side // 2 == 2)
            key = _key(i, j, k)
            slot = slot_of(key, keys)
            if keys[slot] != key:
                if count == most:
                    return -1
                keys[slot], block[slot] = key, count
                count += 1
    return count


@kernel
def _fill(
    cells: NDArray[np.int64],
    plane_of: NDArray[np.int32],
    gate: NDArray[np.float64],
    keys: NDArray[np.int64],
    block: NDArray[np.int32],
    plane: NDArray[np.int32],
    reach: NDArray[np.float32],
) -> None:
    for n in range(cells.shape[0]):
        i, j, k = cells[n, 0], cells[n, 1], cells[n, 2]
        plane[_block_of(i, j, k, keys, block), _inside(i, j, k)] = plane_of[n]
    for n in range(cells.shape[0]):
        own, far = plane_of[n], np.float32(gate[plane_of[n]] * _ROUNDING)
        for side in range(6):
            i, j, k = cells[n, 0], cells[n, 1], cells[n, 2]
            step = 1 if side % 2 == 0 else -1
            i, j, k = i + step * (side // 2 == 0), j + step * (side // 2 == 1), k + step * (side // 2 == 2)
            there, at = _block_of(i, j, k, keys, block), _inside(i, j, k)
            if plane[there, at] != own:
                reach[there, at] = max(reach[there, at], far)


@kernel
def _member_of(
    x: float,
    y: float,
    z: float,
    cell: float,
    keys: NDArray[np.int64],
    block: NDArray[np.int32],
    plane_in: NDArray[np.int32],
    reach_in: NDArray[np.float32],
    planes: NDArray[np.float64],
    centres: NDArray[np.float64],
    gate: NDArray[np.float64],
) -> int:
    """The only plane whose voxels hold the foot of a point that is near enough; −1 for none or several."""
    s, t, u = x / cell, y / cell, z / cell
    if not (abs(s) < _OFFSET - 2 and abs(t) < _OFFSET - 2 and abs(u) < _OFFSET - 2):
        return -1
    i, j, k = np.int64(np.floor(s)), np.int64(np.floor(t)), np.int64(np.floor(u))
    here = _block_of(i, j, k, keys, block)
    if here < 0:
        return -1
    reach = np.float64(reach_in[here, _inside(i, j, k)])
    member = -1
    for side in range(4):
        a, b, c = i, j, k
        if side > 0:
            # Over the nearest face of the voxel on one axis, where a plane beyond it may be near enough.
            inside = s - i if side == 1 else (t - j if side == 2 else u - k)
            if min(inside, 1.0 - inside) * cell > reach:
                continue
            step = 1 if inside > 0.5 else -1
            a, b, c = i + step * (side == 1), j + step * (side == 2), k + step * (side == 3)
        there = _block_of(a, b, c, keys, block)
        if there < 0:
            continue
        plane = plane_in[there, _inside(a, b, c)]
        if plane < 0 or plane == member:
            continue
        n, q = planes[plane], centres[plane]
        distance = n[0] * (x - q[0]) + n[1] * (y - q[1]) + n[2] * (z - q[2]) + n[3]
        if not abs(distance) <= gate[plane]:
            continue
        a = np.int64(np.floor((x - distance * n[0]) / cell))
        b = np.int64(np.floor((y - distance * n[1]) / cell))
        c = np.int64(np.floor((z - distance * n[2]) / cell))
        there = _block_of(a, b, c, keys, block)
        if there >= 0 and plane_in[there, _inside(a, b, c)] == plane:
            if member >= 0:
                return -1
            member = plane
    return member


@kernel
def sum_on_planes(
    points: NDArray[np.float32],
    begin: NDArray[np.int64],
    R: NDArray[np.float64],
    p: NDArray[np.float64],
    cell: float,
    keys: NDArray[np.int64],
    block: NDArray[np.int32],
    plane_in: NDArray[np.int32],
    reach_in: NDArray[np.float32],
    planes: NDArray[np.float64],
    centres: NDArray[np.float64],
    gate: NDArray[np.float64],
    is_one_sided: bool,
    place: NDArray[np.int64],
    scan: NDArray[np.int64],
    plane: NDArray[np.int64],
    sums: NDArray[np.float64],
) -> int:
    """Sums (10,) of the points of each scan on each plane, as given; returns how many there are.

    Args:
        points: (n, 3), those of scan m are [begin[m], begin[m + 1]), placed by R[m], p[m].
        is_one_sided: leave planes out that p[m] lies behind.
        place: (P,) −1, scratch. sums: zero.
        scan, plane, sums: receive them, scan by scan, in the order in which planes are met.
    """
    count = 0
    for m in range(begin.shape[0] - 1):
        first, T, q = count, R[m], p[m]
        for n in range(begin[m], begin[m + 1]):
            a, b, c = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
            x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + q[0]
            y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + q[1]
            z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + q[2]
            own = _member_of(x, y, z, cell, keys, block, plane_in, reach_in, planes, centres, gate)
            if own < 0 or (is_one_sided and height_above(own, q, planes, centres) <= 0.0):
                continue
            if place[own] < first:
                place[own] = count
                scan[count], plane[count] = m, own
                count += 1
            add_point(sums[place[own]], a, b, c)
    return count


@kernel(inline=True)
def height_above(plane: int, p: NDArray[np.float64], planes: NDArray[np.float64], centres: NDArray[np.float64]) -> float:
    """How far p (3,) lies before a plane, by its normal."""
    u, q = planes[plane], centres[plane]
    return float(u[0] * (p[0] - q[0]) + u[1] * (p[1] - q[1]) + u[2] * (p[2] - q[2]) + u[3])
