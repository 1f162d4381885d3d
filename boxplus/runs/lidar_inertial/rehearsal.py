"""What a first run over the beginning of a recording makes of a mounting that nobody has given.

A filter refines the mounting while it runs, but the map of its first seconds was made with the first guess, and stays: the path
keeps what the guess was off. The first minute is therefore run twice. The first time is for the mounting alone; the run that is
kept begins with what it has found. Measured: docs/lidar_inertial_odometry.md, section 11.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import T_P_L, T_THETA_L, TANGENT
from boxplus.recordings.recording import Event
from boxplus.sensors.scan import Scan
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry

_LENGTH_S = 60.0
_CAUTION = 2.0  # the same scans are used again, and neighbouring ones share their errors, which the covariance does not know


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """What it has found.

    Attributes:
        T_imu_lidar: (4, 4).
        std_deg: (3,) standard deviations of the rotation about its principal axes [deg], ascending.
        std_m: (3,) those of the translation along the IMU's axes [m].
        seconds: how long it took on the recording's clock.
    """

    T_imu_lidar: NDArray[np.float64]
    std_deg: NDArray[np.float64]
    std_m: NDArray[np.float64]
    seconds: float


def rehearse(events: Iterable[Event], config: LioConfig) -> Rehearsal | None:
    """Run the odometry over the first minute.

    Args:
        events: of the recording, from its beginning.
        config: with the mounting as far as it is known, and how well.

    Returns:
        The mounting at the end; None where the run found no start, was lost, or is not to be trusted.
    """
    odometry = LidarInertialOdometry(config)
    first: Estimate | None = None
    last: Estimate | None = None
    for event in events:
        for estimate in odometry.push_scan(event) if isinstance(event, Scan) else odometry.push_imu(event):
            first, last = first or estimate, estimate
        if first is not None and last is not None and last.time_ns - first.time_ns > _LENGTH_S * 1e9:
            break
    if first is None or last is None or last.status == "lost" or odometry.contradiction is not None:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = last.state.R_imu_lidar, last.state.p_imu_lidar
    rotation = np.linalg.eigvalsh(last.covariance[T_THETA_L:T_P_L, T_THETA_L:T_P_L])
    translation = np.diag(last.covariance)[T_P_L:TANGENT]
    seconds = (last.time_ns - first.time_ns) * 1e-9
    return Rehearsal(T, _CAUTION * np.degrees(np.sqrt(rotation)), _CAUTION * np.sqrt(translation), seconds)
