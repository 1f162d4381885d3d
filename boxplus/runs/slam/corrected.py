"""What closing the loops makes of an odometry's results: its trajectory and its map, moved to where the loops put them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.output import replaced_folder
from boxplus.formats.trajectory import Trajectory, read_trajectory
from boxplus.formats.trajectory_writer import TrajectoryWriter
from boxplus.manifolds import quaternion, se3
from boxplus.maps.tiles.store import merge
from boxplus.maps.tiles.writer import TileWriter
from boxplus.runs.lidar_inertial.config import MapConfig
from boxplus.runs.slam.folder import SlamFolder
from boxplus.runs.slam.spool import ScanSpool
from boxplus.systems.slam.correction import Correction

Floats = NDArray[np.float64]
Times = NDArray[np.int64]


def write_corrected_trajectory(folder: SlamFolder, correction: Correction, *, is_closed: bool) -> None:
    """The odometry's poses, corrected; their covariance is that of the closed graph, status is the odometry's.

    Args:
        is_closed: whether there is a loop; else poses and covariances are the odometry's.
    """
    odometry = read_trajectory(folder.odometry.trajectory)
    poses = correction.apply(odometry.times, np.hstack([odometry.q_wxyz, odometry.p]))
    covariance = turned_covariances(odometry, poses)
    if is_closed:
        covariance = _closed_covariance(correction, odometry.times, poses, covariance)
    with TrajectoryWriter(folder.path) as writer:
        append_moved(writer, odometry, poses, covariance)


def turned_covariances(before: Trajectory, poses: Floats) -> Floats:
    """(n, 6, 6) of a trajectory whose poses are (n, 7) now: errors of positions are along the world's axes, which have turned."""
    turn = np.tile(np.eye(6), (len(poses), 1, 1))
    turn[:, 3:, 3:] = quaternion.to_matrix(poses[:, :4]) @ np.swapaxes(quaternion.to_matrix(before.q_wxyz), 1, 2)
    covariance = np.zeros((len(poses), 6, 6)) if before.covariance is None else before.covariance
    return np.asarray(turn @ covariance @ np.swapaxes(turn, 1, 2))


def append_moved(writer: TrajectoryWriter, before: Trajectory, poses: Floats, covariance: Floats) -> None:
    """Write a trajectory with other poses (n, 7) and covariances (n, 6, 6), times and statuses as they were."""
    for k, (time_ns, T) in enumerate(zip(before.times.tolist(), poses, strict=True)):
        status = "ok" if before.status is None else before.status[k]
        writer.append(time_ns, quaternion.to_matrix(T[:4]), T[4:], covariance[k], status)


def _closed_covariance(correction: Correction, time_ns: Times, poses: Floats, covariance: Floats) -> Floats:
    """(n, 6, 6) of corrected poses against the first pose: rotation about the body's axes, position along the world's.

    The graph knows poses against the first local map; that one is known against the first pose as the odometry has it. Until
    there, the odometry's own holds.
    """
    turn = np.tile(np.eye(6), (len(poses), 1, 1))  # from SE(3), which has positions along the body's axes
    turn[:, 3:, 3:] = quaternion.to_matrix(poses[:, :4])
    start = int(np.searchsorted(time_ns, correction.time_ns[0]))
    P_start = turn[start].T @ covariance[start] @ turn[start]
    Ad = se3.adjoint(se3.compose(se3.inverse(poses), poses[start]))
    total = Ad @ P_start @ np.swapaxes(Ad, 1, 2) + correction.covariances(time_ns, poses)
    closed = turn @ total @ np.swapaxes(turn, 1, 2)
    return np.where((time_ns <= correction.time_ns[0])[:, None, None], covariance, 0.5 * (closed + np.swapaxes(closed, 1, 2)))


def write_corrected_map(folder: SlamFolder, settings: MapConfig, spool: ScanSpool, correction: Correction) -> int:
    """Tiles and merged files of the scans where closed loops put them; the odometry's own map stays as it is.

    An earlier corrected map is there, whole, until the new one is. Returns the number of points.

    Raises:
        OutputError: the disk is full; the earlier map stays as it was.
    """
    time_ns, T_odo_body = spool.poses()
    T_map_body = correction.apply(time_ns, T_odo_body) if len(time_ns) else T_odo_body
    with (
        replaced_folder(folder.tiles) as made,
        TileWriter(made, tile_size=settings.tile_size, voxel=settings.voxel) as tiles,
    ):
        for scan, T in zip(spool.scans(), T_map_body, strict=True):
            tiles.append(se3.act(T, scan.p_body.astype(np.float64)), scan.intensity)
    if outputs := settings.merged_files(folder.map_ply, folder.map_pcd):
        merge(folder.tiles, outputs)
    return tiles.stored
