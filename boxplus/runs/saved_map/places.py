"""Local maps of a saved map: along the trajectory it was made on, or, without one, over the ground of a bare cloud."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import quaternion, se3
from boxplus.maps.local_maps.builder import LocalMapBuilder
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.maps.local_maps.visibility import visible
from boxplus.maps.tiles.voxel_thinning import first_per_voxel
from boxplus.runs.saved_map.tiled_points import Points, TiledPoints

Floats = NDArray[np.float64]
Near = Callable[[Floats, float], Points]

_VIEWPOINTS = 3  # along a stretch
_CELL = 0.5  # m, of the voxels that ground is looked for in
_FREE = 3  # empty voxels above ground
_STOREY = 3.0  # m, height of the cells that hold one place each
_FEWEST = 8  # voxels of ground in such a cell
_EYE = 1.5  # m above ground, where a bare cloud is looked at from
_MOST_PLACES = 2000
_SPACING = 1.5  # voxels, between the points of a surface that has one a voxel


def along(trajectories: Sequence[Trajectory], near: Near, config: LocalMapConfig) -> list[LocalMap]:
    """Local maps along trajectories, cut as `LocalMapBuilder` does, each with what can be seen of the map from its stretch.

    They are numbered through. Poses whose status is `lost` are left out: nobody knows where they are.
    """
    found = list[LocalMap]()
    for trajectory in trajectories:
        found += [replace(own, number=len(found) + own.number) for own in _along(trajectory, near, config)]
    return found


def _along(trajectory: Trajectory, near: Near, config: LocalMapConfig) -> list[LocalMap]:
    builder = LocalMapBuilder(config)
    none = np.zeros((0, 3), np.float32)
    known = np.array([True] * len(trajectory) if trajectory.status is None else [s != "lost" for s in trajectory.status])
    times, poses = trajectory.times[known], np.hstack([trajectory.q_wxyz, trajectory.p])[known]
    covariances = np.zeros((len(times), 6, 6)) if trajectory.covariance is None else trajectory.covariance[known]
    cut: list[LocalMap] = []
    for time_ns, T, covariance in zip(times.tolist(), poses, covariances, strict=True):
        turn = np.eye(6)  # the file's positions are along the world's axes, those of SE(3) along the body's
        turn[3:, 3:] = quaternion.to_matrix(T[:4]).T
        own = turn @ covariance @ turn.T
        cut += builder.push(time_ns, T, 0.5 * (own + own.T), none)
    cut += builder.flush()
    found = []
    for local_map in cut:
        first, last = np.searchsorted(times, [local_map.begin_ns, local_map.end_ns])
        rows = np.unique(np.linspace(first, last, _VIEWPOINTS).round().astype(int))
        found.append(replace(local_map, points=seen_from(near, local_map.T_odo_map, poses[rows, 4:], config)))
    return found


def over_ground(points: TiledPoints, near: Near, config: LocalMapConfig) -> tuple[list[LocalMap], float]:
    """Local maps on a grid over where one could stand: something solid with 1.5 m of nothing above; and the grid's spacing [m].

    Their frames have the axes of the cloud. There are 2,000 at most; the spacing grows where there would be more.
    """
    ground = [np.zeros((0, 3))]
    for index in points.tiles:
        ground.append(_ground(points.tile(index)))
    standing = np.concatenate(ground)
    spacing = 0.5 * config.length
    while True:
        cell = np.floor(standing / (spacing, spacing, _STOREY)).astype(np.int64)
        _, of, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
        if np.count_nonzero(count >= _FEWEST) <= _MOST_PLACES:
            break
        spacing *= 1.5
    found: list[LocalMap] = []
    path = 0.0
    for k in np.flatnonzero(count >= _FEWEST):
        members = standing[of.ravel() == k]
        middle = members[np.argmin(((members - np.median(members, axis=0)) ** 2).sum(axis=1))]
        eye = middle + np.array([0.0, 0.0, 0.5 * _CELL + _EYE])
        T = np.concatenate([[1.0, 0.0, 0.0, 0.0], eye])
        number = len(found)
        made = LocalMap(number, number, number, number, T, np.zeros((6, 6)), path, seen_from(near, T, eye[None], config), 0)
        found.append(made)
        path += spacing
    return found, spacing


def seen_from(near: Near, T_map_local: Floats, viewpoints: Floats, config: LocalMapConfig) -> Points:
    """(N, 3) points in a local frame that are seen from any of the viewpoints (K, 3), those of the map."""
    reach = config.max_range + float(np.linalg.norm(viewpoints - T_map_local[4:], axis=1).max())
    points = near(T_map_local[4:], reach)
    mask = np.zeros(len(points), dtype=np.bool_)
    for viewpoint in viewpoints:
        mask |= visible(points, viewpoint, config.max_range, _SPACING * config.voxel)
    local = se3.act(se3.inverse(T_map_local), points[mask].astype(np.float64)).astype(np.float32)
    return np.ascontiguousarray(local[first_per_voxel(local, config.voxel)])


def _ground(points: Points) -> Floats:
    """(G, 3) middles of the voxels that hold points and have nothing above them."""
    if not len(points):
        return np.zeros((0, 3))
    cell = np.unique(np.floor(points.astype(np.float64) / _CELL).astype(np.int64), axis=0)
    low = cell.min(axis=0)
    taken = np.zeros(cell.max(axis=0) - low + (1, 1, 1 + _FREE), dtype=np.bool_)
    taken[tuple((cell - low).T)] = True
    x, y, z = (cell - low).T
    free = ~np.any([taken[x, y, z + k] for k in range(1, _FREE + 1)], axis=0)
    return np.asarray((cell[free] + 0.5) * _CELL)
