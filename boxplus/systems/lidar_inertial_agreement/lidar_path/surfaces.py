"""Surfaces among map points: planes through many neighbours, which a scan pattern alone does not span."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.plane_fit import planes_through

_MANY = 15
_THICKEST_M, _FLAT = 0.06, 0.05
_NEAR_M = 1.5
_ACROSS = 0.25  # squared cosine between a normal and an axis that it faces
_ENOUGH_ACROSS, _SHARE_ACROSS = 2.5, 0.005  # points that face it, and their share of all
# Where the information along the axis is not this many times that of noise: their share within so many metres.
_TELLING, _NEAR_SHARE_ACROSS, _NEAR_SENSOR_M = 7.5, 0.02, 10.0
_FRESH_SHARE_ACROSS = 0.003  # of a pattern that does not recur


def surface_distances(
    tree: IkdTree, points: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Which points have map points near, and the planes through fifteen of these.

    Where a ring passes from a wall to a ceiling, five of its points span a plane that faces the sensor and goes along with it. A
    surface that is one still is a plane with three times as many of its neighbours.

    Args:
        tree: the map.
        points: (N, 3) in its frame [m].

    Returns:
        near (N,): fifteen neighbours, the nearest of them within 1.5 m; surface (N,): these are near and lie in a plane; distance
        (N,) [m] to it and its normal (N, 3), both only where there is one.
    """
    neighbours = tree.nearest(points, _MANY).points
    full = np.asarray(np.isfinite(neighbours).all(axis=(1, 2)))
    near = full.copy()
    near[full] = np.linalg.norm(neighbours[full, 0] - points[full], axis=1) < _NEAR_M
    planes = planes_through(neighbours[near])
    flat = (planes.thickness_sq < _THICKEST_M**2) & (planes.thickness_sq < _FLAT * planes.width_sq)
    surface = near.copy()
    surface[near] = flat
    normals = np.zeros((len(points), 3))
    normals[surface] = planes.normals[flat]
    distances = np.zeros(len(points))
    distances[surface] = np.abs(np.einsum("ni,ni->n", planes.normals[flat], points[surface] - planes.middles[flat]))
    return near, surface, distances, normals


class SeenSurfaces:
    """The surfaces that points of scans lie on, and whether they face an axis and would show a motion along it.

    Args:
        tree: the map.
        points: (N, 3) of a scan, or of several, in its frame [m].
    """

    def __init__(self, tree: IkdTree, points: NDArray[np.float64]) -> None:
        self._points = points
        _, _, _, self._normals = surface_distances(tree, points)

    def face_for_rings(self, sensor: NDArray[np.float64], axis: NDArray[np.float64], ratio: float) -> bool:
        """Whether they do, seen by a pattern that goes along with the sensor.

        Where walls, floor and ceiling of a smooth corridor meet, far rings span planes across it even through many neighbours,
        though they say hardly more than noise. So either what the scan says must be much, or many of the surfaces must be near.

        Args:
            sensor: (3,) where the points were seen from.
            axis: (3,) unit vector in the frame of the map.
            ratio: how many times what noise would the scan says about a motion along it (`PoseDirections.ratio_along`).
        """
        across = self._across(axis)
        if ratio < _TELLING:
            across = across[np.linalg.norm(self._points - sensor, axis=1) < _NEAR_SENSOR_M]
        share = _SHARE_ACROSS if ratio > _TELLING else _NEAR_SHARE_ACROSS
        return float(across.sum()) > max(_ENOUGH_ACROSS, share * len(self._points))

    def face(self, axis: NDArray[np.float64]) -> bool:
        """Whether they do along an axis (3,), seen by a pattern that does not recur (`scan_pattern`): a surface is one then.

        Along corridors and tunnels none of 3000 to 5000 points of such a sensor lies on a surface that faces the way; among
        trunks ten metres off and more, 0.35 % and more do.
        """
        return float(self._across(axis).sum()) > max(_ENOUGH_ACROSS, _FRESH_SHARE_ACROSS * len(self._points))

    def _across(self, axis: NDArray[np.float64]) -> NDArray[np.float64]:
        """How squarely (N,) they face an axis: squared cosines, zero where they do not."""
        across = np.asarray((self._normals @ axis) ** 2)
        return np.where(across > _ACROSS, across, 0.0)
