"""Up without an IMU: from the first local map that shows it, or not at all, and what a run says about it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from boxplus.formats.trajectory import read_trajectory
from boxplus.manifolds import quaternion
from boxplus.maps.local_maps import builder
from boxplus.maps.local_maps.folder import LocalMapFolder
from boxplus.runs.slam import slam_run
from boxplus.runs.slam.config import load_slam_config
from boxplus.runs.slam.folder import SlamFolder
from boxplus.runs.slam.graph_file import read_graph
from boxplus.runs.slam.slam_run import run_slam
from boxplus.runs.slam.summary import LEFT_IN_PLACE
from boxplus.simulation import SpinningLidar, simulate
from boxplus.simulation.live_recording import as_recording

WALK = simulate("walk", duration_s=4.0, lidar=SpinningLidar(azimuth_steps=200))
CONFIG = load_slam_config(
    settings=[
        *("odometry.scan_voxel=0.5", "odometry.map_cell=0.5", "map.save=false"),
        *("local_maps.length=0.4", "local_maps.least_length=0.2", "slam.appearance=none"),
    ]
)
LEANING = np.array([np.sin(0.2), 0.0, np.cos(0.2)])


def run_where(answers: Any, path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[SlamFolder, list[str]]:
    """A run whose surfaces show what is listed, from local map to local map."""
    monkeypatch.setattr(builder, "find_vertical", lambda *_: next(answers))
    recording = as_recording(WALK)
    recording.info.imu_topic = ""
    result = run_slam(recording, path, CONFIG)
    assert result.summary.state == "finished" and result.summary.warnings[0] == LEFT_IN_PLACE
    return result.folder, result.summary.warnings[1:]


def test_surfaces_that_show_nothing_leave_the_map_as_the_lidar_stood(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, told = run_where(iter([None] * 20), tmp_path / "out", monkeypatch)
    assert told == ["no IMU tells where down is, and nothing shows where up is: the map stands as the LiDAR did"]
    corrected, odometry = read_trajectory(folder.trajectory), read_trajectory(folder.odometry.trajectory)
    np.testing.assert_allclose(corrected.q_wxyz, odometry.q_wxyz, atol=1e-8)
    maps = LocalMapFolder(folder.local_maps)
    assert len(maps) >= 3 and not any(maps[number].is_level for number in range(len(maps)))


def test_the_first_map_that_shows_it_sets_the_map_upright(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, told = run_where(iter([None, None, LEANING]), tmp_path / "out", monkeypatch)  # asked no fourth time
    maps = LocalMapFolder(folder.local_maps)
    assert [maps[number].is_level for number in range(len(maps))] == [False, False] + [True] * (len(maps) - 2)
    T_world_map = read_graph(folder.graph).placed.T_map
    np.testing.assert_allclose(quaternion.to_matrix(T_world_map[2:, :4])[:, :, 2], [[0.0, 0.0, 1.0]] * (len(maps) - 2), atol=1e-6)
    tilt = np.degrees(np.arccos(quaternion.to_matrix(maps[2].T_odo_map[:4])[2, 2]))
    assert told == [
        "no IMU tells where down is: surfaces of local map 2 do, those of earlier ones do not; trajectory and map are turned "
        f"upright, by {tilt:.1f}° from where the LiDAR began"
    ]


def test_a_path_that_climbs_within_an_upright_plane_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slam_run, "climb_within_upright_plane", lambda p: 10.1 if p.shape[1] == 3 else None)
    _, (told,) = run_where(iter([LEANING]), tmp_path / "out", monkeypatch)
    assert "lies in an upright plane and goes 10.1 m up and down in it" in told and "mounted more than 45° from upright" in told
