"""Gravity against the ground that a platform drives along: a mounting under which the road would be too steep for any road.

Where a vehicle goes straight on at a constant speed neither turns nor accelerations show the mounting, and on an open road there
is one direction of planes alone. But the plane that most of what is flat around belongs to, that lies under the whole way at the
same distance, and along which the platform moves at several metres a second, is what it drives on. The steepest streets climb by
19 deg. One that leans by more leans by a wrong mounting; or it is a slope indeed, along which a drone flies or a cable car runs:
nothing here tells these apart, unless something beside it stands level or upright as it could not with the ground put level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.planes.surroundings import TIGHT_RAD, Surroundings

_LEAST_SHARE = 0.1  # of the planar points
_SLOWEST_M_S, _SHORTEST_M = 3.0, 10.0
_UNDER_M = 1.5  # around the foot of a pose
_FEWEST_UNDER, _FEWEST_FEET, _LEAST_FEET = 3, 8, 0.3  # points; poses and their share
_LOWEST_M, _HIGHEST_M, _UNSTEADY_M = 0.3, 4.0, 0.25
_STANDS_RAD, _ORTHOGONAL_RAD = np.deg2rad(10.0), np.deg2rad(5.0)


@dataclass(frozen=True, slots=True)
class GroundLean:
    """How far the ground under a path leans, by the accelerometer and under a mounting.

    Attributes:
        lean: angle between up and the ground's normal, with or without the path's acceleration, whichever says less [rad].
        std: of it; without the accelerometer's bias [rad].
        height: of the LiDAR above the ground, across it [m].
        speed: along it [m/s].
    """

    lean: float
    std: float
    height: float
    speed: float


def drives(path: LidarPath) -> bool:
    """Whether a path is as fast and as long as that of a platform that may be driving: nobody walks or climbs stairs so."""
    if len(path) < 2:
        return False
    seconds = float(path.time_ns[-1] - path.time_ns[0]) * 1e-9
    return _way(path) > max(_SHORTEST_M, _SLOWEST_M_S * seconds)


def _way(path: LidarPath) -> float:
    return float(np.linalg.norm(path.p_path_lidar[-1] - path.p_path_lidar[0]))


def ground_lean(around: Surroundings) -> GroundLean | None:
    """The lean of the ground that a platform drives along; None where nothing shows that a plane is one, or others deny it."""
    path = around.path
    if not drives(path):
        return None
    speed = _way(path) / (float(path.time_ns[-1] - path.time_ns[0]) * 1e-9)
    found = []
    for number, (axis, share) in enumerate(around.directions):
        heights = _heights(around, axis)
        if share < _LEAST_SHARE or len(heights) < max(_FEWEST_FEET, _LEAST_FEET * len(path)):
            continue
        height = float(np.median(heights))
        normal = np.copysign(1.0, height) * axis
        steady = float(np.ptp(np.quantile(heights, [0.1, 0.9]))) < _UNSTEADY_M
        if steady and _LOWEST_M < abs(height) < _HIGHEST_M and not _denied(around, number):
            lean = min(_angle(normal, up) for up in (around.up, around.force))
            found.append(GroundLean(lean, around.up_std, abs(height), speed))
    return min(found, key=lambda ground: ground.lean, default=None)


def _heights(around: Surroundings, normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K,) along a normal, how high those poses are above points of its direction that were seen straight below them [m].

    Straight below by the accelerometer, on both sides, as well as across the plane: a slope beside the way is not there.
    """
    uphill = normal - (normal @ around.up) * around.up
    points = around.points[np.abs(around.normals @ normal) > np.cos(TIGHT_RAD)]
    heights = []
    for p in around.path.p_path_lidar:
        to_pose = p - points
        squared = (to_pose**2).sum(axis=1)
        across, along = to_pose @ normal, to_pose @ around.up
        below = (along > 0.0) & (squared - along**2 < _UNDER_M**2)
        nearest = (along > 0.0) & (squared - across**2 < _UNDER_M**2)
        if min(np.count_nonzero(below), np.count_nonzero(nearest)) < _FEWEST_UNDER:
            continue
        aside = to_pose[below] @ uphill
        if aside.min() < 0.0 < aside.max():
            heights.append(float(np.median(across[nearest])))
    return np.array(heights)


def _denied(around: Surroundings, number: int) -> bool:
    """Whether another direction of planes is level, or upright as it would not be with the ground put level."""
    normal = around.directions[number][0]
    for axis, _ in around.directions[:number] + around.directions[number + 1 :]:
        along = abs(float(axis @ around.up))
        if along > np.cos(_STANDS_RAD):
            return True
        if along < np.sin(_STANDS_RAD) and abs(float(axis @ normal)) > np.sin(_ORTHOGONAL_RAD):
            return True
    return False


def _angle(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    cosine = float(a @ b) / float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))
