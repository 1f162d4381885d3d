"""Paths through scans that wait for a start, which go on from one try to the next: a try registers what is new to it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.agreement import gyro_guesses
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import GrowingPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.tracks.track import Track
from boxplus.systems.lidar_inertial_odometry.start.beginning import Beginning

_SAME_BIAS, _SAME_SPEED = 0.01, 0.1  # rad/s, m/s: with others a path is another

_Grown = tuple[GrowingPath, int]  # and how many scans it has had


@dataclass(slots=True)
class _Begun:
    """What has grown from one scan on.

    Attributes:
        guesses: how many it was begun with.
        whole: whether the path is, as far as it went.
        as_seen, steady: the two paths.
        known: bias (3,) and velocity (3,) that the steady one began with.
    """

    MADE_ANEW = ("as_seen", "steady")  # of the same scans and as many guesses the same comes again

    guesses: int
    whole: bool = False
    as_seen: _Grown | None = None
    steady: _Grown | None = None
    known: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None


class GrownPaths:
    """Paths for every scan that a try began with, as far as they are whole, by the end of that scan: no two end together."""

    def __init__(self) -> None:
        self._begun: dict[int, _Begun] = {}

    def through(self, seen: Beginning) -> LidarPath:
        """The path through all scans, as `lidar_path` has it; those of the try before may be less, from the same one on."""
        begun = self._begun_with(seen)
        growing, taken = begun.as_seen or (GrowingPath(Track(seen.registration)), 0)
        growing.turn_by(seen.guesses)
        begun.as_seen = _gone_on(growing, seen.scans, taken)
        begun.whole = not growing.is_torn
        return growing.path()

    def steady(self, seen: Beginning, bias: NDArray[np.float64], velocity: NDArray[np.float64]) -> LidarPath:
        """The same, undistorted with the gyroscope less its bias (3,) [rad/s], and begun with a velocity (3,) [m/s].

        Where both are about those that it began with, it goes on with these.
        """
        begun = self._begun_with(seen)
        if begun.known is None or _apart(begun.known[0], bias) > _SAME_BIAS or _apart(begun.known[1], velocity) > _SAME_SPEED:
            begun.known, begun.steady = (bias, velocity), None
        bias, velocity = begun.known
        guesses = gyro_guesses(replace(seen.imu, gyro=seen.imu.gyro - bias), seen.extrinsic.R_imu_lidar)
        track = Track(seen.registration, guesses, undistort=True, velocity=velocity)
        growing, taken = begun.steady or (GrowingPath(track), 0)
        growing.turn_by(guesses)
        begun.steady = _gone_on(growing, seen.scans, taken)
        return growing.path()

    def is_whole_from(self, scan: Scan) -> bool:
        """Whether a try has begun with this scan, and its path was whole as far as it went."""
        return scan.end_ns in self._begun and self._begun[scan.end_ns].whole

    def forget_before(self, scan: Scan) -> None:
        """No try will begin before this scan any more."""
        self._begun = {end_ns: begun for end_ns, begun in self._begun.items() if end_ns >= scan.end_ns}

    def _begun_with(self, seen: Beginning) -> _Begun:
        """What has grown from its first scan on. Where a gyroscope begins to turn wildly there are more guesses: anew then."""
        begun = self._begun.get(seen.scans[0].end_ns)
        if begun is None or begun.guesses != len(seen.guesses):
            begun = self._begun[seen.scans[0].end_ns] = _Begun(len(seen.guesses))
        return begun


def _apart(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    return float(np.abs(one - other).max())


def _gone_on(growing: GrowingPath, scans: list[Scan], taken: int) -> _Grown:
    for scan in scans[taken:]:
        if growing.is_torn:
            break
        growing.add(scan)
    return growing, len(scans)
