"""Paths through scans that wait for a start, which go on from one try to the next: a try registers what is new to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.agreement import gyro_guesses
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import GrowingPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_odometry.start.beginning import Beginning

_SAME_BIAS, _SAME_SPEED = 0.01, 0.1  # rad/s, m/s: with others a path is another

_BiasAndVelocity = tuple[NDArray[np.float64], NDArray[np.float64]]


class GrownPaths:
    """Paths for every scan that a try began with, up to the first scan that cannot be registered, by the begin of that scan."""

    MADE_ANEW = ("_as_seen", "_steady")  # of the same scans the same comes again

    def __init__(self) -> None:
        self._unbroken: dict[int, bool] = {}
        self._known: dict[int, _BiasAndVelocity] = {}  # what the steady ones began with
        self._as_seen: dict[int, tuple[GrowingPath, int]] | None = None  # and how many scans each has had
        self._steady: dict[int, tuple[GrowingPath, int]] | None = None

    def through(self, seen: Beginning) -> LidarPath:
        """The path through all scans, as `lidar_path` has it; those of the try before may be less, from the same one on."""
        self._as_seen, begin = self._as_seen or {}, seen.scans[0].start_ns
        growing, taken = self._as_seen.get(begin) or (GrowingPath(seen.registration), 0)
        growing.turn_by(seen.guesses)
        self._as_seen[begin] = _gone_on(growing, seen.scans, taken)
        self._unbroken[begin] = not growing.failed
        return growing.path()

    def steady(self, seen: Beginning, bias: NDArray[np.float64], velocity: NDArray[np.float64]) -> LidarPath:
        """The same, undistorted with the gyroscope less its bias (3,) [rad/s], and begun with a velocity (3,) [m/s].

        Where both are about those that it began with, it goes on with these.
        """
        self._steady, begin = self._steady or {}, seen.scans[0].start_ns
        known = self._known.get(begin)
        if known is None or np.abs(known[0] - bias).max() > _SAME_BIAS or np.abs(known[1] - velocity).max() > _SAME_SPEED:
            self._known[begin] = known = bias, velocity
            self._steady.pop(begin, None)
        guesses = gyro_guesses(replace(seen.imu, gyro=seen.imu.gyro - known[0]), seen.extrinsic.R_imu_lidar)
        grown = self._steady.get(begin)
        growing, taken = grown or (GrowingPath(seen.registration, guesses, undistort=True, velocity=known[1]), 0)
        growing.turn_by(guesses)
        self._steady[begin] = _gone_on(growing, seen.scans, taken)
        return growing.path()

    def unbroken_from(self, scan: Scan) -> bool:
        """Whether a try has begun with this scan, and its path goes on."""
        return self._unbroken.get(scan.start_ns, False)

    def forget_before(self, scan: Scan) -> None:
        """No try will begin before this scan any more."""
        for kept in (self._unbroken, self._known, self._as_seen or {}, self._steady or {}):
            for begin in [begin for begin in kept if begin < scan.start_ns]:
                del kept[begin]


def _gone_on(growing: GrowingPath, scans: list[Scan], taken: int) -> tuple[GrowingPath, int]:
    for scan in scans[taken:]:
        if growing.failed:
            break
        growing.add(scan)
    return growing, len(scans)
