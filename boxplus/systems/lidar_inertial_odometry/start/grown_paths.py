"""Paths through scans that wait for a start, which go on from one try to the next: a try registers what is new to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.agreement import gyro_guesses
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import GrowingPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.tracks.track import Track
from boxplus.systems.lidar_inertial_odometry.start.beginning import Beginning

_SAME_BIAS, _SAME_SPEED = 0.01, 0.1  # rad/s, m/s: with others a path is another

_BiasAndVelocity = tuple[NDArray[np.float64], NDArray[np.float64]]
_Grown = tuple[GrowingPath, int]  # and how many scans it has had


class GrownPaths:
    """Paths for every scan that a try began with, as far as they are whole, by the end of that scan: no two end together."""

    MADE_ANEW = ("_as_seen", "_steady")  # of the same scans and as many guesses the same comes again

    def __init__(self) -> None:
        self._whole: dict[int, bool] = {}
        self._guesses: dict[int, int] = {}  # how many each began with
        self._known: dict[int, _BiasAndVelocity] = {}  # what the steady ones began with
        self._as_seen: dict[int, _Grown] | None = None
        self._steady: dict[int, _Grown] | None = None

    def through(self, seen: Beginning) -> LidarPath:
        """The path through all scans, as `lidar_path` has it; those of the try before may be less, from the same one on."""
        begin = self._begin(seen)
        self._as_seen = self._as_seen or {}
        growing, taken = self._as_seen.get(begin) or (GrowingPath(Track(seen.registration)), 0)
        growing.turn_by(seen.guesses)
        self._as_seen[begin] = _gone_on(growing, seen.scans, taken)
        self._whole[begin] = not growing.is_torn
        return growing.path()

    def steady(self, seen: Beginning, bias: NDArray[np.float64], velocity: NDArray[np.float64]) -> LidarPath:
        """The same, undistorted with the gyroscope less its bias (3,) [rad/s], and begun with a velocity (3,) [m/s].

        Where both are about those that it began with, it goes on with these.
        """
        begin = self._begin(seen)
        self._steady = self._steady or {}
        known = self._known.get(begin)
        if known is None or np.abs(known[0] - bias).max() > _SAME_BIAS or np.abs(known[1] - velocity).max() > _SAME_SPEED:
            self._known[begin] = known = bias, velocity
            self._steady.pop(begin, None)
        guesses = gyro_guesses(replace(seen.imu, gyro=seen.imu.gyro - known[0]), seen.extrinsic.R_imu_lidar)
        grown = self._steady.get(begin)
        growing, taken = grown or (GrowingPath(Track(seen.registration, guesses, undistort=True, velocity=known[1])), 0)
        growing.turn_by(guesses)
        self._steady[begin] = _gone_on(growing, seen.scans, taken)
        return growing.path()

    def is_whole_from(self, scan: Scan) -> bool:
        """Whether a try has begun with this scan, and its path was whole as far as it went."""
        return self._whole.get(scan.end_ns, False)

    def forget_before(self, scan: Scan) -> None:
        """No try will begin before this scan any more."""
        for kept in (self._whole, self._guesses, self._known, self._as_seen or {}, self._steady or {}):
            for begin in [begin for begin in kept if begin < scan.end_ns]:
                del kept[begin]

    def _begin(self, seen: Beginning) -> int:
        """What its paths are found by. Where a gyroscope begins to turn wildly there are more guesses, and they begin anew."""
        begin = seen.scans[0].end_ns
        if self._guesses.get(begin) != len(seen.guesses):
            self._guesses[begin] = len(seen.guesses)
            for grown in (self._as_seen, self._steady):
                if grown is not None:
                    grown.pop(begin, None)
        return begin


def _gone_on(growing: GrowingPath, scans: list[Scan], taken: int) -> _Grown:
    for scan in scans[taken:]:
        if growing.is_torn:
            break
        growing.add(scan)
    return growing, len(scans)
