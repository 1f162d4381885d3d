"""Gravity against the planes that the LiDAR sees: the mounting, where neither a turn nor an acceleration shows it.

Floors, walls and ceilings of what people build have normals along three orthogonal directions, one of them gravity (the
"Manhattan world": Coughlan and Yuille, ICCV 1999). Three tight, orthogonal directions of which none is upright under a mounting
contradict it; two do about the edge in which they meet, since a road may climb between house fronts but does not lean with
them. One alone says nothing here (but see `ground_lean`), and a forest has none.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from boxplus.systems.lidar_inertial_agreement.planes.surroundings import Surroundings

_LEAST_OF_TWO = 0.1  # of the planar points, where there is no third direction
_ORTHOGONAL_RAD = np.deg2rad(1.5)
_ACROSS = 0.7  # of a unit vector that is known in a plane


@dataclass(frozen=True, slots=True)
class PlaneTilt:
    """How far the planes around a LiDAR are from upright, by the accelerometer and under a mounting.

    Attributes:
        tilt: angle between up and the nearest normal, or about the edge of two planes [rad].
        std: of it, as far as the path's acceleration is known and both its halves agree; without the accelerometer's bias [rad].
        directions: of planes that are orthogonal to each other: 3 or 2.
        mirrored: (3,) the tilt if the LiDAR's x, y or z axis had the other sign [rad].
    """

    tilt: float
    std: float
    directions: int
    mirrored: NDArray[np.float64]


def plane_tilt(around: Surroundings) -> PlaneTilt | None:
    """Compare planes with gravity; None where no two directions are orthogonal."""
    directions, up = around.directions, around.up
    count = 3 if _tilt(directions, up, 3) is not None else 2
    tilt = _tilt(directions, up, count)
    if tilt is None:
        return None
    R = around.path.R_path_lidar[len(around.path) // 2]
    flips = [np.eye(3) - 2.0 * np.outer(axis, axis) for axis in np.eye(3)]
    mirrored = [_tilt(directions, R @ flip @ R.T @ up, count) for flip in flips]
    return PlaneTilt(tilt, around.up_std, count, np.array([np.pi if other is None else other for other in mirrored]))


def _tilt(directions: list[tuple[NDArray[np.float64], float]], up: NDArray[np.float64], count: int) -> float | None:
    """The least tilt [rad] over all sets of `count` orthogonal directions: one that is upright is enough."""
    tilts = []
    for chosen in combinations(directions, count):
        axes = np.stack([axis for axis, _ in chosen])
        if np.abs(np.triu(axes @ axes.T, 1)).max() > np.sin(_ORTHOGONAL_RAD):
            continue
        if count == 2 and min(share for _, share in chosen) < _LEAST_OF_TWO:
            continue
        along = np.sort(np.abs(axes @ up))[::-1]
        if np.linalg.norm(along) > _ACROSS:
            tilts.append(float(np.arctan2(np.linalg.norm(along[1:]), along[0])))
    return min(tilts, default=None)
