"""The one motion that explains what changes from scan to scan, where all else goes along with the LiDAR.

On a highway the rings on the road, the rails and the walls look the same from every place: a registration, point to plane, stays
with them at rest while the platform drives. What does change are posts, bushes, signs and parked cars, some in a hundred of all
points, and they all change by the same shift. So those points of two neighbouring scans are taken that lie neither near a point
of the other nor on a surface of it, every two of them vote for a velocity, and the one that most of them have in common is
believed if it is had all around, and if neither that velocity reversed nor half of it nor half more explains about as many:
noise, rain, lost packets and moving people change points too, but do not do that. Traffic of one direction on both sides of a
platform at rest does: it is told by where it is, on the lanes next to the platform and not beyond them, and by what stands on the
ground and stays where it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._words import signed
from boxplus.manifolds import so3
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.changes.changed_points import ChangedPoints, changed_points
from boxplus.systems.lidar_inertial_agreement.lidar_path.changes.standing import (
    ASIDE_M,
    FASTEST_M_S,
    FEWEST_SCANS,
    shows_rest,
    stay_and_go,
)
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath, Twist
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import Turning, middle_of

_PAIRS = 0, 2, 4  # first scans of those that vote
_MOST_VOTERS = 800
_CLOSE_M = 0.15  # from one of them, a point is there again where the motion is nearly right
_WELL_M, _WELL_SHARE = 0.08, 0.1  # that a motion is off in the median, where it explains what changes
_LEVEL_M = 0.5  # that two points differ in height which vote: rings are sparse
_CELL_M, _MOST_CELLS, _CANDIDATES, _ROUNDS = 0.2, 400, 16, 4
_SLOWEST_M_S, _SLOWEST_M = 8.0, 0.6  # slower, or by less, registrations find the way
_FEWEST_MATCHED, _LEAST_SHARE = 60, 0.08  # of the points that changed; in woods, turning, another motion had 0.04
_FEWEST_AGAIN = 5
_SECTORS, _LEAST_AROUND, _A_FEW = 12, 7, 3  # of a full turn, and points in each
_ELSEWHERE, _ELSEWHERE_M = 0.5, 1.5  # of a shift, and metres at least: bushes are as large
_BY_CHANCE = 0.45  # of the matches, on average; on highways and in streets up to 0.42, in rain and noise at rest from 0.68 on
_APART_M, _ANOTHER = 0.5, 0.8  # a shift that is another one, and its share of the matches
_BEYOND = 0.6  # share of the matches beyond where the traffic next to a platform is
_PLACE_M, _FEWEST_PLACES = 2.0, 70  # beyond it: at rest among traffic up to 46, in streets from 75 on
_MOST_GOING = 20  # points that may seem to go by at rest: what goes by tells of a motion, whatever keeps pace with it
_STAYING, _FEWEST_STAYING = 0.35, 20  # of those that go by the common motion, and at least; on drives up to 0.26


@dataclass(frozen=True, slots=True)
class CommonMotion:
    """A motion that explains what changes.

    Attributes:
        pairs: what changes from scan to scan, along the axes of the LiDAR in the middle of the first scan.
        R_first_lidar: (K, 3, 3) how it was turned in the middles of the scans.
        velocity: (3,) what most points have in common [m/s], along the first scan's axes.
        level: (3, 3) the projection onto the plane in which it lies.
        doubt: what speaks against it, a sentence; empty where nothing does.
        may_rest: whether the doubt is that the platform rests, and not that it moves otherwise.
    """

    pairs: Sequence[ChangedPoints]
    R_first_lidar: NDArray[np.float64]
    velocity: NDArray[np.float64]
    level: NDArray[np.float64]
    doubt: str = ""
    may_rest: bool = False

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


def common_motion(scans: Sequence[Scan], turning: Turning, up_lidar: NDArray[np.float64]) -> CommonMotion | None:
    """The motion that explains what changes; None where nothing says that there is one.

    Args:
        scans: consecutive sweeps, at least 6.
        turning: how the LiDAR turned.
        up_lidar: (3,) unit vector, roughly upwards, in the middle of the first scan: the motion lies across it.
    """
    if len(scans) < FEWEST_SCANS:
        return None
    level = np.eye(3) - np.outer(up_lidar, up_lidar)
    R_first = _turned(turning, np.array([middle_of(scan) for scan in scans]))
    first = {k: _pair(scans, k, turning, R_first[k]) for k in _PAIRS}
    voting = list(first.values())
    candidates = [_refined(voting, velocity, level) for velocity in _voted(voting, level)]
    if not candidates:
        return None
    velocity, matched = max(candidates, key=lambda candidate: candidate[1])
    if not _slowest(voting[0].seconds) < np.linalg.norm(velocity) < FASTEST_M_S or not _believed(voting, velocity):
        return None
    stay, go = _stay_and_go(scans, turning, R_first, np.broadcast_to(velocity, (len(_PAIRS), 3)), up_lidar)
    rests = stay > max(go, _FEWEST_STAYING) or shows_rest(scans, velocity / np.linalg.norm(velocity), up_lidar)
    if rests and go <= _MOST_GOING:
        return None
    doubt = _traffic(voting, velocity, up_lidar)
    if rests or _stays(stay, go):
        doubt = _staying(stay, go, float(np.linalg.norm(velocity)))
    may_rest = bool(doubt)
    for other, also in candidates:
        if also > _ANOTHER * matched and float(np.linalg.norm(other - velocity)) * voting[0].seconds > _APART_M:
            doubt = doubt or f"what changes fits {signed(other, 1)} m/s (LiDAR axes) about as well as {signed(velocity, 1)} m/s"
    pairs = [first.get(k) or _pair(scans, k, turning, R_first[k]) for k in range(len(scans) - 1)]
    return CommonMotion(pairs, R_first, velocity, level, doubt, may_rest)


def speaks_against(path: LidarPath, scans: Sequence[Scan], turning: Turning, up_lidar: NDArray[np.float64]) -> str:
    """What speaks against the motion of a path, as fast as one that is looked for, a sentence; empty where nothing does.

    Registrations may follow what drives around a platform at rest: things that stand stay where they are then.

    Args:
        path: through these scans; one that lacks a scan says nothing.
        scans, turning, up_lidar: as of `common_motion`.
    """
    if len(scans) < FEWEST_SCANS or len(path) < len(scans):
        return ""
    R_first = _turned(turning, path.time_ns)
    seconds = np.diff(path.time_ns)[:, None] * 1e-9
    velocities = (np.diff(path.p_path_lidar, axis=0) / seconds)[list(_PAIRS)]
    if np.linalg.norm(velocities, axis=1).min() < _slowest(float(seconds[0, 0])):
        return ""
    stay, go = _stay_and_go(scans, turning, R_first, velocities, up_lidar)
    return _staying(stay, go, float(np.linalg.norm(velocities[0]))) if _stays(stay, go) else ""


def _turned(turning: Turning, time_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """(K, 3, 3) attitudes at some times [ns], along the axes at the first of them."""
    R = turning(time_ns)
    return np.swapaxes(R[:1], 1, 2) @ R


def _stay_and_go(
    scans: Sequence[Scan],
    turning: Turning,
    R_first: NDArray[np.float64],
    velocities: NDArray[np.float64],
    up_lidar: NDArray[np.float64],
) -> tuple[int, int]:
    """How many points of what stands stay and go by, with a velocity for every pair that votes (n, 3), along the first axes."""
    stay, go = np.sum(
        [
            stay_and_go((scans[k], scans[k + 1]), turning, R_first[k].T @ velocity, R_first[k].T @ up_lidar)
            for k, velocity in zip(_PAIRS, velocities, strict=True)
        ],
        axis=0,
    ).tolist()
    return stay, go


def _stays(stay: int, go: int) -> bool:
    return stay > max(_STAYING * go, _FEWEST_STAYING)


def _staying(stay: int, go: int, speed: float) -> str:
    return f"of what stands on the ground, {stay} points stay and {go} go by, as at {speed:.0f} m/s"


def _pair(scans: Sequence[Scan], k: int, turning: Turning, R: NDArray[np.float64]) -> ChangedPoints:
    """What changes between scans k and k + 1, along the axes of the first scan."""
    pair = changed_points(scans[k], scans[k + 1], turning)
    return ChangedPoints(pair.p_before @ R.T, pair.p_after @ R.T, pair.since_before, pair.since_after, pair.seconds)


def _slowest(seconds: float) -> float:
    """The slowest motion that is looked for [m/s], for scans so far apart."""
    return min(_SLOWEST_M_S, _SLOWEST_M / seconds)


def _traffic(pairs: Sequence[ChangedPoints], velocity: NDArray[np.float64], up: NDArray[np.float64]) -> str:
    """That what changes is where traffic beside a platform at rest would be, a sentence; empty where it is not."""
    matched = np.concatenate(_again(pairs, velocity))
    along = velocity / np.linalg.norm(velocity)
    across = matched @ np.cross(up, along)
    far = np.abs(across) > ASIDE_M
    places = np.unique(np.round(np.stack([across, matched @ along])[:, far] / _PLACE_M), axis=1).shape[1]
    beyond = float(far.mean())
    if beyond >= _BEYOND or places >= _FEWEST_PLACES:
        return ""
    return (
        f"{1.0 - beyond:.0%} of what goes by as at {np.linalg.norm(velocity):.0f} m/s lies within {ASIDE_M:.0f} m of the way, "
        "where traffic beside a platform at rest would be"
    )


def explains_changes(scans: Sequence[Scan], turning: Turning, twists: Sequence[Twist]) -> bool:
    """Whether a motion, as fast as one that is looked for, explains what changes: all around, well, and better than by chance.

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
    if np.linalg.norm(velocities, axis=1).min() < _slowest(pairs[0].seconds) or not _believed(pairs, np.array(velocities)):
        return False
    missing = np.concatenate([pair.shifts(velocity)[1] for pair, velocity in zip(pairs, velocities, strict=True)])
    along = velocities[0] / np.linalg.norm(velocities[0])
    shift = float(np.linalg.norm(velocities[0])) * pairs[0].seconds
    return bool(abs(np.median(missing @ along)) * pairs[0].seconds < min(_WELL_M, _WELL_SHARE * shift))


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
        near = (seconds > 0.0) & (length < FASTEST_M_S * seconds) & (height < _LEVEL_M)
        votes.append(flat[near] / seconds[near, None])
    cell = _CELL_M / pairs[0].seconds
    cells, counts = np.unique(np.round(np.concatenate(votes) / cell), axis=0, return_counts=True)
    chosen = np.zeros((0, 3))
    for candidate in cells[np.argsort(-counts, kind="stable")[:_MOST_CELLS]]:
        if len(chosen) < _CANDIDATES and (np.linalg.norm(chosen - candidate, axis=1) * _CELL_M > _APART_M).all():
            chosen = np.vstack([chosen, candidate])
    return list(chosen * cell)


def _refined(
    pairs: Sequence[ChangedPoints], velocity: NDArray[np.float64], level: NDArray[np.float64]
) -> tuple[NDArray[np.float64], int]:
    """A velocity (3,), moved to where the points are that are there again, and how many they are."""
    velocity = level @ velocity
    for _ in range(_ROUNDS):
        shifts = np.concatenate([pair.shifts(velocity)[1] for pair in pairs])
        if len(shifts) < _FEWEST_AGAIN:
            break
        velocity = velocity + level @ np.median(shifts, axis=0)
    return velocity, _matched(pairs, velocity)


def _settled(pair: ChangedPoints, velocity: NDArray[np.float64]) -> NDArray[np.float64]:
    """A velocity (3,) that is nearly right, moved along itself to the mean of the points that are there again."""
    axis = velocity / np.linalg.norm(velocity)
    for _ in range(_ROUNDS):
        shifts = pair.shifts(velocity, _CLOSE_M)[1]
        if len(shifts) < _FEWEST_AGAIN:
            break
        velocity = velocity + axis * float(axis @ shifts.mean(axis=0))
    return velocity


def _believed(pairs: Sequence[ChangedPoints], velocity: NDArray[np.float64]) -> bool:
    """Whether a velocity (3,), or one a pair (n, 3), explains enough, all around, and better than by chance."""
    again = _again(pairs, velocity)
    matched = sum(map(len, again))
    enough = max(_FEWEST_MATCHED, _LEAST_SHARE * sum(len(pair.p_after) for pair in pairs))
    if matched < enough or _around(again) < _LEAST_AROUND:
        return False
    speed = np.linalg.norm(velocity, axis=-1, keepdims=True)
    away = velocity * np.maximum(_ELSEWHERE, _ELSEWHERE_M / pairs[0].seconds / np.maximum(speed, 1e-9))
    by_chance = np.mean([_matched(pairs, other) for other in (-velocity, velocity - away, velocity + away)])
    return bool(by_chance <= _BY_CHANCE * matched)


def _again(pairs: Sequence[ChangedPoints], velocity: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The later points of every pair (m, 3) that are there again at a velocity (3,), or one a pair (n, 3)."""
    velocities = np.broadcast_to(velocity, (len(pairs), 3))
    return [pair.p_after[pair.shifts(own)[0]] for pair, own in zip(pairs, velocities, strict=True)]


def _matched(pairs: Sequence[ChangedPoints], velocity: NDArray[np.float64]) -> int:
    """How many points are there again."""
    return sum(map(len, _again(pairs, velocity)))


def _around(again: Sequence[NDArray[np.float64]]) -> int:
    """In how many of twelve sectors around the LiDAR a few points are there again, in its plane or, if it is tilted, theirs."""
    towards = np.concatenate(again)
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
    return max(_sectors(again, plane) for plane in (np.eye(3)[:, :2], np.linalg.eigh(towards.T @ towards)[1][:, 1:]))


def _sectors(matched: Sequence[NDArray[np.float64]], plane: NDArray[np.float64]) -> int:
    """In how many sectors of a plane, spanned by two columns (3, 2), there are a few points of any list of them."""
    found: set[int] = set()
    for p in matched:
        ahead, aside = (p @ plane).T
        sector = ((np.arctan2(aside, ahead) / (2.0 * np.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS
        found |= set(np.flatnonzero(np.bincount(sector, minlength=_SECTORS) >= _A_FEW).tolist())
    return len(found)
