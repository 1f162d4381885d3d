"""What changes from scan to scan, asked at the start: it may show a motion that the registrations miss, and doubts theirs.

Rest that the registrations find is believed where what they see stays as it is, or where things that stand on the ground show it;
a motion where no more of these stay than go by (docs/lidar_inertial_odometry.md, section 10).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from boxplus._words import signed
from boxplus.systems.lidar_inertial_agreement.lidar_path.changes.changed_points import changed_share
from boxplus.systems.lidar_inertial_agreement.lidar_path.changes.common_motion import common_motion
from boxplus.systems.lidar_inertial_agreement.lidar_path.changes.standing import shows_rest
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import lidar_path
from boxplus.systems.lidar_inertial_agreement.lidar_path.other_speeds import (
    least_known_axis,
    mean_velocity,
    one_speed,
    well_known,
)
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath, Twist
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import Turning
from boxplus.systems.lidar_inertial_agreement.rest import Rest
from boxplus.systems.lidar_inertial_odometry.start.beginning import WAITING, Beginning, NotYet, broken

_COMPARED = 3  # pairs of scans, the newest: what moved about may be gone
_CHANGING = 0.0025  # share of points that change: at rest none, of a rosette up to 0.0022; on drives 0.0024 and more
RESTING_M_S = 0.5  # slower, a path may be one of rest


@dataclass(frozen=True, slots=True)
class Common:
    """The motion that explains what changes from scan to scan: to every scan, and whether the path shows it too."""

    twists: Sequence[Twist]
    shown: bool


def following_changes(seen: Beginning, path: LidarPath) -> Common | None:
    """The motion that explains what changes from scan to scan, where the path alone does not show it well.

    Raises:
        NotYet: there is one, but something speaks against it.
    """
    found = not broken(path) and len(path) == len(seen.scans)
    if not seen.guesses or (found and well_known(path)):  # without a gyroscope changes by turning are not told apart
        return None
    motion = common_motion(seen.scans, seen.guesses[0], seen.up_lidar)
    if motion is None:
        return None
    held = held_path(seen, seen.guesses, motion.twists())
    shown = found and one_speed(path, held)
    if motion.doubt:
        rests = found and float(np.linalg.norm(mean_velocity(path))) < RESTING_M_S
        if shown or (rests and motion.may_rest and seen.waited_long):  # the path is asked on its own
            return None
        raise NotYet(f"the surroundings do not show how fast the platform moves ({seen.evidence}): {motion.doubt}{WAITING}")
    way = held.p_path_lidar[-1] - held.p_path_lidar[0]
    return Common(motion.twists(way / np.linalg.norm(way)), shown)


def held_path(seen: Beginning, guesses: Sequence[Turning], motion: Sequence[Twist]) -> LidarPath:
    """The path that follows a motion along its way, and the scans across it.

    Raises:
        NotYet: the scans do not overlap.
    """
    path = lidar_path(seen.scans, seen.registration, guesses, undistort=True, expected=motion, held=True, unbroken=True)
    if broken(path):
        raise seen.not_moving("the first scans do not overlap enough for a moving start")
    return path


def weighed_rest(seen: Beginning, path: LidarPath, rest: Rest) -> tuple[Rest, str]:
    """Rest, less the open axes that things that stand close, or with one that is in doubt; and why it is, a sentence.

    Args:
        seen: what the start has to go by.
        path: at rest by its registrations.
        rest: what these show.

    Raises:
        NotYet: rest is in doubt, and later scans, or a quiet IMU, may tell.
    """
    axes = np.array([axis for axis in rest.open_axes if not _stands(seen, axis)]).reshape(-1, 3)
    rest, doubt = replace(rest, open_axes=axes), _doubt_of_rest(seen, path)
    if not doubt:
        return rest, ""
    level = seen.level(axes)
    if not len(level):
        level = least_known_axis(path)[None]
        rest = replace(rest, open_axes=np.concatenate([axes, level]))
    if not seen.waited_long or not seen.imu_is_quiet(rest):
        raise NotYet(f"{undecided(level)} ({seen.evidence}): {doubt}{WAITING}")
    return rest, doubt


def undecided(axes: NDArray[np.float64]) -> str:
    """That nothing shows rest along some axes (K, 3), the beginning of a sentence."""
    along = " and ".join(signed(axis, 2) for axis in axes)
    return f"the surroundings do not show whether the platform moves along {along} (LiDAR axes)"


def _doubt_of_rest(seen: Beginning, path: LidarPath) -> str:
    """That much changes from scan to scan, as on a drive, and nothing that stands shows rest; empty where that is not so."""
    if not seen.guesses or len(path) < 2 or well_known(path):
        return ""
    least = least_known_axis(path)
    if not len(seen.level(least[None])):
        return ""
    pairs = pairwise(seen.scans[-_COMPARED - 1 :])
    changing = float(np.mean([changed_share(first, second, seen.guesses[0]) for first, second in pairs]))
    if changing < _CHANGING or _stands(seen, least):
        return ""
    return f"{changing:.1%} of what the LiDAR sees changes from scan to scan, and nothing that stands shows that it rests"


def _stands(seen: Beginning, axis: NDArray[np.float64]) -> bool:
    """Whether what stands on the ground shows rest along an axis (3,) of the LiDAR, across the vertical."""
    return len(seen.level(axis[None])) == 1 and shows_rest(seen.scans, axis, seen.up_lidar)
