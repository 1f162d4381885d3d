"""What stands around a LiDAR along its path, and which way is up there: what gravity is compared with.

Up is the mean specific force less the mean acceleration of the path, under a mounting that is to be judged. Planes are found by
several scans together, and normals that point alike are bundled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.plane_fit import planes_through
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.downsampling import VoxelFilter
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import middle_of

_SCANS, _MOST_MAP_POINTS, _MOST_POINTS = 12, 5000, 4000
_NEIGHBOURS = 15
_THICKEST_M, _FLAT = 0.06, 0.05
TIGHT_RAD = float(np.deg2rad(4.0))
"""How far normals of one direction lie from their mean."""

_WIDE_RAD = np.deg2rad(12.0)
_TIGHT_SHARE = 0.5  # of what lies within the wide angle
_LEAST_SHARE, _FEWEST = 0.04, 40  # of the planar points
_MOST_DIRECTIONS = 6
_FEWEST_POSES, _SHORTEST_S, _ENDS = 20, 0.5, 5
_FEWEST_SAMPLES = 10
_POSE_SIGMA_M = 0.01  # of the ends of the path, that its mean acceleration is known from
_LEAST_FORCE = 1.0  # m/s²: below it nothing is up


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Planes around a path, and up, all in the frame of the path.

    Attributes:
        path: one segment.
        up: (3,) unit vector, by the accelerometer less the path's acceleration.
        up_std: of it, as far as the path's acceleration is known and its halves agree; without the accelerometer's bias [rad].
        force: (3,) mean specific force [m/s²].
        points, normals: (N, 3) where the surroundings are plane [m], and unit normals there, of either sign.
        directions: bundles of these normals, the largest first: unit vector (3,) and share of them.
    """

    path: LidarPath
    up: NDArray[np.float64]
    up_std: float
    force: NDArray[np.float64]
    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    directions: list[tuple[NDArray[np.float64], float]]


def surroundings_of(
    path: LidarPath, scans: Sequence[Scan], imu: ImuSamples, R_imu_lidar: NDArray[np.float64], config: RegistrationConfig
) -> Surroundings | None:
    """Planes around a path and gravity under a mounting; None where the path is too short to tell up.

    Args:
        path: from `lidar_path` of these scans; its last segment is used.
        scans: what it was found from.
        imu: finite samples in order of time.
        R_imu_lidar: (3, 3) the mounting to compare with.
        config: sizes of cells.
    """
    newest = path.segment == path.segment[-1] if len(path) else np.zeros(0, bool)
    if newest.sum() < _FEWEST_POSES:
        return None
    part = path.part(newest)
    middle = len(part) // 2
    vertical = [_up(part.part(_slice(len(part), *ends)), imu, R_imu_lidar) for ends in ((0, None), (0, middle), (middle, None))]
    if any(found is None for found in vertical):
        return None
    whole, early, late = (found for found in vertical if found is not None)
    # A registration that has gone astray accelerates out of nothing.
    std = float(np.hypot(whole.std, 0.5 * np.arccos(np.clip(early.up @ late.up, -1.0, 1.0))))
    points, normals = planar_points(_map(part, scans, config))
    return Surroundings(part, whole.up, std, whole.force, points, normals, plane_directions(normals))


def _slice(count: int, begin: int, end: int | None) -> NDArray[np.bool_]:
    chosen = np.zeros(count, bool)
    chosen[begin:end] = True
    return chosen


@dataclass(frozen=True, slots=True)
class _Up:
    """Mean specific force (3,) less the mean acceleration of a path, as a unit vector (3,), with its std [rad]."""

    up: NDArray[np.float64]
    std: float
    force: NDArray[np.float64]


def _up(path: LidarPath, imu: ImuSamples, R_imu_lidar: NDArray[np.float64]) -> _Up | None:
    """Which way is up along a path; None where samples are too few to tell, or the platform falls."""
    seconds = (path.time_ns - path.time_ns[0]) * 1e-9
    inside = (imu.time_ns >= path.time_ns[0]) & (imu.time_ns <= path.time_ns[-1])
    if seconds[-1] < _SHORTEST_S or np.count_nonzero(inside) < _FEWEST_SAMPLES:
        return None
    nearest = np.clip(np.searchsorted(path.time_ns, imu.time_ns[inside]), 1, len(path) - 1)
    nearest -= np.abs(path.time_ns[nearest - 1] - imu.time_ns[inside]) < np.abs(path.time_ns[nearest] - imu.time_ns[inside])
    force = np.einsum("nij,nj->ni", path.R_path_lidar[nearest] @ R_imu_lidar.T, imu.accel[inside]).mean(axis=0)
    ends = []
    for chosen in (slice(0, _ENDS), slice(len(path) - _ENDS, len(path))):
        t, p = seconds[chosen], path.p_path_lidar[chosen]
        ends.append((t.mean(), ((t - t.mean()) @ (p - p.mean(axis=0))) / float(((t - t.mean()) ** 2).sum())))
    between = float(ends[1][0] - ends[0][0])
    acceleration = (ends[1][1] - ends[0][1]) / between
    norm = float(np.linalg.norm(force - acceleration))
    if norm < _LEAST_FORCE:
        return None
    step = float(seconds[-1]) / (len(path) - 1)
    speed_std = _POSE_SIGMA_M / (step * np.sqrt(_ENDS * (_ENDS**2 - 1) / 12.0))
    return _Up((force - acceleration) / norm, float(np.sqrt(2.0) * speed_std / between / norm), force)


def _map(path: LidarPath, scans: Sequence[Scan], config: RegistrationConfig) -> IkdTree:
    """Some of the scans together, where the path says that they were."""
    middle_ns = np.array([middle_of(scan) for scan in scans])
    chosen = np.unique(np.linspace(0, len(path) - 1, _SCANS).astype(int))
    tree = IkdTree(cell_size=config.map_cell, rebuild="inplace")
    voxel_filter = VoxelFilter(config.map_cell, _MOST_MAP_POINTS)
    for k in chosen:
        (found,) = np.nonzero(middle_ns == path.time_ns[k])
        if len(found):
            points = voxel_filter(scans[int(found[0])].p_lidar)[1].astype(np.float64)
            tree.insert(points @ path.R_path_lidar[k].T + path.p_path_lidar[k], downsample=True)
    return tree


def planar_points(tree: IkdTree) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (N, 3) of a map, at most some thousands, that lie in a plane with their neighbours, and unit normals (N, 3)."""
    points = tree.points()
    points = points[:: max(len(points) // _MOST_POINTS, 1)]
    neighbours = tree.nearest(points, _NEIGHBOURS).points
    full = np.isfinite(neighbours).all(axis=(1, 2))
    planes = planes_through(neighbours[full])
    flat = (planes.thickness_sq < _THICKEST_M**2) & (planes.thickness_sq < _FLAT * planes.width_sq)
    return np.asarray(points[full][flat]), np.asarray(planes.normals[flat])


def plane_directions(normals: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], float]]:
    """Tight bundles of normals, the largest first: mean direction (3,) and share."""
    directions: list[tuple[NDArray[np.float64], float]] = []
    left, total = normals, len(normals)
    while len(directions) < _MOST_DIRECTIONS and len(left) >= max(_FEWEST, _LEAST_SHARE * total):
        sample = left[:: max(len(left) // 500, 1)]
        count = (np.abs(sample @ left.T) > np.cos(TIGHT_RAD)).sum(axis=1)
        axis = sample[int(np.argmax(count))]
        for _ in range(3):
            tight = left[np.abs(left @ axis) > np.cos(TIGHT_RAD)]
            axis = np.linalg.eigh(tight.T @ tight)[1][:, -1]
        near = np.abs(left @ axis)
        tight_count, wide = int((near > np.cos(TIGHT_RAD)).sum()), int((near > np.cos(_WIDE_RAD)).sum())
        if tight_count < max(_FEWEST, _LEAST_SHARE * total):
            break
        if tight_count > _TIGHT_SHARE * wide:
            directions.append((axis, tight_count / total))
        left = left[near <= np.cos(_WIDE_RAD)]
    return directions
