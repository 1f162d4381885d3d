"""Whether scans fit as well, or better, at another speed: a registration ends in the minimum next to its start and cannot know.

Over open ground the rings of a LiDAR go along with it. A scan that is laid upon the one before it, ring upon ring, fits about as
well as one that is laid where it was seen; which of the two a registration finds is decided by where it began.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import GrowingPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import Turning
from boxplus.systems.lidar_inertial_agreement.lidar_path.tracks.track import Track

_SURE_M = 0.006  # standard deviation of a pose, along all axes, below which no other minimum is looked for
_APART_M_S = 1.0, 2.0  # both ways along the two axes that are known least
_DEVIATIONS, _ANOTHER_M_S = 5.0, 0.3  # beyond both another speed is another
_AS_WELL = 1.1  # times the cost
_JOINED_STEPS, _JOINED_M_S = 5, 0.1  # in a row
_ONE_M_S, _ONE_SHARE = 1.0, 0.05  # two speeds are one


def well_known(path: LidarPath) -> bool:
    """Whether the scene shows the positions of a path along every axis, so well that no other speed need be looked for."""
    return len(path) > 1 and _least_known(path)[0] < _SURE_M


def least_known_axis(path: LidarPath) -> NDArray[np.float64]:
    """(3,) unit vector along which the scene shows the positions of a path, of two poses at least, the least."""
    axis: NDArray[np.float64] = _least_known(path)[1][:, 0]
    return axis


def one_speed(path: LidarPath, other: LidarPath) -> bool:
    """Whether two paths through the same scans are about as fast, in about the same direction."""
    velocity = mean_velocity(other)
    return bool(np.linalg.norm(mean_velocity(path) - velocity) < _ONE_M_S + _ONE_SHARE * np.linalg.norm(velocity))


def _least_known(path: LidarPath) -> tuple[float, NDArray[np.float64]]:
    """Median standard deviation [m] of the positions along the axis that is known least, and the axes (3, 3), that one first."""
    information = path.information[1:, 3:, 3:]
    sigma = 1.0 / np.sqrt(max(float(np.median(np.linalg.eigvalsh(information)[:, 0])), 1e-12))
    return float(sigma), np.linalg.eigh(information.mean(axis=0))[1]


def mean_velocity(path: LidarPath, most_intervals: int | None = None) -> NDArray[np.float64]:
    """(3,) over a path of two poses at least, or over its first intervals only, in the frame of its first pose [m/s]."""
    last = len(path) - 1 if most_intervals is None else min(most_intervals, len(path) - 1)
    seconds = float(path.time_ns[last] - path.time_ns[0]) * 1e-9
    velocity: NDArray[np.float64] = (path.p_path_lidar[last] - path.p_path_lidar[0]) / seconds
    return velocity


def other_speed(
    path: LidarPath, scans: Sequence[Scan], config: RegistrationConfig, guesses: Sequence[Turning]
) -> NDArray[np.float64] | None:
    """Another mean velocity (3,) [m/s] at which the scans fit about as well, in the frame of the path's first pose, or None.

    Args:
        path: of one segment, found from `scans`, undistorted with the first of `guesses`.
        scans, config, guesses: as for `lidar_path`.
    """
    sigma, axes = _least_known(path)
    if sigma < _SURE_M:
        return None
    seconds = (path.time_ns[-1] - path.time_ns[0]) * 1e-9
    velocity = mean_velocity(path)
    for away in _APART_M_S:
        for axis in (axes[:, 0], -axes[:, 0], axes[:, 1], -axes[:, 1]):
            other = _path_at(velocity + away * axis, path, scans, config, guesses)
            if other is None:
                continue
            apart = other.p_path_lidar[-1] - path.p_path_lidar[-1]
            sure = apart @ path.information[-1, 3:, 3:] @ apart > _DEVIATIONS**2
            if sure and np.linalg.norm(apart) > _ANOTHER_M_S * seconds:
                return mean_velocity(other)
    return None


def _path_at(
    velocity: NDArray[np.float64],
    path: LidarPath,
    scans: Sequence[Scan],
    config: RegistrationConfig,
    guesses: Sequence[Turning],
) -> LidarPath | None:
    """The path through the same scans that begins with another velocity (3,), where it fits about as well and stays another.

    It ends once that is decided: what it costs only grows, and one that moves as the other does is not expected to leave it.
    """
    growing = GrowingPath(Track(config, guesses, undistort=True, velocity=velocity))
    most = _AS_WELL * float(path.cost.sum())
    for scan in scans:
        growing.add(scan)
        other = growing.path()
        if growing.failed or float(other.cost.sum()) >= most or _has_joined(other, path):
            return None
    return other if len(other) == len(path) else None


def _has_joined(other: LidarPath, path: LidarPath) -> bool:
    """Whether a path has, over its last steps, moved as the other through the same scans did, and will not end far from it."""
    last = len(other) - 1
    if last < _JOINED_STEPS or last >= len(path):
        return False
    steps = slice(last - _JOINED_STEPS, last + 1)
    apart = other.p_path_lidar[steps] - path.p_path_lidar[steps]
    faster = np.diff(apart, axis=0) / (np.diff(path.time_ns[steps])[:, None] * 1e-9)
    seconds, left = (path.time_ns[-1] - path.time_ns[[0, last]]) * 1e-9
    near = float(np.linalg.norm(apart[-1])) + _JOINED_M_S * left < _ANOTHER_M_S * seconds
    return near and bool(np.linalg.norm(faster, axis=1).max() < _JOINED_M_S)
