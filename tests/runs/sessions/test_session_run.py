"""A finished run as a session: where the rays of its scans began."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.formats.trajectory import read_trajectory
from boxplus.manifolds import se3
from boxplus.runs.sessions.session_run import SessionRun, open_session_run
from boxplus.runs.slam.config import load_slam_config
from boxplus.runs.slam.slam_run import run_slam
from boxplus.runs.slam.spool import ScanSpool, read_spool
from boxplus.runs.slam.summary import read_slam_summary
from boxplus.simulation import MountedLidar, SpinningLidar, simulate
from boxplus.simulation.live_recording import as_recording

LIDAR = SpinningLidar(azimuth_steps=100)
WALK = simulate("walk", duration_s=5.0, lidar=LIDAR)
CONFIG = load_slam_config(
    settings=[
        *("odometry.scan_voxel=0.5", "odometry.map_cell=0.5", "map.pcd=false", "map.voxel=0.3"),
        *("local_maps.length=1.5", "local_maps.least_length=0.5", "slam.appearance=none"),
    ]
)
T_IMU_REAR = np.eye(4)
T_IMU_REAR[:3, 3] = -2.5, -0.9, -0.6
RINGS = np.deg2rad(15.0) + 0.1  # LiDARs lean by 2.5°, and the walk's roll is in what is corrected for motion


def walked(folder: Path, *others: MountedLidar) -> SessionRun:
    run_slam(as_recording(WALK, others=others), folder, CONFIG)
    return open_session_run(folder, "walk")


def elevation(points: np.ndarray, origins: np.ndarray) -> np.ndarray:
    x, y, z = (points - origins).T
    return np.abs(np.arctan2(z, np.hypot(x, y)))


@pytest.mark.slow
def test_rays_begin_at_the_lidar_that_measured_them(tmp_path: Path) -> None:
    """Once all began at the first one: of posts beside a vehicle with two LiDARs 4 m apart, 40 % went as seen through."""
    run = walked(tmp_path / "out", MountedLidar(LIDAR, T_IMU_REAR, "/rear"))
    expected = [WALK.T_imu_lidar[:3, 3], T_IMU_REAR[:3, 3]]
    np.testing.assert_allclose(run.p_imu_lidars, expected, atol=1e-6)
    trajectory = read_trajectory(run.folder.trajectory)
    T = np.hstack([trajectory.q_wxyz, trajectory.p])
    shares = []
    for scan in run.scans(run.session.T_session_map):
        T_imu_world = se3.inverse(T[np.searchsorted(trajectory.times, scan.time_ns)])
        points, origins = se3.act(T_imu_world, scan.points), se3.act(T_imu_world, scan.origins)
        assert scan.lidar is not None
        np.testing.assert_allclose(origins, run.p_imu_lidars[scan.lidar], atol=1e-6)
        own, other = elevation(points, origins) < RINGS, elevation(points, run.p_imu_lidars[1 - scan.lidar]) < RINGS
        shares.append([own.mean(), other.mean(), scan.lidar.mean()])
    own, other, rear = np.mean(shares, axis=0)
    assert own > 0.999 and other < 0.98 and 0.3 < rear < 0.7
    rays = [len(ends) for _, ends in run.stretches(run.session.T_session_map)]
    assert len(rays) == len(run.session.maps) and sum(rays) > 1000

    # As a version before wrote it, which did not keep who saw what.
    scans = [scan._replace(lidar=None) for scan in read_spool(run.folder.spool)]
    older = ScanSpool(run.folder.spool, None)
    for scan in scans:
        older.append(scan)
    size = older.mark().size
    older.close()
    read_slam_summary(run.folder.summary).model_copy(update={"spool_bytes": size}).write(run.folder.summary)
    run = open_session_run(run.folder.path, "walk")
    assert len(list(run.scans(run.session.T_session_map))) == len(scans)
    with pytest.raises(InputError, match=r"which of the 2 LiDARs saw each point.* – run 'boxplus slam' again"):
        list(run.stretches(run.session.T_session_map))


@pytest.mark.slow
def test_rays_of_a_single_lidar_begin_there(tmp_path: Path) -> None:
    run = walked(tmp_path / "out")
    scan = next(run.scans(run.session.T_session_map))
    assert scan.lidar is None and len(run.p_imu_lidars) == 1
    np.testing.assert_array_equal(scan.origins, np.broadcast_to(scan.p_lidars[0], scan.points.shape))
    assert (elevation(scan.points, scan.origins) < RINGS).mean() > 0.999
