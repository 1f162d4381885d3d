"""What two neighbouring scans do not share: points that lie neither near a point of the other nor on a surface of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.plane_fit import planes_through
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import (
    Turning,
    middle_of,
    nodes_within,
    thinned,
    undistorted,
)

MOST_COMPARED = 32000  # points of a scan: with fewer of them, others are left from scan to scan, even at rest
_MOST_RAW = 8000
FAR_M = 60.0  # beyond it neighbouring rays are metres apart
NEIGHBOURS, NEAR_M, _THICKEST_M, _FLAT = 8, 1.0, 0.06, 0.05
_SAME_M = 0.3  # from one of them, a point is there again
_FEWEST_ALL = 5
_ALONE_M = 0.5  # farther from all others of its scan, a point is rain, dust or a mixed pixel
_REPEATED, _SAMPLED = 0.75, 1000  # of the distance of neighbouring rays; rosettes 2 and more
_SAME_RAY = 4  # decimals of its direction
_CLOSE_RAD = 0.005  # a ray passes a point

_Still = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class ChangedPoints:
    """What two neighbouring scans do not share, with the turning taken out.

    Attributes:
        p_before, p_after: (N, 3), (M, 3) as seen from where the LiDAR was, along its axes in the middle of the first scan [m].
        since_before, since_after: when, since that middle [s].
        seconds: between the middles of both scans.
    """

    p_before: NDArray[np.float64]
    p_after: NDArray[np.float64]
    since_before: NDArray[np.float64]
    since_after: NDArray[np.float64]
    seconds: float

    def shifts(self, velocity: NDArray[np.float64], near: float = _SAME_M) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Which of the later points (M,) are there again at a velocity (3,), and what it lacks to lay them there (m, 3) [m/s]."""
        if min(len(self.p_before), len(self.p_after)) < _FEWEST_ALL:
            return np.zeros(len(self.p_after), bool), np.zeros((0, 3))
        before, after = self.p_before + self.since_before[:, None] * velocity, self.p_after + self.since_after[:, None] * velocity
        away = tree_of(before).nearest(after, 1).points[:, 0] - after
        again = np.asarray(np.linalg.norm(away, axis=1) < near)
        return again, away[again] / self.seconds


def changed_points(first: Scan, second: Scan, turning: Turning) -> ChangedPoints:
    """What two neighbouring scans do not share.

    Args:
        first, second: in order of time.
        turning: how the LiDAR turned.
    """
    (before, since_before), (after, since_after), seconds = both_scans(first, second, turning)
    new, old = _unexplained(after, before), _unexplained(before, after)
    return ChangedPoints(before[old], after[new], since_before[old], since_after[new] + seconds, seconds)


def changed_share(first: Scan, second: Scan, turning: Turning) -> float:
    """The share of the second scan's points that the first has nothing of: about none at rest where nothing moves.

    A LiDAR that draws other lines in every scan (rosettes) sees for the first time what was there before: of its points those
    count which rays of the first scan passed closely, and went on. None counts that is alone in its own scan, as rain, dust and
    mixed pixels are.

    Args:
        first, second: in order of time.
        turning: how the LiDAR turned.
    """
    (before, _), (every, _), _ = both_scans(first, second, turning, MOST_COMPARED)
    if min(len(before), len(every)) < NEIGHBOURS:
        return 0.0
    after = every[:: -(-len(every) // _MOST_RAW)]
    changed = after[_unexplained(after, before)]
    if not len(changed):  # at rest where nothing moves, which is what most starts are
        return 0.0
    changed = changed[tree_of(every).nearest(changed, 2).distances[:, 1] < _ALONE_M]
    if not _rays_repeat(first, second):
        changed = changed[_passed_by(changed, before)]
    return len(changed) / len(after)


def _rays_repeat(first: Scan, second: Scan) -> bool:
    """Whether two scans look in the same directions: those of the second lie nearer to the first's than to one another."""
    tree = tree_of(_rays(first.p_lidar)[0])
    other = np.unique(np.round(_rays(second.p_lidar)[0], _SAME_RAY), axis=0)  # without second returns
    some = other[:: max(len(other) // _SAMPLED, 1)]
    own = tree_of(other).nearest(some, 2).distances[:, 1]
    return bool(np.median(tree.nearest(some, 1).distances) < _REPEATED * np.median(own))


def _passed_by(p: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (N, 3) lie where rays of another scan, next to them, went on to something clearly farther, as (N,)."""
    from scipy.spatial import KDTree  # takes a third of a second to import

    rays, ranges = _rays(other)
    towards, far = _rays(p)
    apart, which = KDTree(rays).query(towards, NEIGHBOURS)
    return np.asarray((far < ranges[which].min(axis=1) - _SAME_M) & (apart[:, 0] < _CLOSE_RAD))


def _rays(p: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (N, 3) and distances (N,)."""
    p = np.asarray(p, np.float64)
    distance = np.maximum(np.linalg.norm(p, axis=1), 1e-9)
    return p / distance[:, None], distance


def _still(scan: Scan, turning: Turning, most: int) -> _Still:
    """Points (N, 3) [m] without the turning within the scan, and their times (N,) since its middle [s]."""
    scan = thinned(scan, most)
    middle = middle_of(scan)
    p = undistorted(scan, nodes_within(scan, middle, np.zeros(3), np.zeros(3), turning), middle)
    return p.astype(np.float64), np.asarray((scan.time_ns - middle) * 1e-9, np.float64)


def both_scans(first: Scan, second: Scan, turning: Turning, most: int = _MOST_RAW) -> tuple[_Still, _Still, float]:
    """Two scans without their turning, along the axes in the middle of the first, and the seconds between their middles."""
    middles = np.array([middle_of(first), middle_of(second)])
    R = turning(middles)
    after, since_after = _still(second, turning, most)
    return _still(first, turning, most), (after @ (R[0].T @ R[1]).T, since_after), float(middles[1] - middles[0]) * 1e-9


def are_there(p: NDArray[np.float64], other: NDArray[np.float64], near: float = _SAME_M) -> NDArray[np.bool_]:
    """Which points (N, 3) lie near one of others (M, 3), as (N,)."""
    if not len(p) or not len(other):
        return np.zeros(len(p), bool)
    return np.asarray(np.linalg.norm(tree_of(other).nearest(p, 1).points[:, 0] - p, axis=1) < near)


def _unexplained(p: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (N,) lie neither near one of another scan nor on a surface of it."""
    neighbours = tree_of(other).nearest(p, NEIGHBOURS).points
    full = np.asarray(np.isfinite(neighbours).all(axis=(1, 2)))
    unexplained: NDArray[np.bool_] = np.asarray(np.linalg.norm(p, axis=1) < FAR_M)
    away = np.asarray(np.linalg.norm(neighbours[:, 0] - p, axis=1))
    near = full & (away < NEAR_M)
    planes = planes_through(neighbours[near])
    flat = (planes.thickness_sq < _THICKEST_M**2) & (planes.thickness_sq < _FLAT * planes.width_sq)
    on_plane = np.zeros(len(p), bool)
    on_plane[near] = flat & (np.abs(np.einsum("ni,ni->n", planes.normals, p[near] - planes.middles)) < _SAME_M)
    unexplained &= ~(full & (away < _SAME_M)) & ~on_plane
    return unexplained


def tree_of(p: NDArray[np.float64]) -> IkdTree:
    """A tree of points (N, 3), all of them."""
    tree = IkdTree(rebuild="inplace")
    tree.insert(p, downsample=False)
    return tree
