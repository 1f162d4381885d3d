"""A path of the LiDAR that grows scan by scan: each is registered to a map of those before it, from where it is expected.

A first and a second scan may fit each other at several speeds (`first_speeds`). Then the track forks, and later scans tell.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import NavState, P, R
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath, Twist
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import Turning, middle_of, thinned
from boxplus.systems.lidar_inertial_agreement.lidar_path.tracks.first_speeds import first_fits
from boxplus.systems.lidar_inertial_agreement.lidar_path.tracks.scan_fit import MOST_RAW, ScanFit, ScanFitter, Standing

_MOST_SEARCHES = 3  # failures after which no speed is tried any more: it is not the speed
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
        self._fitter = ScanFitter(config, guesses, undistort=undistort, held=held)
        self._poses: list[_Pose] = []
        self._lasted_s: list[float] = []
        self._failed = 0
        self._segment = -1
        self._usual = 0.0
        self._restart()
        if velocity is not None:
            self._velocity = velocity.copy()

    def _restart(self) -> None:
        self._tree = IkdTree(cell_size=self._fitter.config.map_cell, rebuild="inplace")
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
    def is_torn(self) -> bool:
        """Whether it has begun anew."""
        return self._segment > 0

    @property
    def length(self) -> int:
        """Poses since the track began, or began anew."""
        return sum(pose.segment == self._segment for pose in self._poses)

    @property
    def cost(self) -> float:
        """What they have cost."""
        return sum(pose.cost for pose in self._poses if pose.segment == self._segment)

    def turn_by(self, guesses: Sequence[Turning]) -> None:
        """How the LiDAR may turn from now on."""
        self._fitter.guesses = tuple(guesses)

    def add(self, scan: Scan, expected: Twist | None = None) -> list[Track]:
        """Register the next scan; `expected` is one more start. Returns itself, and others where it may go on otherwise."""
        if len(scan) < self._fitter.config.min_points:
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
        at = Standing(self._tree, self._x, self._rate, self._velocity, self._usual)
        if self._first is None:
            fit = self._fitter.best(at, scan, middle_ns, step_s, expected)
            found = [] if fit is None else [(fit, self._tree)]
        else:
            search = self._failed <= _MOST_SEARCHES
            found = first_fits(self._fitter, at, self._first, scan, middle_ns, step_s, expected, search=search)
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
        other._poses, other._lasted_s, other._fitter = list(self._poses), list(self._lasted_s), self._fitter.fork()
        return other

    def _go_on(self, fit: ScanFit, tree: IkdTree, middle_ns: int) -> None:
        self._usual = fit.misfit if self._usual == 0.0 else 0.9 * self._usual + 0.1 * fit.misfit
        self._x, self._rate, self._velocity, self._tree = fit.x, fit.rate, fit.velocity, tree
        self._keep(middle_ns, fit.information, fit.weak, fit.misfit, fit.cost)
        self._tree.insert(NavState.unpack(fit.x).to_world(fit.map_points), downsample=True)
        self._previous_ns = middle_ns

    def _begin(self, scan: Scan, middle_ns: int) -> None:
        self._previous_ns = middle_ns
        self._first = scan
        self._keep(middle_ns, np.zeros((6, 6)), False, 0.0, 0.0)
        self._tree.insert(self._fitter.map_points(scan.p_lidar).astype(np.float64), downsample=True)

    def _keep(self, middle_ns: int, information: NDArray[np.float64], weak: bool, misfit: float, cost: float) -> None:
        R_path_lidar, p_path_lidar = self._x[R : R + 9].reshape(3, 3).copy(), self._x[P : P + 3].copy()
        self._poses.append(_Pose(middle_ns, R_path_lidar, p_path_lidar, information, self._segment, weak, misfit, cost))


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
