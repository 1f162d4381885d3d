"""What two neighbouring scans do not share: points that lie neither near a point of the other nor on a surface of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.ikd_tree import IkdTree
from boxplus.sensors.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import Turning, nodes_within, thinned, undistorted

_MOST_RAW, _MOST_COMPARED = 8000, 32000  # points of a scan; at rest, fewer of them are not the same ones from scan to scan
_FAR_M = 60.0  # beyond it neighbouring rays are metres apart
_NEIGHBOURS, _NEAR_M, _THICKEST_M, _FLAT = 8, 1.0, 0.06, 0.05
_SAME_M = 0.3  # from one of them, a point is there again
_FEWEST_ALL = 5
_UPRIGHT_M, _SHORT_M = 0.1, 0.25  # standard deviations of what stands, upwards and along the way
_ALONG_M, _FREE_M = (0.8, 3.0), 0.35  # nothing else is there along the way, this near to the line along it

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
        away = _tree(before).nearest(after, 1).points[:, 0] - after
        again = np.asarray(np.linalg.norm(away, axis=1) < near)
        return again, away[again] / self.seconds


def changed_points(first: Scan, second: Scan, turning: Turning) -> ChangedPoints:
    """What two neighbouring scans do not share.

    Args:
        first, second: in order of time.
        turning: how the LiDAR turned.
    """
    (before, since_before), (after, since_after), seconds = _both(first, second, turning)
    new, old = _unexplained(after, before), _unexplained(before, after)
    return ChangedPoints(before[old], after[new], since_before[old], since_after[new] + seconds, seconds)


def changed_share(first: Scan, second: Scan, turning: Turning) -> float:
    """The share of the second scan's points that the first has nothing of: none at rest where nothing moves.

    Args:
        first, second: in order of time.
        turning: how the LiDAR turned.
    """
    (before, _), (after, _), _ = _both(first, second, turning, _MOST_COMPARED)
    return float(_unexplained(after[:: -(-len(after) // _MOST_RAW)], before).mean())


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
    (before, since_before), (after, since_after), seconds = _both(*scans, turning)
    standing = _standing(after, velocity / np.linalg.norm(velocity), up)
    after, since_after = after[standing], since_after[standing] + seconds
    stays = _there(after, before)
    goes = _there(after + since_after[:, None] * velocity, before + since_before[:, None] * velocity)
    return int((stays & ~goes).sum()), int((goes & ~stays).sum())


def _standing(p: NDArray[np.float64], axis: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (N,) are of something upright that is short along an axis (3,), with nothing like it along that axis."""
    neighbours = _tree(p).nearest(p, _NEIGHBOURS).points
    standing = np.isfinite(neighbours).all(axis=(1, 2)) & (np.linalg.norm(p, axis=1) < _FAR_M)
    standing[standing] = np.linalg.norm(neighbours[standing, -1] - p[standing], axis=1) < _NEAR_M
    spread = neighbours[standing]
    standing[standing] = ((spread @ up).std(axis=1) > _UPRIGHT_M) & ((spread @ axis).std(axis=1) < _SHORT_M)
    # Along the axis shrunk so far that a piece of line becomes as short as it is wide.
    middle, half = 0.5 * (_ALONG_M[1] + _ALONG_M[0]), 0.5 * (_ALONG_M[1] - _ALONG_M[0])
    shrunk = p - np.outer(p @ axis, axis) * (1.0 - _FREE_M / half)
    tree = _tree(shrunk)
    for away in (-middle, middle):
        there = shrunk[standing] + away * _FREE_M / half * axis
        standing[standing] = np.linalg.norm(tree.nearest(there, 1).points[:, 0] - there, axis=1) > _FREE_M
    return np.asarray(standing)


def _still(scan: Scan, turning: Turning, most: int) -> _Still:
    """Points (N, 3) [m] without the turning within the scan, and their times (N,) since its middle [s]."""
    scan = thinned(scan, most)
    middle = (scan.start_ns + scan.end_ns) // 2
    p = undistorted(scan, nodes_within(scan, middle, np.zeros(3), np.zeros(3), turning), middle)
    return p.astype(np.float64), np.asarray((scan.time_ns - middle) * 1e-9, np.float64)


def _both(first: Scan, second: Scan, turning: Turning, most: int = _MOST_RAW) -> tuple[_Still, _Still, float]:
    """Two scans without their turning, along the axes in the middle of the first, and the seconds between their middles."""
    middles = np.array([(scan.start_ns + scan.end_ns) // 2 for scan in (first, second)])
    R = turning(middles)
    after, since_after = _still(second, turning, most)
    return _still(first, turning, most), (after @ (R[0].T @ R[1]).T, since_after), float(middles[1] - middles[0]) * 1e-9


def _there(p: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (N,) lie near one of others."""
    return np.asarray(np.linalg.norm(_tree(other).nearest(p, 1).points[:, 0] - p, axis=1) < _SAME_M)


def _unexplained(p: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (N,) lie neither near one of another scan nor on a surface of it."""
    neighbours = _tree(other).nearest(p, _NEIGHBOURS).points
    full = np.asarray(np.isfinite(neighbours).all(axis=(1, 2)))
    unexplained: NDArray[np.bool_] = np.asarray(np.linalg.norm(p, axis=1) < _FAR_M)
    away = np.asarray(np.linalg.norm(neighbours[:, 0] - p, axis=1))
    near = full & (away < _NEAR_M)
    middle = neighbours[near].mean(axis=1)
    spread = neighbours[near] - middle[:, None]
    variance, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread) / _NEIGHBOURS)
    flat = (variance[:, 0] < _THICKEST_M**2) & (variance[:, 0] < _FLAT * variance[:, 1])
    on_plane = np.zeros(len(p), bool)
    on_plane[near] = flat & (np.abs(np.einsum("ni,ni->n", vectors[:, :, 0], p[near] - middle)) < _SAME_M)
    unexplained &= ~(full & (away < _SAME_M)) & ~on_plane
    return unexplained


def _tree(p: NDArray[np.float64]) -> IkdTree:
    tree = IkdTree(rebuild="inplace")
    tree.insert(p, downsample=False)
    return tree
