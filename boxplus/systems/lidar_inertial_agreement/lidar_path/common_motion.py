"""The one motion that explains what changes from scan to scan, where all else goes along with the LiDAR.

On a highway the rings on the road, the rails and the walls look the same from every place: a registration, point to plane, stays
with them at rest while the platform drives. What does change are posts, bushes, signs and parked cars, some in a hundred of all
points, and they all change by the same shift. So those points of two neighbouring scans are taken that lie neither near a point
of the other nor on a surface of it, every two of them vote for a velocity, and the one that most of them have in common is
believed if it is had all around, and if neither that velocity reversed nor half of it nor half more explains about as many:
noise, rain, lost packets and moving people change points too, but do not do that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.maps.ikd_tree import IkdTree
from boxplus.sensors.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import Twist
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import Turning, nodes_within, thinned, undistorted

FEWEST_SCANS = 6
_PAIRS = 0, 2, 4  # first scans of those that vote
_MOST_RAW, _MOST_VOTERS = 8000, 800
_FAR_M = 60.0  # beyond it neighbouring rays are metres apart
_NEIGHBOURS, _NEAR_M, _THICKEST_M, _FLAT = 8, 1.0, 0.06, 0.05
_SAME_M, _CLOSE_M = 0.3, 0.15  # from one of them, a point is there again
_WELL_M = 0.08  # that a motion is off in the median, where it explains what changes
_LEVEL_M = 0.5  # that two points differ in height which vote: rings are sparse
_CELL_M, _CANDIDATES, _ROUNDS = 0.2, 12, 4
_SLOWEST_M_S, _FASTEST_M_S = 8.0, 36.0  # below it registrations find the way, above it no car that is mapped drives
_FEWEST_MATCHED, _LEAST_SHARE = 60, 0.08  # of the points that changed; in woods, turning, another motion had 0.04
_FEWEST_ALL = 5
_SECTORS, _LEAST_AROUND, _A_FEW = 12, 7, 3  # of a full turn, and points in each
_ELSEWHERE, _ELSEWHERE_M = 0.5, 1.5  # of a shift, and metres at least: bushes are as large
_BY_CHANCE = 0.45  # of the matches, on average; on highways and in streets up to 0.42, in rain and noise at rest from 0.68 on
_APART_M, _ANOTHER = 0.5, 0.8  # a shift that is another one, and its share of the matches


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
        before = self.p_before + self.since_before[:, None] * velocity
        after = self.p_after + self.since_after[:, None] * velocity
        away = _tree(before).nearest(after, 1).points[:, 0] - after
        again = np.asarray(np.linalg.norm(away, axis=1) < near)
        return again, away[again] / self.seconds


def changed_points(first: Scan, second: Scan, turning: Turning) -> ChangedPoints:
    """What two neighbouring scans do not share.

    Args:
        first, second: in order of time.
        turning: how the LiDAR turned.
    """
    middles = np.array([(scan.start_ns + scan.end_ns) // 2 for scan in (first, second)])
    R = turning(middles)
    before, since_before = _still(first, turning)
    after, since_after = _still(second, turning)
    after, seconds = after @ (R[0].T @ R[1]).T, float(middles[1] - middles[0]) * 1e-9
    new, old = _unexplained(after, before), _unexplained(before, after)
    return ChangedPoints(before[old], after[new], since_before[old], since_after[new] + seconds, seconds)


@dataclass(frozen=True, slots=True)
class CommonMotion:
    """A motion that explains what changes.

    Attributes:
        pairs: what changes from scan to scan, along the axes of the LiDAR in the middle of the first scan.
        R_first_lidar: (K, 3, 3) how it was turned in the middles of the scans.
        velocity: (3,) what most points have in common [m/s], along the first scan's axes.
        level: (3, 3) the projection onto the plane in which it lies.
    """

    pairs: Sequence[ChangedPoints]
    R_first_lidar: NDArray[np.float64]
    velocity: NDArray[np.float64]
    level: NDArray[np.float64]

    def twists(self, axis: NDArray[np.float64] | None = None) -> list[Twist]:
        """How the LiDAR moved to every scan (nothing to the first); along a unit axis (3,) where that is known better."""
        velocity, level, R = self.velocity, self.level, self.R_first_lidar
        if axis is not None:
            level = np.outer(axis, axis)
        twists = [(np.zeros(3), np.zeros(3))]
        for k, pair in enumerate(self.pairs):
            velocity = _refined([pair], velocity, level)[0]
            own = _settled(pair, velocity)
            rate = so3.log(R[k].T @ R[k + 1]) / pair.seconds
            twists.append((rate, (R[k] @ so3.exp(0.5 * pair.seconds * rate)).T @ own))
        return twists


def common_motion(scans: Sequence[Scan], turning: Turning, up_lidar: NDArray[np.float64]) -> CommonMotion | str | None:
    """The motion that explains what changes; a sentence where it is not clear which; None where nothing says that there is one.

    Args:
        scans: consecutive sweeps, at least 6.
        turning: how the LiDAR turned.
        up_lidar: (3,) unit vector, roughly upwards, in the middle of the first scan: the motion lies across it.
    """
    if len(scans) < FEWEST_SCANS:
        return None
    level = np.eye(3) - np.outer(up_lidar, up_lidar)
    R = turning(np.array([(scan.start_ns + scan.end_ns) // 2 for scan in scans]))
    R_first = np.swapaxes(R[:1], 1, 2) @ R
    first = {k: _pair(scans, k, turning, R_first[k]) for k in _PAIRS}
    found = _most_common(list(first.values()), level)
    if found is None or isinstance(found, str):
        return found
    pairs = [first.get(k) or _pair(scans, k, turning, R_first[k]) for k in range(len(scans) - 1)]
    return CommonMotion(pairs, R_first, found, level)


def _pair(scans: Sequence[Scan], k: int, turning: Turning, R: NDArray[np.float64]) -> ChangedPoints:
    """What changes between scans k and k + 1, along the axes of the first scan."""
    pair = changed_points(scans[k], scans[k + 1], turning)
    return ChangedPoints(pair.p_before @ R.T, pair.p_after @ R.T, pair.since_before, pair.since_after, pair.seconds)


def _most_common(pairs: Sequence[ChangedPoints], level: NDArray[np.float64]) -> NDArray[np.float64] | str | None:
    """The velocity (3,) that most of the points have in common."""
    candidates = [_refined(pairs, velocity, level) for velocity in _voted(pairs, level)]
    if not candidates:
        return None
    velocity, matched = max(candidates, key=lambda candidate: candidate[1])
    speed = float(np.linalg.norm(velocity))
    if not _SLOWEST_M_S < speed < _FASTEST_M_S or not _believed(pairs, velocity):
        return None
    for other, also in candidates:
        apart = float(np.linalg.norm(other - velocity))
        if also > _ANOTHER * matched and apart * pairs[0].seconds > _APART_M:
            return f"what changes from scan to scan fits {np.linalg.norm(other):.0f} m/s about as well as {speed:.0f} m/s"
    return velocity


def explains_changes(scans: Sequence[Scan], turning: Turning, twists: Sequence[Twist]) -> bool:
    """Whether a motion, of 8 m/s and more, explains what changes from scan to scan: all around, well, and better than by chance.

    Args:
        scans: consecutive sweeps.
        turning: how the LiDAR turned.
        twists: how it moved to every scan, as of `CommonMotion.twists`.
    """
    pairs, velocities = [], []
    for k in np.unique(np.linspace(0, len(scans) - 2, len(_PAIRS)).astype(int)).tolist():
        pair, (rate, velocity) = changed_points(scans[k], scans[k + 1], turning), twists[k + 1]
        pairs.append(pair)
        velocities.append(so3.exp(0.5 * pair.seconds * rate) @ velocity)
    if np.linalg.norm(velocities, axis=1).min() < _SLOWEST_M_S or not _believed(pairs, np.array(velocities)):
        return False
    missing = np.concatenate([pair.shifts(velocity)[1] for pair, velocity in zip(pairs, velocities, strict=True)])
    along = velocities[0] / np.linalg.norm(velocities[0])
    return bool(abs(np.median(missing @ along)) * pairs[0].seconds < _WELL_M)


def _voted(pairs: Sequence[ChangedPoints], level: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The velocities (3,) that the most pairs of points vote for."""
    votes = [np.zeros((0, 3))]
    random = np.random.Generator(np.random.PCG64(0))
    for pair in pairs:
        i, j = (random.permutation(len(p))[:_MOST_VOTERS] for p in (pair.p_before, pair.p_after))
        seconds = (pair.since_after[j][None] - pair.since_before[i][:, None]).ravel()
        apart = (pair.p_before[i][:, None] - pair.p_after[j][None]).reshape(-1, 3)
        flat = apart @ level
        length, height = np.linalg.norm(flat, axis=1), np.linalg.norm(apart - flat, axis=1)
        near = (seconds > 0.0) & (length < _FASTEST_M_S * seconds) & (height < _LEVEL_M)
        votes.append(flat[near] / seconds[near, None])
    cell = _CELL_M / pairs[0].seconds
    cells, counts = np.unique(np.round(np.concatenate(votes) / cell), axis=0, return_counts=True)
    return list(cells[np.argsort(-counts, kind="stable")[:_CANDIDATES]] * cell)


def _refined(
    pairs: Sequence[ChangedPoints], velocity: NDArray[np.float64], level: NDArray[np.float64]
) -> tuple[NDArray[np.float64], int]:
    """A velocity (3,), moved to where the points are that are there again, and how many they are."""
    velocity = level @ velocity
    for _ in range(_ROUNDS):
        shifts = np.concatenate([pair.shifts(velocity)[1] for pair in pairs])
        if len(shifts) < _FEWEST_ALL:
            break
        velocity = velocity + level @ np.median(shifts, axis=0)
    return velocity, _matched(pairs, velocity)


def _settled(pair: ChangedPoints, velocity: NDArray[np.float64]) -> NDArray[np.float64]:
    """A velocity (3,) that is nearly right, moved along itself to the mean of the points that are there again."""
    axis = velocity / np.linalg.norm(velocity)
    for _ in range(_ROUNDS):
        shifts = pair.shifts(velocity, _CLOSE_M)[1]
        if len(shifts) < _FEWEST_ALL:
            break
        velocity = velocity + axis * float(axis @ shifts.mean(axis=0))
    return velocity


def _believed(pairs: Sequence[ChangedPoints], velocity: NDArray[np.float64]) -> bool:
    """Whether a velocity (3,), or one a pair (n, 3), explains enough, all around, and better than by chance."""
    matched = _matched(pairs, velocity)
    enough = max(_FEWEST_MATCHED, _LEAST_SHARE * sum(len(pair.p_after) for pair in pairs))
    if matched < enough or _around(pairs, velocity) < _LEAST_AROUND:
        return False
    speed = np.linalg.norm(velocity, axis=-1, keepdims=True)
    away = velocity * np.maximum(_ELSEWHERE, _ELSEWHERE_M / pairs[0].seconds / np.maximum(speed, 1e-9))
    by_chance = np.mean([_matched(pairs, other) for other in (-velocity, velocity - away, velocity + away)])
    return bool(by_chance <= _BY_CHANCE * matched)


def _again(pairs: Sequence[ChangedPoints], velocity: NDArray[np.float64]) -> list[NDArray[np.bool_]]:
    velocities = np.broadcast_to(velocity, (len(pairs), 3))
    return [pair.shifts(own)[0] for pair, own in zip(pairs, velocities, strict=True)]


def _matched(pairs: Sequence[ChangedPoints], velocity: NDArray[np.float64]) -> int:
    """How many points are there again."""
    return sum(int(again.sum()) for again in _again(pairs, velocity))


def _around(pairs: Sequence[ChangedPoints], velocity: NDArray[np.float64]) -> int:
    """In how many of twelve sectors around the LiDAR a few points are there again."""
    found: set[int] = set()
    for pair, again in zip(pairs, _again(pairs, velocity), strict=True):
        p = pair.p_after[again]
        sector = ((np.arctan2(p[:, 1], p[:, 0]) / (2.0 * np.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS
        found |= set(np.flatnonzero(np.bincount(sector, minlength=_SECTORS) >= _A_FEW).tolist())
    return len(found)


def _still(scan: Scan, turning: Turning) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (N, 3) [m] without the turning within the scan, and their times (N,) since its middle [s]."""
    scan = thinned(scan, _MOST_RAW)
    middle = (scan.start_ns + scan.end_ns) // 2
    p = undistorted(scan, nodes_within(scan, middle, np.zeros(3), np.zeros(3), turning), middle)
    return p.astype(np.float64), np.asarray((scan.time_ns - middle) * 1e-9, np.float64)


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
