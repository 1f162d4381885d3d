"""Surfaces that one LiDAR has seen: points on planes, with their normals."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.plane_fit import planes_through
from boxplus.sensors.lidar.downsampling import VoxelFilter

_VOXEL_M = 0.25
_NEIGHBOURS = 8
_REACH_M = 1.0
_LEAST_SPREAD_M = 0.12  # across the second axis of a neighbourhood; less is a line
_THICKEST_M = 0.05
_FLATNESS = 0.2  # thickness over spread


class Surfaces:
    """Planes through what points (N, 3) float64 in the world show [m].

    Attributes:
        count: points on planes.
    """

    def __init__(self, p_world: NDArray[np.float64]) -> None:
        self._origin = p_world.mean(axis=0) if len(p_world) else np.zeros(3)
        centroids = VoxelFilter(_VOXEL_M)((p_world - self._origin).astype(np.float32))[0].astype(np.float64)
        self.count = 0
        self._tree: Any = None
        if len(centroids) < _NEIGHBOURS:
            return
        from scipy.spatial import KDTree

        distances, index = KDTree(centroids).query(centroids, _NEIGHBOURS, distance_upper_bound=_REACH_M)
        around = centroids[index[np.isfinite(distances[:, -1])]]
        planes = planes_through(around)
        thick, spread = np.sqrt(planes.thickness_sq), np.sqrt(planes.width_sq)
        flat = (spread > _LEAST_SPREAD_M) & (thick < _THICKEST_M) & (thick < _FLATNESS * spread)
        self._centres, self._normals = planes.middles[flat], planes.normals[flat]
        self.count = int(flat.sum())
        self._tree = KDTree(self._centres) if self.count else None

    def beside(
        self, p_world: NDArray[np.float64], reach_m: float
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
        """Which points (N, 3) have a plane within reach (N,), and of these the normal (M, 3) and the distance off it (M,) [m]."""
        if self._tree is None:
            return np.zeros(len(p_world), bool), np.zeros((0, 3)), np.zeros(0)
        p = p_world - self._origin
        distances, at = self._tree.query(p, distance_upper_bound=reach_m)
        has = np.isfinite(distances)
        at = at[has]
        normals = self._normals[at]
        return has, normals, np.einsum("ij,ij->i", normals, p[has] - self._centres[at])
