"""The path of a LiDAR found from the last scan to the first: the same motion, unless one of both has gone astray.

A platform that rests fills the map with one pattern of points, which may hold a registration back when it moves off. Backwards
the same scans begin in motion, and end at rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.explained_scans import (
    one_motion,
    other_explains_better,
    scans_of,
)
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import lidar_path
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import Turning, middle_of

_ABOUT_THE_SAME = 0.1, 0.5  # rad and m: drift over some seconds


def surer_path(
    path: LidarPath, scans: Sequence[Scan], config: RegistrationConfig, guesses: Sequence[Turning]
) -> LidarPath | None:
    """Register the scans backwards as well: the path of both that explains them better; None where that does not decide.

    Args:
        path: of `scans`, found forwards.
        scans: consecutive sweeps.
        config, guesses: as for `lidar_path`.
    """
    back = lidar_path_backwards(scans, config, guesses)
    # A path that is whole, before one that is not.
    if not (_whole(path) and _whole(back)) or not np.array_equal(path.time_ns, back.time_ns):
        return path if len(np.unique(path.segment)) <= len(np.unique(back.segment)) else back
    chosen = scans_of(path.time_ns, scans)
    # Also of two that end alike: a pattern holds back every sway of a walk, and at the end nothing is left of it.
    if other_explains_better(chosen, path.poses, back.poses, config):
        return back
    if one_motion(path.poses, back.poses, *_ABOUT_THE_SAME) or other_explains_better(chosen, back.poses, path.poses, config):
        return path
    return None


def lidar_path_backwards(scans: Sequence[Scan], config: RegistrationConfig, guesses: Sequence[Turning] = ()) -> LidarPath:
    """As `lidar_path`, found from the last scan to the first, in the frame of the first pose of each segment."""
    turned = scans[0].start_ns + scans[-1].end_ns
    mirrored = [
        Scan(scan.p_lidar[::-1].copy(), turned - scan.time_ns[::-1], None, turned - scan.end_ns, turned - scan.start_ns)
        for scan in scans[::-1]
    ]
    back = lidar_path(mirrored, config, [_mirrored(guess, turned) for guess in guesses])
    R, p = back.R_path_lidar[::-1].copy(), back.p_path_lidar[::-1].copy()
    information, weak = back.information[::-1].copy(), back.weak[::-1].copy()
    misfit, cost = back.misfit[::-1].copy(), back.cost[::-1].copy()
    segment = (back.segment.max(initial=0) - back.segment)[::-1].copy()
    for number in np.unique(segment):
        index = np.flatnonzero(segment == number)
        first, last = index[0], index[-1]
        if len(index) > 1:
            # What defined the frame is known as well as its neighbour is, from now on against the first pose.
            for of_pose in (information, weak, misfit, cost):
                of_pose[last] = of_pose[last - 1]
        R_first, p_first = R[first].copy(), p[first].copy()
        turn = np.eye(6)
        turn[3:, 3:] = R_first
        R[index], p[index] = R_first.T @ R[index], (p[index] - p_first) @ R_first
        information[index] = turn.T @ information[index] @ turn
        information[first], weak[first], misfit[first], cost[first] = 0.0, False, 0.0, 0.0
    # Half a nanosecond is rounded the other way round.
    middle_ns = {middle_of(turned_scan): middle_of(scan) for turned_scan, scan in zip(mirrored, scans[::-1], strict=True)}
    time_ns = np.array([middle_ns[time] for time in back.time_ns[::-1].tolist()], np.int64)
    return LidarPath(time_ns, R, p, information, segment, weak, misfit, cost, back.failed, back.scan_s)


def _mirrored(guess: Turning, turned_ns: int) -> Turning:
    return lambda time_ns: guess(turned_ns - time_ns)


def _whole(path: LidarPath) -> bool:
    return len(path) > 0 and bool(path.segment[0] == path.segment[-1])
