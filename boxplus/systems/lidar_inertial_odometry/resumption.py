"""Where is a platform after a pause in which neither sensor told how it moved? Where its scan fits the map, if only there.

Within half a second hands turn by 30 degrees, and a registration that begins so far off comes to rest beside the place. So many
begin: along the arcs that turning by any angle makes of the way ahead, slower and faster, and beside them; those that fit best
already are carried on. A place counts if its scan fits there far better than anywhere else that it may have got to
(docs/lidar_inertial_odometry.md, "Pauses").
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import T_P, T_THETA, T_V, TANGENT, G, NavState, P, R, V
from boxplus.manifolds import quaternion, se3, so3
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.local_maps.config import LocalMapRegistrationConfig
from boxplus.maps.local_maps.registration import Surface, approach, mean_distance, planes_beside, refine, spread
from boxplus.maps.plane_measurement import sees_one_way
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import Frame
from boxplus.systems.lidar_inertial_odometry.watches.pause import LEAST_S

Floats = NDArray[np.float64]
Points = NDArray[np.float32]
Found = TypeVar("Found")

_TURN, _TURN_RATE, _TURNED = np.deg2rad([12.0, 120.0, 12.0])  # between starts; how fast one turns, and could have from the first
_PUSHED = 6.0  # m/s²: wheels and legs hardly ever push, brake and turn harder
_FASTER, _APART, _FAR = 1.4, 2.0, 0.5  # of the way ahead; m, between starts along it; m: of a shorter one none
_STRAYED, _STRAYED_TURN = 3.0, np.deg2rad(25.0)  # m: a registration that goes farther has left where the platform may be
_WALK, _FARTHEST = 1.5, 6.0  # m/s, m: beside the way ahead, and anywhere around where that is short
_UPWARD = 0.3  # m/s, beside the way before
_GLANCED, _ROUGH, _POINTS = 300, 1000, 1500  # points for each start, each that is carried on, and each place
_GLANCE, _CLOSE = 1.0, 0.3  # m, at which a point no longer fits
_CARRIED, _LOOKED_AT = 24, 8
_SAME_TURN, _SAME = np.deg2rad(10.0), 0.3  # m: nearer to each other than this two places are one
_DISTANCE, _STEPS = 0.8, 15
_MAPPED, _LEAST_MAPPED = 2.0, 0.3  # m; share of the points
_ASTRAY = 0.5  # m, along what is open
# Mean distance of a scan that lies where it belongs, from that of the scan before the pause: a LiDAR that sees all around has
# most of it mapped; one that sees one way may look at what is not, while another place happens to look alike. So may, after
# seconds, one that has climbed to another storey.
_GROWN, _GROWN_M, _MORE_M = 3.0, 0.02, 0.08  # times and m; m at most
_LONG_S, _GROWN_LONG, _GROWN_LONG_M = 2.0, 2.0, 0.01
_GROWN_ONE_WAY, _GROWN_ONE_WAY_M = 1.5, 0.005
_RMS = 0.06  # m, of the points on planes
# Times and m by which any other place has to fit worse: a tenth of the points may see what is not mapped yet.
_CLEARLY, _CLEARLY_M, _MAY_FIT = 1.3, 0.03, 0.06  # m: of one that may well be right
GUESSED_S = 0.75  # up to this long after the last scan its motion may be held
_HELD_S = 1.0  # the same where the scan fits along a line: nobody turns round as fast
_TURN_SIGMA, _SIGMA, _SPEED_SIGMA = 0.1, 0.3, 0.3  # rad, m, m/s: of the first state after a pause
_PUSHED_ON = 1.0  # m/s²: what a motion that goes on as before may still do
_SHORTEST = 0.5  # of the length of an arc, its chord


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where a scan fits.

    Attributes:
        T_world_imu: (7,) at the end of the scan.
        rms: robust standard deviation of the points that lie on planes [m].
        open: (k, 6) twists on the right of the pose, a metre at the points, that the surfaces leave open.
        distances: (n,) of the points from the planes of the map, none of which counts as more than 0.3 m [m].
        mapped: (n,) whether the map has anything within 2 m of them.
    """

    T_world_imu: Floats
    rms: float
    open: Floats
    distances: Floats
    mapped: NDArray[np.bool_]

    @property
    def distance(self) -> float:
        """In the mean [m]."""
        return float(self.distances.mean())


def _places(p_imu: Points, tree: IkdTree, arcs: _Arcs) -> list[Place]:
    """The places that fit best, best first: at most nine, and those beside the best one where the surfaces leave it open.

    Args:
        p_imu: (N, 3) thinned points of a scan [m], as seen from the IMU at its end.
        arcs: from the state before the pause to that time.
    """
    config, target = LocalMapRegistrationConfig(), Surface(np.zeros((0, 3), np.float32), tree)
    glanced, rough, points = (spread(p_imu, count) for count in (_GLANCED, _ROUGH, _POINTS))

    def laid(T_start: Floats) -> list[Place]:
        found = refine(points, target, T_start, config, distance=_DISTANCE, steps=_STEPS)
        if found is None:
            return []
        T, lengths = found.T_target_source, np.repeat([found.lever_m, 1.0], 3)
        distances, mapped = _distances(points, tree, T)
        return [Place(T, found.rms, found.weak / lengths, distances, mapped)]

    starts = arcs.starts()
    fits = [mean_distance(glanced, target, T, _GLANCE, config) for T in starts]
    source, carried = Surface(rough, tree), []
    for k in np.argsort(fits, kind="stable")[:_CARRIED]:
        T = approach(source, target, starts[k], config)
        if T is not None and _within(T, starts[k], _STRAYED, _STRAYED_TURN):
            carried.append((mean_distance(rough, target, T, _CLOSE, config), T))
    carried.sort(key=lambda one: one[0])
    looked_at = [*_distinct([T for _, T in carried], lambda T: T)[:_LOOKED_AT], arcs.pose(0.0)]
    found = [place for T in looked_at for place in laid(T)]
    for best in sorted(found, key=lambda place: place.distance)[:1]:
        asides = [se3.exp(sign * twist) for twist in best.open for sign in (-_ASTRAY, _ASTRAY)]
        found += [place for aside in asides for place in laid(se3.compose(best.T_world_imu, aside))]
    found = sorted((place for place in found if arcs.is_near(place.T_world_imu)), key=lambda place: place.distance)
    return _distinct(found, lambda place: place.T_world_imu)


def _seen_from_imu(p_lidar: Points, x: Floats) -> Points:
    state = NavState.unpack(x)
    return (p_lidar @ state.R_imu_lidar.T + state.p_imu_lidar).astype(np.float32)


def _distances(p_imu: Points, tree: IkdTree, T_world_imu: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """`Place.distances` and `Place.mapped` of points (n, 3) at a pose (7,)."""
    target = Surface(np.zeros((0, 3), np.float32), tree)
    planes, valid = planes_beside(p_imu, target, T_world_imu, _DISTANCE, LocalMapRegistrationConfig())
    distances = np.where(valid, np.minimum(np.abs(planes[:, 3]), _CLOSE), _CLOSE)
    return distances, tree.nearest(se3.act(T_world_imu, p_imu.astype(np.float64)), 1, max_distance=_MAPPED).counts > 0


def before_pause(frame: Frame) -> tuple[ImuSamples, int]:
    """The samples before the pause of a frame, and until when they tell [ns]."""
    time_ns = frame.imu.time_ns
    last = int(np.argmax(np.diff(time_ns, append=max(frame.scan.end_ns, int(time_ns[-1])))))
    return frame.imu.where(slice(0, last + 1)), max(int(time_ns[last]), frame.begin_ns)


def after_pause(frame: Frame) -> Frame:
    """The frame without the pause: from the beginning of its scan, with the samples since then.

    Where the IMU has not come back yet, its last sample is held.
    """
    imu, start = frame.imu, frame.scan.start_ns
    since = int(np.searchsorted(imu.time_ns, start, side="right"))
    if since and (since == len(imu) or (start - imu.time_ns[since - 1]) * 1e-9 < LEAST_S):
        since -= 1
    return replace(
        frame, imu=ImuSamples(np.maximum(imu.time_ns[since:], start), imu.gyro[since:], imu.accel[since:]), begin_ns=start
    )


@dataclass(frozen=True, slots=True, eq=False)
class Resumption:
    """Where to go on.

    Attributes:
        x: (36,) state at the beginning of the scan; None where that is not known.
        variances: (24,) to add to those of the state before the pause.
        text: what is said of it; where it is not known, why, a clause.
    """

    x: Floats | None
    variances: Floats
    text: str


def usual_distance(p_lidar: Points, x: Floats, tree: IkdTree) -> float:
    """`Place.distance` [m] of the thinned points (n, 3) of a scan that lies where it belongs, at the state (36,) of its end."""
    T_world_imu = np.concatenate([quaternion.from_matrix(x[R : R + 9].reshape(3, 3)), x[P : P + 3]])
    return float(_distances(spread(_seen_from_imu(p_lidar, x), _POINTS), tree, T_world_imu)[0].mean())


def resumption(
    x: Floats, usual_m: float, x_end: Floats, p_lidar: Points, tree: IkdTree, scan: Scan, seconds: float
) -> Resumption:
    """Where to go on after a pause.

    Args:
        x: (36,) state at its begin; usual_m: `usual_distance` of the scan before.
        x_end: what the IMU makes of x from the beginning of the scan to its end.
        p_lidar: (N, 3) thinned points of the scan as seen from the LiDAR at its end [m].
        scan: the first one after the pause; it ends so many `seconds` after its begin.
    """
    arcs, scan_s = _Arcs(x, seconds), (scan.end_ns - scan.start_ns) * 1e-9
    found = _places(_seen_from_imu(p_lidar, x), tree, arcs)
    told = f"neither sensor told for {seconds - scan_s:.1f} s how the platform moved"
    if not found or found[0].distance > _largest(usual_m, seconds, sees_one_way(p_lidar)) or found[0].rms > _RMS:
        return _nowhere(f"{told}, and the scan after it fits the map at no place that the platform may have got to")
    alike = [found[0], *(place for place in found[1:] if _fits_alike(found[0], place))]
    alone = len(alike) == 1
    place = found[0] if alone else _as_before(alike, arcs, seconds)
    if place is None:
        apart = np.linalg.norm(alike[1].T_world_imu[4:] - alike[0].T_world_imu[4:])
        turned = np.rad2deg(_turned(alike[0].T_world_imu, alike[1].T_world_imu))
        return _nowhere(f"{told}, and the scan after it fits the map alike at places {apart:.1f} m and {turned:.0f} deg apart")
    again = _at_begin(place, x, x_end, arcs, scan_s)
    variances, sigma = np.zeros(TANGENT), _SIGMA if alone else _SIGMA + _PUSHED_ON * seconds**2
    variances[T_THETA : T_THETA + 3], variances[T_P : T_P + 3] = _TURN_SIGMA**2, sigma**2
    variances[T_V : T_V + 3] = (_SPEED_SIGMA + 2.0 * _PUSHED_ON * seconds) ** 2
    moved = float(np.linalg.norm(again[P : P + 3] - x[P : P + 3]))
    where = "at the one place where the scan fits the map"
    if not alone:
        where = "where it would be, had it gone on as before, of the places at which the scan fits the map alike"
    return Resumption(again, variances, f"{told}: found again {moved:.1f} m from where it was, {where}")


def _largest(usual_m: float, seconds: float, one_way: bool) -> float:
    """`Place.distance` [m] of a scan that lies where it belongs, at most."""
    if one_way:
        return _GROWN_ONE_WAY * usual_m + _GROWN_ONE_WAY_M
    if seconds > _LONG_S:
        return min(_GROWN_LONG * usual_m + _GROWN_LONG_M, usual_m + _MORE_M)
    return min(_GROWN * usual_m + _GROWN_M, usual_m + _MORE_M)


def _fits_alike(best: Place, other: Place) -> bool:
    """Whether a scan fits as well at another place.

    Where a tunnel lies ahead that nobody has seen yet, the scan fits better the farther back it is laid. Of places that the
    platform slides between, only what lies where something is mapped at both tells.
    """
    both = best.mapped & other.mapped
    if _turned(best.T_world_imu, other.T_world_imu) > _SAME_TURN or both.mean() < _LEAST_MAPPED:
        both[:] = True
    least = float(best.distances[both].mean())
    return float(other.distances[both].mean()) < max(_CLEARLY * least, least + _CLEARLY_M, _MAY_FIT)


def _nowhere(why: str) -> Resumption:
    return Resumption(None, np.zeros(TANGENT), why)


def _as_before(alike: Sequence[Place], arcs: _Arcs, seconds: float) -> Place | None:
    """Of places that fit alike, as along a corridor, that of a platform that went on as before; None where that cannot tell."""
    place = min(alike, key=lambda one: float(np.linalg.norm(arcs.off(one.T_world_imu))))
    off = float(np.linalg.norm(arcs.off(place.T_world_imu)))
    turned = any(_turned(place.T_world_imu, other.T_world_imu) > _SAME_TURN for other in alike)
    if turned or seconds > _HELD_S or off > _SIGMA + _PUSHED_ON * seconds**2:
        return None
    return place


def _at_begin(place: Place, x: Floats, x_end: Floats, arcs: _Arcs, scan_s: float) -> Floats:
    """(36,) state at the beginning of a scan that ends at a place.

    Args:
        x: (36,) before the pause; x_end: what the IMU makes of it through the scan, which lasts `scan_s`.
    """
    again, R_turned = x.copy(), x[R : R + 9].reshape(3, 3).T @ x_end[R : R + 9].reshape(3, 3)
    again[R : R + 9] = (quaternion.to_matrix(place.T_world_imu[:4]) @ R_turned.T).ravel()
    again[V : V + 3] = arcs.speed(place.T_world_imu)
    again[P : P + 3] = place.T_world_imu[4:] - scan_s * again[V : V + 3]
    return again


class _Arcs:
    """Where a platform gets to from a state (36,) within seconds that goes on and turns about the vertical."""

    def __init__(self, x: Floats, seconds: float) -> None:
        self._R_world_imu, self._p, self._v = x[R : R + 9].reshape(3, 3), x[P : P + 3], x[V : V + 3]
        self._up = -x[G : G + 3] / np.linalg.norm(x[G : G + 3])
        self._seconds, self._speed = seconds, float(np.linalg.norm(self._v))
        self._slack = 0.5 * _PUSHED * seconds**2

    def pose(self, turn: float, factor: float = 1.0, aside: Floats | float = 0.0) -> Floats:
        """T_world_imu (7,) after a turn [rad] and a factor of the way, moved by `aside` [m]."""
        q = quaternion.from_matrix(so3.exp(turn * self._up) @ self._R_world_imu)
        return np.concatenate([q, self._p + factor * self._chord(turn) + aside])

    def speed(self, T_world_imu: Floats) -> Floats:
        """(3,) velocity at the end of an arc that leads to a pose (7,) [m/s]."""
        turn = self._turn(T_world_imu)
        velocity: Floats = so3.exp(0.5 * turn * self._up) @ (T_world_imu[4:] - self._p)
        return velocity / (self._seconds * max(np.sinc(0.5 * turn / np.pi), _SHORTEST))

    def off(self, T_world_imu: Floats) -> Floats:
        """(3,) from where one would be that turned as far to a pose (7,) [m]."""
        off: Floats = T_world_imu[4:] - self._p - self._chord(self._turn(T_world_imu))
        return off

    def is_near(self, T_world_imu: Floats) -> bool:
        """Whether legs and wheels may have pushed it there; up and down they hardly do, and storeys are alike."""
        off = self.off(T_world_imu)
        is_level = abs(float(self._up @ off)) < _UPWARD * self._seconds + _SIGMA
        return is_level and float(np.linalg.norm(off)) < self._slack + _WALK * self._seconds + _SIGMA

    def starts(self) -> list[Floats]:
        """Poses (7,) to look around."""
        most = min(min(_TURN_RATE, _PUSHED / max(self._speed, 1e-3)) * self._seconds + _TURNED, math.pi)
        way, factors = self._speed * self._seconds, np.ones(1)
        if way > _FAR:
            least, farthest = max(way - self._slack, 0.0), min(way + self._slack, _FASTER * way)
            factors = np.linspace(least, farthest, 1 + math.ceil((farthest - least) / _APART)) / way
        beside = self._around(min(_WALK * self._seconds, _FARTHEST), rings=way < _WALK * self._seconds)
        poses = []
        for turn in np.linspace(-most, most, 2 * math.ceil(most / _TURN) + 1):
            poses += [self.pose(turn, factor) for factor in factors] + [self.pose(turn, 1.0, aside) for aside in beside]
        return poses

    def _around(self, radius: float, *, rings: bool) -> Floats:
        """(n, 3) offsets on the level [m]: four, or in rings that leave no gap."""
        count = math.ceil(radius / _APART) if rings else 1
        e, f = np.linalg.qr(self._up[:, None], mode="complete")[0][:, 1:].T
        sides = 6 if rings else 4
        angles = [(k * radius / count, 2.0 * np.pi * j / (sides * k)) for k in range(1, count + 1) for j in range(sides * k)]
        return np.array([r * (np.cos(a) * e + np.sin(a) * f) for r, a in angles])

    def _turn(self, T_world_imu: Floats) -> float:
        return float(self._up @ so3.log(quaternion.to_matrix(T_world_imu[:4]) @ self._R_world_imu.T))

    def _chord(self, turn: float) -> Floats:
        chord: Floats = so3.exp(0.5 * turn * self._up) @ self._v * (self._seconds * np.sinc(0.5 * turn / np.pi))
        return chord


def _distinct(found: Sequence[Found], pose: Callable[[Found], Floats]) -> list[Found]:
    """Of those whose poses (7,) are near to each other the first."""
    kept: list[Found] = []
    for own in found:
        if not any(_within(pose(own), pose(other), _SAME, _SAME_TURN) for other in kept):
            kept.append(own)
    return kept


def _within(A: Floats, B: Floats, apart: float, turned: float) -> bool:
    """Whether two poses (7,) are no farther from each other than this [m, rad]."""
    return bool(np.linalg.norm(A[4:] - B[4:]) < apart and _turned(A, B) < turned)


def _turned(A: Floats, B: Floats) -> float:
    """The angle between two poses (7,) [rad]."""
    return float(np.linalg.norm(se3.log(se3.compose(se3.inverse(A), B))[:3]))
