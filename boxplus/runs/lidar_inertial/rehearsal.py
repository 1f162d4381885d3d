"""What a first run over the beginning of a recording makes of a mounting that nobody has given.

A filter refines the mounting while it runs, but the map of its first seconds was made with the first guess, and stays: the path
keeps what the guess was off. The first minute is therefore run twice. The first time is for the mounting alone; the run that is
kept begins with what it has found. Measured: docs/lidar_inertial_odometry.md, section 11.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import BoxplusError
from boxplus.filtering.nav_state import T_P_L, T_THETA_L, TANGENT
from boxplus.recordings.recording import Event, end_ns
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry

_LENGTH_S = 60.0
_CAUTION = 2.0  # the same scans are used again, and neighbouring ones share their errors, which the covariance does not know
_FLOOR_M = 0.01


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


def rehearse(events: Iterable[Event], config: LioConfig, should_stop: Callable[[], bool]) -> Rehearsal | str:
    """Run the odometry over the first minute.

    Args:
        events: of the recording, from its beginning.
        config: with the mounting as far as it is known, and how well.
        should_stop: asked between events; True ends it.

    Returns:
        The mounting at the end; why there is none, where the run found no start, was lost, or is not to be trusted.
    """
    odometry = LidarInertialOdometry(config)
    first: Estimate | None = None
    last: Estimate | None = None
    try:
        for event in _first_minute(events):
            if should_stop():
                return "it was interrupted"
            for last in odometry.push_scan(event) if isinstance(event, Scan) else odometry.push_imu(event):
                first = first or last
                if last.status == "lost":
                    return "it was lost"
    except BoxplusError as error:  # the run itself will meet it, with what it has written until then
        return f"it ended with an error ({error})"
    if first is None or last is None:
        return "it found no start"
    if odometry.contradiction is not None:
        return f"it was not to be trusted ({odometry.contradiction})"
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = last.state.R_imu_lidar, last.state.p_imu_lidar
    rotation = np.linalg.eigvalsh(last.covariance[T_THETA_L:T_P_L, T_THETA_L:T_P_L])
    translation = np.maximum(_CAUTION * np.sqrt(np.diag(last.covariance)[T_P_L:TANGENT]), _FLOOR_M)
    seconds = (last.time_ns - first.time_ns) * 1e-9
    return Rehearsal(T, _CAUTION * np.degrees(np.sqrt(rotation)), translation, seconds)


def _first_minute(events: Iterable[Event]) -> Iterator[Event]:
    first_ns: int | None = None
    for event in events:
        now_ns = end_ns(event)
        if now_ns is not None:
            first_ns = now_ns if first_ns is None else first_ns
            if now_ns - first_ns > _LENGTH_S * 1e9:
                return
        yield event
