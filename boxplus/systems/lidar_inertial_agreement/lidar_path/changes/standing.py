"""What stands on the ground: upright, and short along the way. It cannot be the same from every place of the way.

Posts, trunks and corners do; rails, walls and the rings on the road go along with a platform that moves. A registration, point to
plane, gives a few of them no weight beside all the rest; whether they stay or go by tells rest from motion none the less.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.changes.changed_points import (
    FAR_M,
    MOST_COMPARED,
    NEAR_M,
    NEIGHBOURS,
    are_there,
    both_scans,
    tree_of,
)
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import Turning, thinned

ASIDE_M = 6.0  # of the way; nearer to it are the platform's own parts, and vehicles that keep pace with it
_UPRIGHT_M, _SHORT_M = 0.1, 0.25  # standard deviations of what stands, upwards and along the way
_FREE_FROM_M, _FREE_TO_M, _FREE_M = 0.8, 3.0, 0.35  # nothing else is there along the way, this near to the line along it
FASTEST_M_S = 36.0  # no mapped car is faster; what stands at equal distances looks the same where it goes by one of them
_UNMOVED_M = 0.15
_FEWEST_UNMOVED, _LEAST_UNMOVED = 60, 0.3  # points, and their share of what stands
_PLACE_M, _FEWEST_PLACES, _FEWEST_A_SIDE = 4.0, 6, 2  # on the ground, in all and on either side of the way
FEWEST_SCANS, _LEAST_SPAN_S = 6, 0.8


def stay_and_go(
    scans: tuple[Scan, Scan], turning: Turning, velocity: NDArray[np.float64], up: NDArray[np.float64]
) -> tuple[int, int]:
    """How many points of what stands on the ground stay where they are, and how many go by a velocity.

    Args:
        scans: two neighbouring ones.
        turning: how the LiDAR turned.
        velocity, up: (3,) a velocity of the LiDAR [m/s] and a unit vector, along its axes in the middle of the first scan.
    """
    (before, since_before), (after, since_after), seconds = both_scans(*scans, turning)
    standing = _standing(after, velocity / np.linalg.norm(velocity), up)
    # The ring on the ground at the foot of a rail goes along with the platform.
    near = tree_of(after).nearest(after[standing], NEIGHBOURS).points
    standing[standing] = after[standing] @ up - (near @ up).min(axis=1) > _UPRIGHT_M
    after, since_after = after[standing], since_after[standing] + seconds
    stays = are_there(after, before)
    goes = are_there(after + since_after[:, None] * velocity, before + since_before[:, None] * velocity)
    return int((stays & ~goes).sum()), int((goes & ~stays).sum())


def shows_rest(scans: Sequence[Scan], axis: NDArray[np.float64], up: NDArray[np.float64]) -> bool:
    """Whether what stands on the ground, on both sides of the way, stays where it is, from the first scan to three later ones.

    Slower than 0.15 m in the time of the scans nothing shows.

    Args:
        scans: consecutive sweeps; the LiDAR does not turn. Fewer than 6, or less than 0.8 s, show nothing.
        axis, up: (3,) unit vectors, along its axes: the way along which rest is asked for, across the vertical.
    """
    seconds = (scans[-1].start_ns - scans[0].start_ns) * 1e-9
    if len(scans) < FEWEST_SCANS or seconds < _LEAST_SPAN_S:
        return False
    reach = max(_FREE_TO_M, FASTEST_M_S * seconds / (len(scans) - 1) + _FREE_M)
    on_ground = np.stack([axis, np.cross(up, axis)], axis=1)
    last = len(scans) - 1
    first, *later = (thinned(scans[k], MOST_COMPARED).p_lidar.astype(np.float64) for k in (0, (last + 1) // 2, last - 1, last))
    for p in later:
        p = p[_standing(p, axis, up, reach)]
        unmoved = p[are_there(p, first, _UNMOVED_M)]
        places = np.unique(np.round(unmoved @ on_ground / _PLACE_M), axis=0)
        sides = np.count_nonzero(places[:, 1] > 0.0), np.count_nonzero(places[:, 1] < 0.0)
        enough = len(unmoved) >= max(_FEWEST_UNMOVED, _LEAST_UNMOVED * len(p))
        if not enough or len(places) < _FEWEST_PLACES or min(sides) < _FEWEST_A_SIDE:
            return False
    return True


def _standing(
    p: NDArray[np.float64], axis: NDArray[np.float64], up: NDArray[np.float64], reach_m: float = _FREE_TO_M
) -> NDArray[np.bool_]:
    """Which points (N,) are of something upright that is short along an axis (3,), with nothing like it along that, in reach."""
    neighbours = tree_of(p).nearest(p, NEIGHBOURS).points
    standing = np.isfinite(neighbours).all(axis=(1, 2)) & (np.linalg.norm(p, axis=1) < FAR_M)
    standing &= np.abs(p @ np.cross(up, axis)) > ASIDE_M
    standing[standing] = np.linalg.norm(neighbours[standing, -1] - p[standing], axis=1) < NEAR_M
    spread = neighbours[standing]
    standing[standing] = ((spread @ up).std(axis=1) > _UPRIGHT_M) & ((spread @ axis).std(axis=1) < _SHORT_M)
    # Along the axis shrunk so far that a piece of line becomes as short as it is wide.
    middle, half = 0.5 * (reach_m + _FREE_FROM_M), 0.5 * (reach_m - _FREE_FROM_M)
    shrunk = p - np.outer(p @ axis, axis) * (1.0 - _FREE_M / half)
    tree = tree_of(shrunk)
    for away in (-middle, middle):
        there = shrunk[standing] + away * _FREE_M / half * axis
        standing[standing] = np.linalg.norm(tree.nearest(there, 1).points[:, 0] - there, axis=1) > _FREE_M
    return np.asarray(standing)
