"""Planes in voxels of 4 m that are split down to 0.5 m until what they hold is one plane, and the points of scans on them.

Source: adaptive voxelisation of Liu and Zhang, BALM, RA-L 2021, section III-C.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from boxplus._settings import Settings
from boxplus.maps.plane_voxels.membership import PlaneBlocks, sum_on_planes
from boxplus.maps.plane_voxels.voxel_sums import (
    COUNT,
    SQUARES,
    SUM,
    SUMS,
    VoxelSums,
    clusters,
    coordinates,
    moments,
    pack,
    shifted,
)

_SPLITS = 3  # a voxel is halved so often
_FLATTEST = 0.02  # share of a voxel's edge that a plane extends over in its shorter direction, at least (standard deviation)
_WORSE = 2.0  # variance of a large plane over that of the small ones in it, at most
_NEGLIGIBLE_M = 0.003
_FEWEST = 6  # points that a plane is fitted to anew
_PARALLEL = 0.97  # cosine between two planes that may be one
_BESIDE = 0.4  # of a voxel, between the middles of its points and of those of its neighbour, along the plane
_GATE = 4.0  # standard deviations of a plane's thickness within which a point lies on it


class PlaneVoxelConfig(Settings):
    """How planes are found; lengths in metres."""

    smallest_voxel: float = Field(0.5, gt=0, description="edge of the smallest voxels, in an eighth of a large one each way [m]")
    plane_ratio: float = Field(25.0, gt=1, description="variance within a plane, in its shorter direction, over that across it")
    plane_thickness: float = Field(0.1, gt=0, description="standard deviation across a plane, at most [m]")
    plane_points: int = Field(20, ge=6, description="points on a plane, at least")


@dataclass(frozen=True, slots=True, eq=False)
class PlaneMap:
    """Planes of a recording.

    Attributes:
        planes: (P, 4) unit normal n and offset d of nᵀ(x − c) + d = 0; centres: (P, 3) c.
        thickness: (P,) standard deviation of the points across each [m].
        cell: edge of the smallest voxels [m].
        keys, plane_of: (v,) the voxels that a plane is in, and which.
        is_one_sided: normals point to where a plane is seen from, and nothing is on it that was seen from behind.
    """

    planes: NDArray[np.float64]
    centres: NDArray[np.float64]
    thickness: NDArray[np.float64]
    cell: float
    keys: NDArray[np.int64]
    plane_of: NDArray[np.int32]
    is_one_sided: bool = False
    # Of all planes, and worked out once: a long recording has a hundred thousand, of which a scan sees a few hundred.
    _gate: NDArray[np.float64] = field(init=False, repr=False)
    _blocks: PlaneBlocks = field(init=False, repr=False)

    def __post_init__(self) -> None:
        # A plane that was found by half of its points, beside a face of its voxel, is thinner than it will be.
        usual = float(np.median(self.thickness)) if len(self.thickness) else 0.0
        object.__setattr__(self, "_gate", _GATE * np.maximum(self.thickness, max(usual, _NEGLIGIBLE_M)))
        object.__setattr__(self, "_blocks", PlaneBlocks.of(self.keys, self.plane_of, self._gate))

    def __len__(self) -> int:
        return len(self.planes)

    def seen_from(self, p: NDArray[np.float64], numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """(k,) 1 where p (3,) or (k, 3) lies before planes `numbers` (k,), 0 where it lies behind them, by their normals."""
        height = np.einsum("ki,ki->k", self.planes[numbers, :3], p - self.centres[numbers]) + self.planes[numbers, 3]
        side: NDArray[np.int64] = (height > 0.0).astype(np.int64)
        return side

    def refitted(self, clusters: NDArray[np.float64], side: NDArray[np.int64]) -> PlaneMap:
        """With planes through the points that lie on them and were seen from one side.

        Args:
            clusters: (P, 4, 4) Σ [x; 1][x; 1]ᵀ of these points in the world, from the planes' centres.
            side: (P,) 1 where they were seen from before it, 0 where from behind.
        """
        count = np.maximum(clusters[:, 3, 3], 1.0)
        mean = clusters[:, :3, 3] / count[:, None]
        values, vectors = np.linalg.eigh(clusters[:, :3, :3] / count[:, None, None] - mean[:, :, None] * mean[:, None, :])
        planes, centres, thickness = self.planes * (2.0 * side - 1.0)[:, None], self.centres.copy(), self.thickness.copy()
        seen = clusters[:, 3, 3] >= _FEWEST
        turned = np.where(np.einsum("pi,pi->p", vectors[:, :, 0], planes[:, :3]) < 0.0, -1.0, 1.0)[:, None]
        planes[seen, :3], planes[seen, 3] = (turned * vectors[:, :, 0])[seen], 0.0
        centres[seen] += mean[seen]
        thickness[seen] = np.sqrt(np.maximum(values[seen, 0], 0.0))
        return replace(self, planes=planes, centres=centres, thickness=thickness, is_one_sided=True)

    def clusters_of(
        self, points: NDArray[np.float32], R: NDArray[np.float64], p: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """The planes that points (n, 3), placed by R and p, lie on, and Σ [x; 1][x; 1]ᵀ (k, 4, 4) of those on each, as given.

        p is where they were seen from, too.
        """
        _, plane, own = self.clusters_of_scans(points, np.array([0, len(points)]), R[None], p[None])
        order = np.argsort(plane)
        return plane[order], own[order]

    def clusters_of_scans(
        self, points: NDArray[np.float32], begin: NDArray[np.int64], R: NDArray[np.float64], p: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """The same of many scans: scan (k,), ascending, plane (k,), and Σ [x; 1][x; 1]ᵀ (k, 4, 4) of points of this on that.

        Args:
            points: (n, 3), those of scan m are [begin[m], begin[m + 1]), placed by R (m, 3, 3) and p (m, 3).
        """
        most = len(points)  # a point is on one plane at most; memory that is not written is never taken
        scan, plane, sums = np.empty(most, dtype=np.int64), np.empty(most, dtype=np.int64), np.zeros((most, SUMS))
        table = self._blocks
        count = sum_on_planes(
            points, begin, R, p, self.cell, table.keys, table.block, table.plane, table.reach, self.planes, self.centres,
            self._gate, self.is_one_sided, np.full(len(self), -1), scan, plane, sums,
        )  # fmt: skip
        return scan[:count].copy(), plane[:count].copy(), clusters(sums[:count])


def find_planes(voxels: VoxelSums, config: PlaneVoxelConfig) -> PlaneMap:
    """The planes of the points in `voxels` (of `config.smallest_voxel`) that at least two groups of points lie on."""
    slots = voxels.filled()
    cells, sums, groups = coordinates(voxels.keys[slots]), voxels.sums[slots], voxels.groups[slots]
    cell = voxels.cell
    fine = _thickness_of(sums)
    plane_of = np.full(len(slots), -1, dtype=np.int32)
    planes, centres, thickness = [np.zeros((0, 4))], [np.zeros((0, 3))], [np.zeros(0)]
    found = 0
    open_cells = np.arange(len(slots))
    for level in range(_SPLITS, -1, -1):
        if not len(open_cells):
            break
        edge = cell * (1 << level)
        packed, parent_of = np.unique(pack(cells[open_cells] >> level), return_inverse=True)
        parents = coordinates(packed)
        middles = (parents + 0.5) * edge
        here = shifted(sums[open_cells], (cells[open_cells] + 0.5) * cell - middles[parent_of])
        total: NDArray[np.float64] = np.stack(
            [np.bincount(parent_of, weights=here[:, k], minlength=len(parents)) for k in range(SUMS)], axis=1
        )
        mean, covariance = moments(total)
        values, vectors = np.linalg.eigh(covariance)
        first = np.full(len(parents), np.iinfo(np.int32).max, dtype=np.int32)
        last = np.full(len(parents), -1, dtype=np.int32)
        np.minimum.at(first, parent_of, groups[open_cells, 0])
        np.maximum.at(last, parent_of, groups[open_cells, 1])
        inner = _mean_by(parent_of, fine[open_cells], sums[open_cells, COUNT], len(parents))
        is_plane = (
            (total[:, COUNT] >= config.plane_points)
            & (config.plane_ratio * values[:, 0] < values[:, 1])
            & (values[:, 0] < config.plane_thickness**2)
            & (values[:, 1] > (_FLATTEST * edge) ** 2)
            & (values[:, 0] <= _WORSE * inner + _NEGLIGIBLE_M**2)
            & (first < last)
        )
        number = np.full(len(parents), -1, dtype=np.int32)
        number[is_plane] = found + np.arange(np.count_nonzero(is_plane))
        plane_of[open_cells] = number[parent_of]
        found += int(np.count_nonzero(is_plane))
        planes.append(np.hstack([vectors[is_plane, :, 0], np.zeros((np.count_nonzero(is_plane), 1))]))
        centres.append(mean[is_plane] + middles[is_plane])
        thickness.append(np.sqrt(np.maximum(values[is_plane, 0], 0.0)))
        open_cells = open_cells[number[parent_of] < 0]
    all_planes, all_centres = np.concatenate(planes), np.concatenate(centres)
    all_thickness = np.concatenate(thickness)
    gone = _doubles(cells, sums, plane_of, all_planes[:, :3], all_thickness, cell)
    plane_of[np.isin(plane_of, gone)] = -1
    own = plane_of >= 0
    return PlaneMap(all_planes, all_centres, all_thickness, cell, voxels.keys[slots[own]], plane_of[own])


def _doubles(
    cells: NDArray[np.int64],
    sums: NDArray[np.float64],
    plane_of: NDArray[np.int32],
    normals: NDArray[np.float64],
    thickness: NDArray[np.float64],
    cell: float,
) -> NDArray[np.int64]:
    """The weaker one of two planes that share a surface which lies in a face between voxels, half of its points on each side."""
    own = np.flatnonzero(plane_of >= 0)
    axis = np.argmax(np.abs(normals), axis=1)[plane_of[own]]
    beyond = cells[own].copy()
    beyond[np.arange(len(own)), axis] += 1
    packed, keys = pack(cells), pack(beyond)
    place = np.minimum(np.searchsorted(packed, keys), len(packed) - 1)
    there = packed[place] == keys
    a, b = own[there], place[there]
    p, q = plane_of[a], plane_of[b]
    both = (q >= 0) & (p != q)
    a, b, p, q = a[both], b[both], p[both], q[both]
    mean = sums[:, SUM:SQUARES] / np.maximum(sums[:, COUNT], 1.0)[:, None] + (cells + 0.5) * cell
    apart = mean[b] - mean[a]
    across = np.einsum("ni,ni->n", normals[p], apart)
    aside = np.linalg.norm(apart - across[:, None] * normals[p], axis=1)
    same = (
        (np.abs(np.einsum("ni,ni->n", normals[p], normals[q])) > _PARALLEL)
        & (np.abs(across) < _GATE * (thickness[p] + thickness[q]))
        & (aside < _BESIDE * cell)
    )
    points = np.bincount(plane_of[own], sums[own, COUNT], len(normals))
    p, q = p[same], q[same]
    return np.unique(np.where(points[p] < points[q], p, q)).astype(np.int64)


def _thickness_of(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) variance across the plane through the points of each voxel, infinite where there are too few."""
    variance = np.full(len(sums), np.inf)
    enough = sums[:, COUNT] >= 8.0
    count = sums[enough, COUNT]
    variance[enough] = np.linalg.eigvalsh(moments(sums[enough])[1])[:, 0] * count / (count - 3.0)
    return variance


def _mean_by(
    parent_of: NDArray[np.int64], values: NDArray[np.float64], weights: NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """(count,) weighted means of the finite values; infinite where there are none."""
    finite = np.isfinite(values)
    total = np.bincount(parent_of[finite], weights[finite] * values[finite], count)
    weight = np.bincount(parent_of[finite], weights[finite], count)
    return np.where(weight > 0.0, total / np.maximum(weight, 1.0), np.inf)
