"""A path of the LiDAR that grows scan by scan: each is registered to a map of those before it, from where it is expected.

A first and a second scan may fit each other at several speeds. Then the track forks, and later scans tell (`lidar_motion`).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.degeneracy import PoseDirections
from boxplus.filtering.nav_state import NavState, P, R
from boxplus.filtering.plane_information import ONE_LINE
from boxplus.manifolds import so3
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.plane_measurement import REASONS, PlaneMeasurement
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.downsampling import VoxelFilter
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath, Twist
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import (
    FEWEST_USED,
    GOOD_MISFIT_M,
    Turning,
    align,
    honest_information,
    middle_of,
    nodes_within,
    thinned,
    undistorted,
    with_held,
)

MOST_POINTS = 1500  # that a scan is registered with
MOST_MAP_POINTS = 5000  # that it leaves in the map
MOST_RAW = 12_000  # that it is undistorted and filtered from
_PASSES = 3  # undistort, register: the motion found undistorts better than the one expected
# The steps of a path have a floor of noise: a direction may count that says hardly more than noise.
_WEAK = 0.7
_INDEPENDENT_M = 0.5  # between points whose errors are independent
_SAME_MOTION = 2e-3  # rad and m between passes
_COARSE, _FEW = 3, 300  # every so many points are enough for a first pass, where so many stay
_ROUGHLY = 2e-3  # rad and m of the last step of a first pass, which a wrong motion has undistorted
_FASTEST = 35.0, 70.0  # rad/s, m/s: beyond it a registration has gone astray
_LEAST_SHARE = 0.1  # of the points lie on the map, or the scan is not registered; in an open field a fifth of them do at rest
_SAME_START = 0.005, 0.02  # rad and m between two expectations
_SAME_POSE = 0.002, 0.005  # rad and m between what first passes have come to
_FIRST_SPEEDS = 5.0, 10.0  # m/s, both ways along every axis
_MOST_SEARCHES = 3  # failures after which no speed is tried any more: it is not the speed
_SETTLES, _SETTLED_M_S, _SAME_RATE = 4, 0.3, 0.05  # rounds; m/s and rad/s between two motions that are one
_MOST_RIVALS, _RIVAL_COST = 3, 1.3  # and times the least cost
_POOR = 1.5  # times the usual misfit: worth another guess
_LONGEST_STEP_S = 1.0


class Track:
    """Registers scans one after the other; arguments as for `lidar_path`."""

    def __init__(
        self,
        config: RegistrationConfig,
        guesses: Sequence[Turning] = (),
        *,
        undistort: bool = False,
        velocity: NDArray[np.float64] | None = None,
        held: bool = False,
    ) -> None:
        self._config = config.model_copy(update={"weak_threshold": min(config.weak_threshold, _WEAK)})
        self._of_few = self._config.model_copy(update={"min_points": max(config.min_points, FEWEST_USED)})
        self._guesses = tuple(guesses)
        self._undistort, self._held = undistort and bool(guesses), held
        self._filter = VoxelFilter(max(config.scan_voxel, config.map_cell), MOST_POINTS)
        self._map_filter = VoxelFilter(config.map_cell, MOST_MAP_POINTS)
        self._poses: list[_Pose] = []
        self._lasted_s: list[float] = []
        self._failed = 0
        self._segment = -1
        self._usual = 0.0
        self._restart()
        if velocity is not None:
            self._velocity = velocity.copy()

    def _restart(self) -> None:
        self._tree = IkdTree(cell_size=self._config.map_cell, rebuild="inplace")
        self._segment += 1
        self._first: Scan | None = None
        self._previous_ns: int | None = None
        self._x = NavState.identity().pack()
        self._rate, self._velocity = np.zeros(3), np.zeros(3)  # LiDAR frame, and along the path's axes

    def path(self) -> LidarPath:
        """What has been found so far."""
        poses = self._poses
        return LidarPath(
            np.array([pose.time_ns for pose in poses], np.int64),
            np.array([pose.R for pose in poses]).reshape(-1, 3, 3),
            np.array([pose.p for pose in poses]).reshape(-1, 3),
            np.array([pose.information for pose in poses]).reshape(-1, 6, 6),
            np.array([pose.segment for pose in poses], np.int64),
            np.array([pose.weak for pose in poses], bool),
            np.array([pose.misfit for pose in poses], np.float64),
            np.array([pose.cost for pose in poses], np.float64),
            self._failed,
            float(np.median(self._lasted_s)) if self._lasted_s else 0.0,
        )

    @property
    def failed(self) -> int:
        """Scans that could not be registered so far."""
        return self._failed

    @property
    def length(self) -> int:
        """Poses since the track began, or began anew."""
        return sum(pose.segment == self._segment for pose in self._poses)

    @property
    def cost(self) -> float:
        """What they have cost."""
        return sum(pose.cost for pose in self._poses if pose.segment == self._segment)

    def add(self, scan: Scan, expected: Twist | None = None) -> list[Track]:
        """Register the next scan; `expected` is one more start. Returns itself, and others where it may go on otherwise."""
        if len(scan) < self._config.min_points:
            self._failed += 1
            self._restart()
            return [self]
        self._lasted_s.append((scan.end_ns - scan.start_ns) * 1e-9)
        scan, middle_ns = thinned(scan, MOST_RAW), middle_of(scan)
        if self._previous_ns is None:
            self._begin(scan, middle_ns)
            return [self]
        step_s = (middle_ns - self._previous_ns) * 1e-9
        if not 0.0 < step_s < _LONGEST_STEP_S:
            self._restart()
            self._begin(scan, middle_ns)
            return [self]
        if self._first is None:
            fit = self._best(scan, middle_ns, step_s, expected)
            found = [] if fit is None else [(fit, self._tree)]
        else:
            found = self._second(self._first, scan, middle_ns, step_s, expected)
            self._first = None
        if not found:
            self._failed += 1
            self._restart()
            self._begin(scan, middle_ns)
            return [self]
        tracks = [self, *(self._fork() for _ in found[1:])]
        for track, (fit, tree) in zip(tracks, found, strict=True):
            track._go_on(fit, tree, middle_ns)
        return tracks

    def _fork(self) -> Track:
        """Another one that has come as far, and goes on by itself."""
        other = copy.copy(self)
        other._poses, other._lasted_s = list(self._poses), list(self._lasted_s)
        other._filter, other._map_filter = copy.deepcopy(self._filter), copy.deepcopy(self._map_filter)
        return other

    def _go_on(self, fit: _Fit, tree: IkdTree, middle_ns: int) -> None:
        self._usual = fit.misfit if self._usual == 0.0 else 0.9 * self._usual + 0.1 * fit.misfit
        self._x, self._rate, self._velocity, self._tree = fit.x, fit.rate, fit.velocity, tree
        self._keep(middle_ns, fit.information, bool(fit.weak.size), fit.misfit, fit.cost)
        self._tree.insert(NavState.unpack(fit.x).to_world(fit.map_points), downsample=True)
        self._previous_ns = middle_ns

    def _second(
        self, first: Scan, scan: Scan, middle_ns: int, step_s: float, expected: Twist | None
    ) -> list[tuple[_Fit, IkdTree]]:
        """The fits of a second scan, the best one first, each with the map that the first scan makes at its motion.

        The first was taken as it came. At 8 m/s it and the next are distorted alike, and fit each other where they are: where
        rest does not fit well, both are tried at speed.
        """
        best = self._best(scan, middle_ns, step_s, expected)
        if best is not None:
            self._tree, self._rate, self._velocity = self._map_of(first, best.rate, best.velocity), best.rate, best.velocity
            best = self._best(scan, middle_ns, step_s, expected)
        found = [] if best is None else [(best, self._tree)]
        if expected is not None or self._failed > _MOST_SEARCHES or (best is not None and best.misfit < GOOD_MISFIT_M):
            return found
        rate = self._turning(middle_ns, step_s)[0]
        tried: list[NDArray[np.float64]] = []
        for velocity in (speed * axis for speed in _FIRST_SPEEDS for axis in np.vstack([np.eye(3), -np.eye(3)])):
            fit = self._settled(first, scan, middle_ns, step_s, rate, velocity, tried)
            if fit is not None:
                found.append((fit, self._tree))
        rivals: list[tuple[_Fit, IkdTree]] = []
        for fit, tree in sorted(found, key=lambda one: one[0].cost):
            if all(fit.cost < _RIVAL_COST * other.cost and not _same_motion(fit, other) for other, _ in rivals):
                rivals.append((fit, tree))
        return rivals[: 1 + _MOST_RIVALS]

    def _settled(
        self,
        first: Scan,
        scan: Scan,
        middle_ns: int,
        step_s: float,
        rate: NDArray[np.float64],
        velocity: NDArray[np.float64],
        tried: list[NDArray[np.float64]],
    ) -> _Fit | None:
        """The fit at one speed, on the map that the first scan makes at the speed that is found; None where it fails.

        Args:
            tried: speeds at which others went on; those of this one are added, and it ends where it comes to one of them.
        """
        fit = None
        for _ in range(_SETTLES):
            if any(np.abs(velocity - other).max() < _SETTLED_M_S for other in tried):
                return None
            tried.append(velocity)
            self._tree = self._map_of(first, rate, velocity)
            fit = self._register(scan, middle_ns, step_s, rate, velocity)
            if fit is None or np.abs(fit.velocity - velocity).max() < _SETTLED_M_S:
                break
            rate, velocity = fit.rate, fit.velocity
        return fit

    def _turning(self, middle_ns: int, step_s: float) -> list[NDArray[np.float64]]:
        """The turn rates (3,) [rad/s] of the guesses on the way to a scan; the last one found where there are none."""
        rates = []
        for guess in self._guesses:
            R_guess = guess(np.array([middle_ns - round(step_s * 1e9), middle_ns]))
            rates.append(so3.log(R_guess[0].T @ R_guess[1]) / step_s)
        return rates or [self._rate]

    def _map_of(self, first: Scan, rate: NDArray[np.float64], velocity: NDArray[np.float64]) -> IkdTree:
        """The map that a first scan makes for a LiDAR that moves like this."""
        tree = IkdTree(cell_size=self._config.map_cell, rebuild="inplace")
        first_ns = middle_of(first)
        still = undistorted(first, self._nodes(first, first_ns, rate, velocity), first_ns)
        tree.insert(self._map_filter(still)[1].astype(np.float64), downsample=True)
        return tree

    def _begin(self, scan: Scan, middle_ns: int) -> None:
        self._previous_ns = middle_ns
        self._first = scan
        self._keep(middle_ns, np.zeros((6, 6)), False, 0.0, 0.0)
        self._tree.insert(self._map_filter(scan.p_lidar)[1].astype(np.float64), downsample=True)

    def _keep(self, middle_ns: int, information: NDArray[np.float64], weak: bool, misfit: float, cost: float) -> None:
        R_path_lidar, p_path_lidar = self._x[R : R + 9].reshape(3, 3).copy(), self._x[P : P + 3].copy()
        self._poses.append(_Pose(middle_ns, R_path_lidar, p_path_lidar, information, self._segment, weak, misfit, cost))

    def _best(self, scan: Scan, middle_ns: int, step_s: float, expected: Twist | None) -> _Fit | None:
        """The registration that fits best, from constant velocity, from the guesses and, if need be, from other speeds."""
        starts = [(rate, self._velocity) for rate in (self._rate, *self._turning(middle_ns, step_s))]
        if expected is not None:
            rate, velocity = expected
            starts.append((rate, self._x[R : R + 9].reshape(3, 3) @ so3.exp(0.5 * step_s * rate) @ velocity))
            starts = starts[-1:] if self._held else starts
        # Where two expect about the same, one is enough.
        starts = [
            start
            for number, start in enumerate(starts)
            if not any(
                np.abs(start[0] - other[0]).max() * step_s < _SAME_START[0]
                and np.abs(start[1] - other[1]).max() * step_s < _SAME_START[1]
                for other in starts[:number]
            )
        ]
        needed = len(starts)
        if expected is None:  # who has an estimate needs no search
            starts += [(0.3 * self._rate, 0.3 * self._velocity), (self._rate, 2.0 * self._velocity)]
        best: _Fit | None = None
        reached: list[NDArray[np.float64]] | None = None if expected is None or self._held else []
        for number, (rate, velocity) in enumerate(starts):
            if number >= needed and best is not None and best.misfit < max(_POOR * self._usual, GOOD_MISFIT_M):
                break
            found = self._register(scan, middle_ns, step_s, rate, velocity, reached)
            if found is not None and (best is None or found.cost < best.cost):
                best = found
        return best

    def _measurement(self, points: NDArray[np.float32]) -> PlaneMeasurement:
        # Points close together share what is wrong with their surface: finer voxels give more of them, not more information.
        share = min(1.0, self._filter.voxel_size / _INDEPENDENT_M) ** 2
        return PlaneMeasurement(points, self._tree, self._config, with_extrinsic=False, weight=share)

    def _roughly(self, x: NDArray[np.float64], points: NDArray[np.float32]) -> PoseDirections | None:
        """The first pass with some of the points, x (36,) in place; None, and x stays, where too few of them lie on the map."""
        near = x.copy()
        directions = align(near, self._measurement(points[::_COARSE].copy()), self._of_few, settled=_ROUGHLY)
        if directions is not None:
            x[:] = near
        return directions

    def _nodes(self, scan: Scan, at_ns: int, rate: NDArray[np.float64], velocity: NDArray[np.float64]) -> NDArray[np.float64]:
        return nodes_within(scan, at_ns, rate, velocity, self._guesses[0] if self._undistort else None)

    def _register(
        self,
        scan: Scan,
        middle_ns: int,
        step_s: float,
        rate: NDArray[np.float64],
        velocity: NDArray[np.float64],
        reached: list[NDArray[np.float64]] | None = None,
    ) -> _Fit | None:
        """The registration from one expected motion; None where it fails, or goes the way of one before.

        Args:
            reached: packed states (36,) that others have come to; those of this one are added. Given by who has an estimate, and
                begins close by: then fewer points and steps are enough for the first pass, and a start ends where another has
                been, as nothing but the state tells what follows. Without one, in poor surroundings, the last centimetre counts.
        """
        R_before, p_before = self._x[R : R + 9].reshape(3, 3), self._x[P : P + 3]
        x = self._x.copy()
        x[R : R + 9] = (R_before @ so3.exp(rate * step_s)).ravel()
        x[P : P + 3] = p_before + velocity * step_s
        directions: PoseDirections | None = None
        held = velocity / np.linalg.norm(velocity) if self._held and velocity.any() else None
        for number in range(_PASSES):
            # Within the scan the motion is what it was found to be on the way here.
            nodes = self._nodes(scan, middle_ns, rate, x[R : R + 9].reshape(3, 3).T @ velocity)
            still = undistorted(scan, nodes, middle_ns)
            points = self._filter(still)[0]
            roughly = number == 0 and reached is not None
            directions = self._roughly(x, points) if roughly and len(points) >= _FEW * _COARSE else None
            if directions is None:
                measurement = self._measurement(points)
                directions = align(x, measurement, self._config, held=held)
            if directions is None:
                return None
            if reached is not None:
                if roughly and any(_same_pose(x, other) for other in reached):
                    return None
                reached.append(x.copy())
            moved = so3.log(R_before.T @ x[R : R + 9].reshape(3, 3)) / step_s, (x[P : P + 3] - p_before) / step_s
            change = max(np.abs(moved[0] - rate).max(), np.abs(moved[1] - velocity).max()) * step_s
            rate, velocity = moved
            if change < _SAME_MOTION and not roughly:
                break
        information = measurement.at(x, rematch=reached is None or measurement.has_moved(x))
        # A point among map points of one scan line is not used, but it does lie on the map.
        on_line = measurement.rejected().get(REASONS[ONE_LINE], 0)
        share = (information.used + on_line) / max(len(points), 1)
        if (
            directions is None
            or information.used < FEWEST_USED
            or share < _LEAST_SHARE
            or max(np.abs(rate).max() / _FASTEST[0], np.abs(velocity).max() / _FASTEST[1]) > 1.0
        ):
            return None
        known = honest_information(information.A[:6, :6], directions, information.residual_rms)
        cost = information.residual_rms**2 * share + self._config.plane_threshold**2 * (1.0 - share)
        return _Fit(
            x,
            rate,
            velocity,
            known if held is None else with_held(known, held),
            directions.vectors[:, directions.weak],
            information.residual_rms,
            cost,
            self._map_filter(still)[1],
        )


def _same_pose(x: NDArray[np.float64], y: NDArray[np.float64]) -> bool:
    """Whether two packed states (36,) are so near that the same comes of both."""
    turned = so3.log(x[R : R + 9].reshape(3, 3).T @ y[R : R + 9].reshape(3, 3))
    return bool(np.abs(turned).max() < _SAME_POSE[0] and np.abs(x[P : P + 3] - y[P : P + 3]).max() < _SAME_POSE[1])


def _same_motion(fit: _Fit, other: _Fit) -> bool:
    """Whether two fits of a scan say about the same."""
    faster, turning = fit.velocity - other.velocity, fit.rate - other.rate
    return bool(np.abs(faster).max() < _SETTLED_M_S and np.abs(turning).max() < _SAME_RATE)


@dataclass(frozen=True, slots=True)
class _Pose:
    time_ns: int
    R: NDArray[np.float64]
    p: NDArray[np.float64]
    information: NDArray[np.float64]
    segment: int
    weak: bool
    misfit: float
    cost: float


@dataclass(frozen=True, slots=True)
class _Fit:
    x: NDArray[np.float64]
    rate: NDArray[np.float64]
    velocity: NDArray[np.float64]
    information: NDArray[np.float64]
    weak: NDArray[np.float64]
    misfit: float
    cost: float
    map_points: NDArray[np.float32]
