"""The first state of a LiDAR without an IMU: how it moves, from its first scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import lidar_path
from boxplus.systems.lidar_inertial_agreement.lidar_path.other_speeds import one_speed, well_known
from boxplus.systems.lidar_inertial_agreement.lidar_path.own_surfaces import show_little
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_odometry.motion import MotionBetween, MotionState
from boxplus.systems.lidar_odometry.passing import passing_motion, turning_along

_LEAST_SCANS = 4
_POSE_SIGMA = 1e-4  # rad, m: the first pose defines the world
_RATE_SIGMA, _SPEED_SIGMA = 0.5, 1.0  # rad/s, m/s: a registration of neighbouring scans, and what changes between them
_UNSEEN_SPEED_SIGMA = 15.0  # m/s, where a scan left a direction open
_SHORTEST_SCAN_NS = 1_000_000


@dataclass(frozen=True, slots=True)
class LidarStart:
    """How the odometry began.

    Attributes:
        kind: "lidar".
        motion: through the first scan, to the first state.
        covariance: (12, 12) of the first state.
        duration_s: how long the start was observed.
        text: one sentence with the evidence.
        warning: what could not be decided; empty when all was.
    """

    kind: Literal["lidar"]
    motion: MotionBetween
    covariance: NDArray[np.float64]
    duration_s: float
    text: str
    warning: str = ""


def find_lidar_start(scans: Sequence[Scan], config: RegistrationConfig) -> LidarStart | str:
    """The first state from the motion between the first scans; a sentence where these do not fit each other.

    The world is the LiDAR's frame at the end of its first scan: without an IMU nothing says where down is.
    """
    path = lidar_path(scans, config, unbroken=True)
    if _is_broken(path):
        little = show_little(scans, config)
        return f"of the first {len(scans)} scans, {path.failed} cannot be registered to those before" + (
            f": {little}" if little else ""
        )
    shown_by = ""
    if (held := _following_what_passes(scans, path, config)) is not None:
        path, shown_by = held, ", which what changes from scan to scan shows"
    seconds = float(path.time_ns[1] - path.time_ns[0]) * 1e-9
    rate = so3.log(path.R_path_lidar[0].T @ path.R_path_lidar[1]) / seconds
    velocity_path = (path.p_path_lidar[1] - path.p_path_lidar[0]) / seconds
    first = scans[0]
    begin_ns = min(first.start_ns, first.end_ns - _SHORTEST_SCAN_NS)
    half = (first.end_ns - int(path.time_ns[0])) * 1e-9
    velocity = so3.exp(rate * half).T @ velocity_path  # along the axes at the end of the scan, which are the world's
    last = MotionState(first.end_ns, np.eye(3), np.zeros(3), rate, velocity)
    duration = (first.end_ns - begin_ns) * 1e-9
    begin = MotionState(begin_ns, so3.exp(-rate * duration), -velocity * duration, rate, velocity)
    weak = bool(path.weak[1:].any())
    sigma = [_POSE_SIGMA, _POSE_SIGMA, _RATE_SIGMA, _UNSEEN_SPEED_SIGMA if weak else _SPEED_SIGMA]
    text = (
        f"{np.linalg.norm(velocity):.2f} m/s and {np.degrees(np.linalg.norm(rate)):.0f} deg/s, from {len(path)} scans{shown_by}"
    )
    warning = ""
    if weak:
        warning = "the first scans leave a direction of the motion open: the speed along it is not known"
    observed = (scans[-1].end_ns - begin_ns) * 1e-9
    covariance = np.diag(np.repeat(np.square(sigma), 3))
    return LidarStart("lidar", MotionBetween(begin, last), covariance, observed, text, warning)


def _is_broken(path: LidarPath) -> bool:
    return bool(path.failed or len(path) < _LEAST_SCANS or (path.segment != path.segment[0]).any())


def _following_what_passes(scans: Sequence[Scan], path: LidarPath, config: RegistrationConfig) -> LidarPath | None:
    """The path as fast as what changes from scan to scan has it, where that shows another speed than the registrations."""
    if len(path) != len(scans) or well_known(path):
        return None
    motion = passing_motion(scans, path.poses)
    if motion is None or motion.doubt:
        return None
    turning = turning_along(path.time_ns, path.R_path_lidar)
    held = lidar_path(scans, config, [turning], undistort=True, expected=motion.twists(), held=True, unbroken=True)
    return None if _is_broken(held) or len(held) != len(path) or one_speed(path, held) else held
