"""What stands on the ground: upright, and short along the way. It cannot be the same from every place of the way.

Posts, trunks and corners do; rails, walls and the rings on the road go along with a platform that moves. A registration, point to
plane, gives a few of them no weight beside all the rest; whether they stay or go by tells rest from motion none the less.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.changed_points import (
    FAR_M,
    MOST_COMPARED,
    NEAR_M,
    NEIGHBOURS,
    are_there,
    both_scans,
    tree_of,
)
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import Turning, thinned

_NEAREST_M = 5.0  # nearer, it may be a part of the platform
_UPRIGHT_M, _SHORT_M = 0.1, 0.25  # standard deviations of what stands, upwards and along the way
_ALONG_M, _FREE_M = (0.8, 3.0), 0.35  # nothing else is there along the way, this near to the line along it
_UNMOVED_M = 0.15
_FEWEST_UNMOVED, _LEAST_UNMOVED = 60, 0.3  # points, and their share of what stands; on drives up to 49, 0.07 of it
_PLACE_M, _FEWEST_PLACES = 2.0, 6  # that are not parts of one thing


def stay_and_go(
    scans: tuple[Scan, Scan], turning: Turning, velocity: NDArray[np.float64], up: NDArray[np.float64]
) -> tuple[int, int]:
    """How many points of what stands on the ground stay where they are, and how many go by a velocity.

    What stands is upright, and short along the way: a post, a trunk, a corner. It cannot be the same from every place of the way.

    Args:
        scans: two neighbouring ones.
        turning: how the LiDAR turned.
        velocity, up: (3,) a velocity of the LiDAR [m/s] and a unit vector, along its axes in the middle of the first scan.
    """
    (before, since_before), (after, since_after), seconds = both_scans(*scans, turning)
    standing = _standing(after, velocity / np.linalg.norm(velocity), up)
    after, since_after = after[standing], since_after[standing] + seconds
    stays = are_there(after, before)
    goes = are_there(after + since_after[:, None] * velocity, before + since_before[:, None] * velocity)
    return int((stays & ~goes).sum()), int((goes & ~stays).sum())


def shows_rest(scans: Sequence[Scan], axis: NDArray[np.float64], up: NDArray[np.float64]) -> bool:
    """Whether what stands on the ground stays where it is, from the first scan to three much later ones.

    Args:
        scans: consecutive sweeps; the LiDAR does not turn.
        axis, up: (3,) unit vectors, along its axes: the way along which rest is asked for, across the vertical.
    """
    first, *later = (thinned(scan, MOST_COMPARED).p_lidar.astype(np.float64) for scan in _far_apart(scans))
    for p in later:
        p = p[_standing(p, axis, up)]
        unmoved = p[are_there(p, first, _UNMOVED_M)]
        places = len(np.unique(np.round(unmoved / _PLACE_M), axis=0))
        if len(unmoved) < max(_FEWEST_UNMOVED, _LEAST_UNMOVED * len(p)) or places < _FEWEST_PLACES:
            return False
    return len(later) > 0


def _far_apart(scans: Sequence[Scan]) -> list[Scan]:
    """The first one, and three later ones: what stands at equal distances looks the same from some places."""
    last = len(scans) - 1
    return [scans[k] for k in sorted({0, (last + 1) // 2, max(last - 1, 0), last})]


def _standing(p: NDArray[np.float64], axis: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (N,) are of something upright that is short along an axis (3,), with nothing like it along that axis."""
    neighbours = tree_of(p).nearest(p, NEIGHBOURS).points
    distance = np.linalg.norm(p, axis=1)
    standing = np.isfinite(neighbours).all(axis=(1, 2)) & (distance > _NEAREST_M) & (distance < FAR_M)
    standing[standing] = np.linalg.norm(neighbours[standing, -1] - p[standing], axis=1) < NEAR_M
    spread = neighbours[standing]
    standing[standing] = ((spread @ up).std(axis=1) > _UPRIGHT_M) & ((spread @ axis).std(axis=1) < _SHORT_M)
    # Along the axis shrunk so far that a piece of line becomes as short as it is wide.
    middle, half = 0.5 * (_ALONG_M[1] + _ALONG_M[0]), 0.5 * (_ALONG_M[1] - _ALONG_M[0])
    shrunk = p - np.outer(p @ axis, axis) * (1.0 - _FREE_M / half)
    tree = tree_of(shrunk)
    for away in (-middle, middle):
        there = shrunk[standing] + away * _FREE_M / half * axis
        standing[standing] = np.linalg.norm(tree.nearest(there, 1).points[:, 0] - there, axis=1) > _FREE_M
    return np.asarray(standing)
