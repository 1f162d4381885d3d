"""`boxplus localize` in the map of a simulated run: another way through it, a map of another place, files and facts."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.errors import InputError
from boxplus.formats.clouds.ply import read_ply, write_ply
from boxplus.formats.trajectory import Trajectory, read_trajectory
from boxplus.manifolds import quaternion, se3
from boxplus.recordings import open_recording
from boxplus.recordings.recording import Recording
from boxplus.report.localization_page import write_localization_report
from boxplus.runs.lidar_inertial.config import load_run_config
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.runs.localization.config import LocalizationRunConfig, load_localization_config
from boxplus.runs.localization.folder import LocalizationFolder, claim_localization_folder
from boxplus.runs.localization.localization_run import LocalizationResult, run_localization
from boxplus.runs.localization.logs import LOG_COLUMNS, SEARCH_COLUMNS
from boxplus.runs.localization.summary import LocalizationSummary
from boxplus.runs.saved_map.saved_map import open_saved_map
from boxplus.runs.sessions.config import MergeConfig
from boxplus.runs.sessions.merge_run import merge_runs
from boxplus.runs.settings_file import load_settings
from boxplus.runs.storage.row_log import read_row_log
from boxplus.simulation import SpinningLidar
from boxplus.simulation.drifting_drive import DriftConfig
from boxplus.simulation.live_recording import as_recording
from boxplus.simulation.motions import trajectories
from boxplus.simulation.recording_writer import write_recording
from boxplus.simulation.scenarios import Scenario
from boxplus.simulation.simulation import Simulation
from boxplus.simulation.worlds.worlds import city, yard
from tests.runs.sessions.runs import written_run

MOUNTING = "odometry.T_imu_lidar=[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"
ODOMETRY = ("odometry.scan_voxel=0.5", "odometry.map_cell=0.5", MOUNTING)
SETTINGS = [*ODOMETRY, "map.save=false", "localization.candidates=4", "local_maps.max_range=40"]


def drive(route: tuple[tuple[float, float], ...], seed: int) -> Simulation:
    lidar = SpinningLidar(channels=16, azimuth_steps=250, vertical_fov_deg=(-25.0, 15.0), rate_hz=5.0)
    way = trajectories.drive(route, speed=5.0, standstill_s=1.0, seed=seed)
    return Simulation(Scenario("yard", yard(60.0, seed=8), way, lidar, T_imu_lidar=np.eye(4)), seed=seed)


def run(recording: Recording, folder: Path, saved: Path) -> LocalizationResult:
    config = load_localization_config(settings=SETTINGS)
    return run_localization(recording, folder, open_saved_map(saved, config.local_maps), config)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("map") / "run"
    config = load_run_config(settings=[*ODOMETRY, "map.ply=true", "map.pcd=false"])
    run_odometry(as_recording(drive(((-20.0, 0.0), (20.0, 0.0)), seed=1)), folder, config)
    return folder


def true_in_map(simulation: Simulation, mapped: Path, trajectory: Trajectory) -> np.ndarray:
    """(n, 7) the true poses in the frame of the map, by where the run that made it was in the middle of its way."""
    made = read_trajectory(mapped / "trajectory.csv")
    k = len(made) // 2
    T_map = np.concatenate([made.q_wxyz[k], made.p[k]])
    T_map_world = se3.compose(
        T_map, se3.inverse(true_poses(drive(((-20.0, 0.0), (20.0, 0.0)), seed=1), made.times[k : k + 1])[0])
    )
    return se3.compose(T_map_world, true_poses(simulation, trajectory.times))


def true_poses(simulation: Simulation, time_ns: np.ndarray) -> np.ndarray:
    """(n, 7) in the simulated world."""
    truth = simulation.ground_truth(time_ns)
    return np.hstack([quaternion.from_matrix(truth.R_world_imu), truth.p_world_imu])


def draw(folder: Path, result: LocalizationResult) -> str:
    """The page of the run, without that of its odometry."""
    without = replace(result, odometry=result.odometry.model_copy(update={"scans": 0}))
    return write_localization_report(folder, without).read_text(encoding="utf-8")


@pytest.mark.slow
def test_another_way_through_the_map_is_found_and_followed(mapped: Path, tmp_path: Path) -> None:
    simulation = drive(((15.0, 2.0), (-14.0, 2.0)), seed=2)
    bag = write_recording(simulation, tmp_path / "tuesday", "ros1")
    torn = tmp_path / "torn"
    shutil.copytree(mapped, torn)
    segment = min((torn / "map" / "tiles").glob("*/*.ply"), key=lambda file: file.stat().st_size)
    segment.write_bytes(segment.read_bytes()[:-4])
    said = json.loads((torn / "run.json").read_text())
    (torn / "run.json").write_text(json.dumps(said | {"contradiction": "its sensors disagree"}))
    words = ["localize", str(bag), "--map", str(torn), "-o", str(tmp_path / "out"), "--json"]
    called = CliRunner().invoke(app, [*words, *(f"--set={text}" for text in SETTINGS)])
    assert called.exit_code == 3, called.stderr
    own, found = LocalizationFolder(tmp_path / "out"), json.loads(called.stdout)
    assert found["outcome"] == "not to be trusted" and found["run"] == json.loads(own.summary.read_text())
    summary = LocalizationSummary.model_validate(found["run"])
    assert "found after" in called.stderr and str(own.trajectory.with_suffix(".tum")) in called.stderr
    assert any(text.startswith("the map is damaged: ") and segment.name in text for text in summary.warnings)
    assert " ".join(called.stderr.split()).count("a segment is damaged") == 1
    against = "the map is not to be trusted, as the run that wrote it says: its sensors disagree"
    assert summary.reasons == [against] and summary.map_doubts == ["its sensors disagree"]
    assert re.search(r"finished: \d+ scans \([0-9.]+ s\); not to be trusted: " + against, " ".join(called.stderr.split()))
    assert summary.program == "boxplus localize" and summary.map_kind == "boxplus lio"
    assert summary.found_after_s is not None and summary.found_after_s <= 7.0 and not summary.losses
    trajectory, log = read_trajectory(own.trajectory), read_row_log(own.log, LOG_COLUMNS)
    assert len(log) == summary.scans == sum(summary.status.values())
    assert set(trajectory.status or ()) == {"localised"}
    # A pose is written for exactly the scans that are not searching.
    np.testing.assert_array_equal(trajectory.times, log.time_ns[log.status != "searching"])
    xi = se3.log(
        se3.compose(se3.inverse(true_in_map(simulation, mapped, trajectory)), np.hstack([trajectory.q_wxyz, trajectory.p]))
    )
    assert np.linalg.norm(xi[:, 3:], axis=1).max() < 0.15 and np.linalg.norm(xi[:, :3], axis=1).max() < np.deg2rad(1.0)
    odometry = read_trajectory(own.odometry.trajectory)
    assert summary.T_map_world is not None
    T_last = np.concatenate([odometry.q_wxyz[-1], odometry.p[-1]])
    np.testing.assert_allclose(se3.compose(np.array(summary.T_map_world), T_last)[4:], trajectory.p[-1], atol=1e-6)
    searches = read_row_log(own.searches, SEARCH_COLUMNS)
    assert "" in searches.texts["verdict"] and "passes" in searches.status
    page = (own.path / "report.html").read_text(encoding="utf-8")
    assert "until the place was found" in page and "local maps were computed" in page
    assert '<span class="state failed">finished</span> not to be trusted · in the map' in page and against in page
    with pytest.raises(InputError, match="earlier run"), claim_localization_folder(own.path):
        pass
    # What somebody accepts is a warning.
    saved, config = open_saved_map(torn), load_localization_config(settings=SETTINGS)
    with open_recording(bag) as recording:
        accepted = run_localization(
            recording, tmp_path / "accepted", saved, config, accept_doubts=True, should_stop=lambda: True
        ).summary
    assert accepted.map_doubts == []
    assert "the run that wrote the map says against it, which somebody accepted: its sensors disagree" in accepted.warnings


@pytest.mark.slow
def test_in_the_map_of_another_place_there_is_no_pose(mapped: Path, tmp_path: Path) -> None:
    cloud = read_ply(mapped / "map.ply").points
    cloud = cloud[np.abs(cloud).max(axis=1) < 20.0]
    mirrored = cloud * np.array([1.0, -1.0, 1.0], np.float32)  # as much to see, and nowhere the same
    write_ply(tmp_path / "mirrored.ply", mirrored)
    result = run(as_recording(drive(((-12.0, 0.0), (8.0, 0.0)), seed=4)), tmp_path / "out", tmp_path / "mirrored.ply")
    summary = result.summary
    assert set(summary.status) == {"searching"} and summary.found_after_s is None and summary.T_map_world is None
    assert summary.searches >= 1 and any(text.startswith("not found") for text in summary.warnings)
    assert summary.best_candidates and all(text.count("% of what stands") == 1 for text in summary.best_candidates)
    assert not LocalizationFolder(tmp_path / "out").trajectory.read_text().splitlines()[1:]
    assert "The best candidates, and why not" in draw(tmp_path / "out", result)


@pytest.mark.slow
def test_a_mirrored_map_is_named(mapped: Path, tmp_path: Path) -> None:
    write_ply(tmp_path / "mirrored.ply", read_ply(mapped / "map.ply").points * np.array([1.0, -1.0, 1.0], np.float32))
    summary = run(as_recording(drive(((-12.0, 0.0), (8.0, 0.0)), seed=4)), tmp_path / "out", tmp_path / "mirrored.ply").summary
    assert summary.found_after_s is None and summary.T_map_world is None
    (why,) = (text for text in summary.warnings if text.startswith("not found"))
    assert re.fullmatch(r"not found: read mirrored, the map has what was seen \(\d+ % of what stands\): give one of .*", why)


@pytest.mark.slow
def test_in_a_joint_map_places_come_from_its_sessions(tmp_path: Path) -> None:
    """Once it was a bare cloud, with hundreds of places on a grid over its ground."""
    world, drift = city(2, 2, seed=5), DriftConfig(channels=16, azimuth_steps=240, step_m=2.0)
    monday = written_run(tmp_path / "monday", world, [[0.0, 0.0], [60.0, 0.0], [60.0, 40.0]], drift, 5)
    written_run(tmp_path / "friday", world, [[60.0, 95.0], [60.0, 0.0], [10.0, 0.0]], drift, 6)
    merge_runs(
        [tmp_path / "monday", tmp_path / "friday"], tmp_path / "street", load_settings(MergeConfig, None, ["map.voxel=0.2"])
    )
    saved = open_saved_map(tmp_path / "street")
    assert saved.kind == "boxplus map merge" and len(saved.trajectories) == 2
    assert [own.number for own in saved.local_maps] == list(range(len(saved.local_maps))) and len(saved.local_maps) < 20
    assert (
        f"{len(saved.local_maps)} local maps were computed from the map along the trajectories of its 2 sessions" in saved.report
    )
    # A way where only Friday has been.
    lidar = SpinningLidar(channels=16, azimuth_steps=250, vertical_fov_deg=(-25.0, 15.0), rate_hz=5.0)
    way = trajectories.drive(((60.0, 92.0), (60.0, 60.0)), speed=5.0, standstill_s=1.0, seed=2)
    simulation = Simulation(Scenario("city", world, way, lidar, T_imu_lidar=np.eye(4)), seed=2)
    summary = run(as_recording(simulation), tmp_path / "out", tmp_path / "street").summary
    assert summary.found_after_s is not None and not summary.losses and not summary.reasons
    found = read_trajectory(tmp_path / "out" / "trajectory.csv")
    truth = se3.compose(se3.inverse(monday.T_world_body[0]), true_poses(simulation, found.times))
    assert len(found) > 10 and np.linalg.norm(found.p - truth[:, 4:], axis=1).max() < 0.3  # the map itself is off by as much


def test_settings() -> None:
    assert load_localization_config(settings=["localization.least_fit=0.7"]).localization.least_fit == 0.7
    assert LocalizationRunConfig().local_maps.max_range == 50.0
    with pytest.raises(InputError, match="nonsense"):
        load_localization_config(settings=["localization.nonsense=1"])
