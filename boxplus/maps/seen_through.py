"""Which parts of a map were not there all the time: voxels that the rays of another time went through (docs/sessions.md).

A ray proves that what lies between its origin and its end was free. It counts against a voxel only where it passes near the
middle of the voxel's points and clearly goes on behind them:

- where the points lie on a plane, origin and end are on different sides of it, the end well behind, and the ray does not graze
  it. Ground seen at a flat angle from afar is crossed by no ray that ends on the ground;
- elsewhere, the end lies a metre behind.

Evidence is gathered stretch by stretch. A stretch in which the voxel, or one beside it, was hit says nothing against it: hedges
and fences are hit and seen through at once.

Source: Hornung, Wurm, Bennewitz, Stachniss and Burgard, OctoMap, Autonomous Robots 2013 (rays through occupied voxels, and what
they do to ground at flat angles).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from boxplus._arguments import as_settings
from boxplus._jit import kernel
from boxplus._settings import Settings

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

_OFFSET = 1 << 20  # voxels on either side of the origin that a key has room for
_FLAT = 0.15  # of the smallest spread of points to the next one, for a plane
_FEWEST = 6  # points a plane is fitted to
_NEIGHBOURS = np.array([(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)], dtype=np.int64)


class SeenThroughConfig(Settings):
    """What makes a voxel one that was seen through.

    Raises:
        InputError: a setting is unknown or out of range.
    """

    voxel: float = Field(0.2, gt=0, description="side of the voxels that are kept or removed as a whole [m]")
    max_range: float = Field(40.0, gt=0, description="longer rays are cut here: their ends are not known to a voxel [m]")
    behind: float = Field(0.3, gt=0, description="a ray ends this far behind a plane that it went through, at least [m]")
    behind_loose: float = Field(1.0, gt=0, description="and this far behind points that are no plane [m]")
    incidence: float = Field(0.17, ge=0, lt=1, description="sine of the angle between ray and plane, at least")
    least_rays: int = Field(6, ge=1, description="through a voxel, in stretches of way in which it was not hit")
    least_stretches: int = Field(2, ge=1, description="of way that these rays come from, at least")


class SeenThrough:
    """Counts, for every voxel of a map, the stretches of way in which it was hit and in which it was seen through.

    Args:
        points: (N, 3) of the whole map, world [m].
        sessions: how many there are; counts are kept for each.

    Attributes:
        middle: (V, 3) mean of the points of each voxel [m].
        hit, through: (sessions, V) stretches of each session in which it was hit, and seen through without being hit.
        rays: (sessions, V) how many went through it in the latter.
    """

    def __init__(self, points: Floats, sessions: int = 1, config: SeenThroughConfig | None = None) -> None:
        self.config = as_settings(SeenThroughConfig, config)
        keys = _keys(points, self.config.voxel)
        self._keys, row, counts = np.unique(keys, return_inverse=True, return_counts=True)
        self.middle = np.stack([np.bincount(row, points[:, a]) for a in range(3)], axis=1) / counts[:, None]
        self._normal = self._planes(points - points[:1], row, counts.astype(np.float64))
        size = 1 << max(int(2 * len(self._keys) - 1).bit_length(), 4)
        self._slots = np.full(size, -1, dtype=np.int64)
        _fill(self._keys, self._slots)
        self.hit = np.zeros((sessions, len(self._keys)), dtype=np.uint16)
        self.through = np.zeros((sessions, len(self._keys)), dtype=np.uint16)
        self.rays = np.zeros((sessions, len(self._keys)), dtype=np.uint32)

    def __len__(self) -> int:
        return len(self._keys)

    def _planes(self, p: Floats, row: Indices, counts: Floats) -> Floats:
        """(V, 3) unit normal of the plane of each voxel and its neighbours; zero where there is none."""
        pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
        sums = np.stack(
            [counts, *[np.bincount(row, p[:, a]) for a in range(3)], *[np.bincount(row, p[:, a] * p[:, b]) for a, b in pairs]]
        )
        total = np.zeros_like(sums)
        for step in _NEIGHBOURS:
            found = self._rows(self._keys + int(step @ np.array([1 << 42, 1 << 21, 1])))
            near = found >= 0
            total[:, near] += sums[:, found[near]]
        mean = total[1:4] / total[0]
        C = np.empty((len(self._keys), 3, 3))
        for (a, b), second in zip(pairs, total[4:], strict=True):
            C[:, a, b] = C[:, b, a] = second / total[0] - mean[a] * mean[b]
        spread, axes = np.linalg.eigh(C)
        is_flat = (total[0] >= _FEWEST) & (spread[:, 0] < _FLAT**2 * spread[:, 1])
        return np.where(is_flat[:, None], axes[:, :, 0], 0.0)

    def _rows(self, keys: Indices) -> Indices:
        """Row of each key, −1 where no voxel has it."""
        at = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        return np.where(self._keys[at] == keys, at, -1)

    def add_stretch(self, session: int, origins: Floats, ends: Floats) -> None:
        """Take the rays of one stretch of way: origins and ends (n, 3), world [m]."""
        c = self.config
        passed = np.zeros(len(self), dtype=np.uint32)
        near = np.zeros(len(self), dtype=np.bool_)
        steps = np.array([1 << 42, 1 << 21, 1], dtype=np.int64)
        keys = np.unique(_keys(ends, c.voxel))
        own = self._rows(keys)
        for step in _NEIGHBOURS:
            rows = self._rows(keys + int(step @ steps))
            near[rows[rows >= 0]] = True
        limits = np.array([c.max_range, c.behind, c.behind_loose, c.incidence])
        _cast(
            np.ascontiguousarray(origins, dtype=np.float64),
            np.ascontiguousarray(ends, dtype=np.float64),
            self._keys,
            self._slots,
            self.middle,
            self._normal,
            c.voxel,
            limits,
            passed,
        )
        self.hit[session, own[own >= 0]] += np.uint16(1)
        passed[near] = 0
        self.through[session] += (passed > 0).astype(np.uint16)
        self.rays[session] += passed

    @property
    def is_moving(self) -> NDArray[np.bool_]:
        """(V,) voxels that were seen through by enough rays, from enough stretches of way."""
        is_often = self.rays.sum(axis=0) >= self.config.least_rays
        return np.asarray(is_often & (self.through.sum(axis=0) >= self.config.least_stretches))

    def is_removed(self, points: Floats) -> NDArray[np.bool_]:
        """(N,) which points (N, 3) [m] lie in such voxels."""
        rows = self._rows(_keys(points, self.config.voxel))
        return np.asarray((rows >= 0) & self.is_moving[rows])

    def changes(self, before: int, after: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(V,) voxels that vanished, and that appeared, between two sessions: hit in one only, seen through in the other."""
        there = self.hit > 0
        free = (self.rays >= self.config.least_rays) & ~there
        return there[before] & free[after], there[after] & free[before]

    def clusters(self, chosen: NDArray[np.bool_], least: int) -> list[NDArray[np.int64]]:
        """Rows of voxels (V,) that are chosen and hang together, one empty voxel between them at most; groups of `least`."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        rows = np.flatnonzero(chosen)
        if not len(rows):
            return []
        keys, pairs = self._keys[rows], []
        reach = [(i, j, k) for i in range(-2, 3) for j in range(-2, 3) for k in range(-2, 3) if (i, j, k) > (0, 0, 0)]
        for i, j, k in reach:
            wanted = keys + (i << 42) + (j << 21) + k
            at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
            found = np.flatnonzero(keys[at] == wanted)
            pairs.append(np.stack([found, at[found]]))
        a, b = np.concatenate(pairs, axis=1)
        count, label = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(len(keys), len(keys))), directed=False)
        groups = [rows[label == n] for n in range(count)]
        return sorted((group for group in groups if len(group) >= least), key=lambda group: (-len(group), int(group[0])))


def _keys(points: Floats, voxel: float) -> Indices:
    """(N,) one number for each voxel, in order of x, then y, then z."""
    index = np.floor(points / voxel).astype(np.int64) + _OFFSET
    return (index[:, 0] << 42) + (index[:, 1] << 21) + index[:, 2]


@kernel(inline=True)
def _slot(key: np.int64, mask: np.uint64) -> np.uint64:
    h = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return (h ^ (h >> np.uint64(29))) & mask


@kernel
def _fill(keys: Indices, slots: Indices) -> None:
    """Put the row of every key into a table of open addresses."""
    mask = np.uint64(len(slots) - 1)
    for row in range(np.uint64(len(keys))):
        at = _slot(keys[row], mask)
        while slots[at] >= 0:
            at = (at + np.uint64(1)) & mask
        slots[at] = np.int64(row)


@kernel
def _cast(
    origins: Floats,
    ends: Floats,
    keys: Indices,
    slots: Indices,
    middle: Floats,
    normal: Floats,
    voxel: float,
    limits: Floats,
    passed: NDArray[np.uint32],
) -> None:
    """Walk every ray through the voxels (Amanatides and Woo, Eurographics 1987) and count those that it clearly went through."""
    mask = np.uint64(len(slots) - 1)
    max_range, behind, behind_loose, incidence = limits[0], limits[1], limits[2], limits[3]
    for n in range(np.uint64(len(ends))):
        ox, oy, oz = origins[n, 0], origins[n, 1], origins[n, 2]
        dx, dy, dz = ends[n, 0] - ox, ends[n, 1] - oy, ends[n, 2] - oz
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length < 1e-6:
            continue
        dx, dy, dz = dx / length, dy / length, dz / length
        reach = min(length, max_range) - behind
        ix, iy, iz = math.floor(ox / voxel), math.floor(oy / voxel), math.floor(oz / voxel)
        sx, sy, sz = (1 if dx > 0 else -1), (1 if dy > 0 else -1), (1 if dz > 0 else -1)
        far = 1e30
        tx = ((ix + (1 if sx > 0 else 0)) * voxel - ox) / dx if abs(dx) > 1e-12 else far
        ty = ((iy + (1 if sy > 0 else 0)) * voxel - oy) / dy if abs(dy) > 1e-12 else far
        tz = ((iz + (1 if sz > 0 else 0)) * voxel - oz) / dz if abs(dz) > 1e-12 else far
        ux = voxel / abs(dx) if abs(dx) > 1e-12 else far
        uy = voxel / abs(dy) if abs(dy) > 1e-12 else far
        uz = voxel / abs(dz) if abs(dz) > 1e-12 else far
        t = 0.0
        while t < reach:
            key = (np.int64(ix + _OFFSET) << 42) + (np.int64(iy + _OFFSET) << 21) + np.int64(iz + _OFFSET)
            at = _slot(key, mask)
            row = slots[at]
            while row >= 0 and keys[row] != key:
                at = (at + np.uint64(1)) & mask
                row = slots[at]
            if row >= 0:
                mx, my, mz = middle[row, 0] - ox, middle[row, 1] - oy, middle[row, 2] - oz
                along = mx * dx + my * dy + mz * dz
                aside = mx * mx + my * my + mz * mz - along * along
                nx, ny, nz = normal[row, 0], normal[row, 1], normal[row, 2]
                if aside <= 0.25 * voxel * voxel:
                    if nx * nx + ny * ny + nz * nz > 0.5:
                        slope = nx * dx + ny * dy + nz * dz
                        here = -(nx * mx + ny * my + nz * mz)  # of the origin, on its side of the plane
                        there = here + slope * length
                        clear = abs(slope) >= incidence and here * there < 0.0
                        if clear and abs(here) >= behind and abs(there) >= behind:
                            passed[row] += np.uint32(1)
                    elif length - along >= behind_loose:
                        passed[row] += np.uint32(1)
            if tx <= ty and tx <= tz:
                t = tx
                tx += ux
                ix += sx
            elif ty <= tz:
                t = ty
                ty += uy
                iy += sy
            else:
                t = tz
                tz += uz
                iz += sz
