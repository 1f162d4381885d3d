"""Whether a path of the LiDAR alone drifts: its last scans against its first ones, without those between (`older_scans`).

With few rings every scan adds to the trail that each ring leaves on the ground, and fits the trail of the ones before it at
whatever slope that has been laid: among trunks, or high up in a hall, a path of a second may tilt by degrees and climb by
decimetres, while each registration is sure of itself to millimetres.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.downsampling import VoxelFilter
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.older_scans import deviations_of, map_of, register_to
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import Turning, nodes_within, thinned, undistorted
from boxplus.systems.lidar_inertial_agreement.lidar_path.tracks.scan_fit import MOST_MAP_POINTS, MOST_POINTS, MOST_RAW

_MAP_SCANS = 5
_TRIED = 4  # of the last scans: not every one shows enough of the same place
_STEP_VARIANCE = np.repeat([3e-4, 3e-3], 3) ** 2  # rad², m² of a scan against the one before it
_OPEN_VARIANCE = np.repeat([0.1, 1.0], 3) ** 2  # rad², m² of a scan along what the scene does not determine
_TOLD = 4.0  # standard deviations: 1.4 at most on sound paths, 10 and 17 on two that had gone astray


def path_drift(
    path: LidarPath, scans: Sequence[Scan], config: RegistrationConfig, turning: Turning
) -> NDArray[np.float64] | None:
    """The motion (6,) by which one of the last scans is off where the first ones want it: [θ about its axes, p along the path's].

    None where that is within what a path comes to, or where the first scans do not show it.

    Args:
        path: of one segment, with a pose for each of `scans`.
        scans, config: as for `lidar_path`.
        turning: how the LiDAR turned within the scans.
    """
    first = min(_MAP_SCANS, len(path) // 2)
    if first < 1:
        return None
    seconds = (path.time_ns - path.time_ns[0]) * 1e-9
    velocity = np.gradient(path.p_path_lidar, seconds, axis=0)

    def undistorted_at(k: int) -> NDArray[np.float32]:
        scan, at_ns = thinned(scans[k], MOST_RAW), int(path.time_ns[k])
        nodes = nodes_within(scan, at_ns, np.zeros(3), path.R_path_lidar[k].T @ velocity[k], turning)
        return undistorted(scan, nodes, at_ns)

    map_filter = VoxelFilter(config.map_cell, MOST_MAP_POINTS)
    first_scans = map_of(
        [
            map_filter(undistorted_at(k))[1].astype(np.float64) @ path.R_path_lidar[k].T + path.p_path_lidar[k]
            for k in range(first)
        ],
        config,
    )
    point_filter = VoxelFilter(max(config.scan_voxel, config.map_cell), MOST_POINTS)
    for k in range(max(len(path) - _TRIED, first), len(path)):
        found = register_to(first_scans, path.packed(k), point_filter(undistorted_at(k))[0], config)
        if found is not None and deviations_of(found[0], found[1] + _covariance_at(path, k)) > _TOLD:
            return found[0]
    return None


def _covariance_at(path: LidarPath, k: int) -> NDArray[np.float64]:
    """(6, 6) that a path may come to in k scans, [θ about its axes there, p along the path's].

    Where a scan was weak the path went on as before along what nothing showed: nobody takes it for known there.
    """
    covariance = k * np.diag(_STEP_VARIANCE)
    for weak in np.flatnonzero(path.weak[: k + 1]):
        turn = np.eye(6)
        turn[:3, :3] = path.R_path_lidar[k].T @ path.R_path_lidar[weak]
        covariance += turn @ np.linalg.inv(path.information[weak] + np.diag(1.0 / _OPEN_VARIANCE)) @ turn.T
    return covariance
