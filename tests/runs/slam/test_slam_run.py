"""`boxplus slam` over a simulated drive round a block: files, facts, loops that a user forbids, the report."""

from __future__ import annotations

import csv
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from html import unescape
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import yaml

from boxplus.errors import InputError
from boxplus.formats.clouds.ply import read_ply
from boxplus.formats.trajectory import Trajectory, read_trajectory
from boxplus.manifolds import quaternion
from boxplus.recordings.recording import Recording
from boxplus.report import load_report, write_report
from boxplus.report.slam_page import write_slam_report
from boxplus.runs.lidar_inertial.summary import read_summary
from boxplus.runs.run_facts import WarningFacts
from boxplus.runs.sessions.session_run import open_session_run
from boxplus.runs.slam.config import load_slam_config
from boxplus.runs.slam.folder import SlamFolder, claim_slam_folder
from boxplus.runs.slam.loop_file import pairs_without_maps, read_loop_decisions
from boxplus.runs.slam.result import SlamResult, load_slam_result
from boxplus.runs.slam.slam_run import doubt_of_run, run_slam
from boxplus.runs.slam.spool import ScanSpool, SpooledScan, read_spool
from boxplus.runs.slam.summary import GnssFacts
from boxplus.sensors.satellites.geodesy import EnuFrame, to_utm
from boxplus.simulation import SpinningLidar
from boxplus.simulation.gnss import GnssConfig
from boxplus.simulation.live_recording import GNSS_ORIGIN, as_recording
from boxplus.simulation.motions import trajectories
from boxplus.simulation.scenarios import make_scenario, mounting
from boxplus.simulation.simulation import Simulation
from boxplus.simulation.worlds.worlds import city
from boxplus.systems.georeference.georeference import Georeference
from boxplus.systems.slam.slam import Slam
from tests.systems.slam.drives import ate

SETTINGS = [
    *("odometry.scan_voxel=0.5", "odometry.map_cell=0.5", "map.pcd=false", "map.voxel=0.5"),
    *("local_maps.length=15", "local_maps.voxel=0.5", "slam.nearby_count=1"),
]
ROUTE = ((18.0, 0.0), (40.0, 0.0), (40.0, 40.0), (0.0, 40.0), (0.0, 0.0), (40.0, 0.0), (40.0, 22.0))


def round_a_block() -> Simulation:
    world = city(1, 1, pitch=40.0, street=14.0, seed=3)
    lidar = SpinningLidar(channels=16, azimuth_steps=250, vertical_fov_deg=(-25.0, 15.0), rate_hz=5.0)
    drive = trajectories.drive(ROUTE, speed=9.0, standstill_s=1.0, seed=3)
    return Simulation(replace(make_scenario("drive"), name="round a block", world=world, trajectory=drive, lidar=lidar), seed=3)


RECEIVER = GnssConfig(lever=(0.3, 0.0, 0.8), sigma=0.02, slow_sigma=0.02, claimed=0.04, multipath=2, multipath_s=4.0)


@dataclass(frozen=True)
class Finished:
    folder: SlamFolder
    result: SlamResult
    simulation: Simulation

    def error(self, trajectory: Trajectory) -> float:
        return ate(trajectory.p, self.simulation.ground_truth(trajectory.times).p_world_imu)


def block() -> Recording:
    return as_recording(round_a_block(), gnss=RECEIVER)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    folder = SlamFolder(tmp_path_factory.mktemp("slam") / "out")
    config = load_slam_config(settings=[*SETTINGS, "gnss.utm=true"])
    result = run_slam(block(), folder.path, config, forbidden=[(400, 1)], forced=[(500, 2), (501, 2)])
    write_report(result)
    return Finished(folder, result, round_a_block())


@pytest.mark.slow
def test_the_folder_holds_the_corrected_results_and_the_odometry_s_own(finished: Finished) -> None:
    folder, summary = finished.folder, finished.result.summary
    assert json.loads(folder.summary.read_text())["program"] == "boxplus slam" and summary.state == "finished"
    assert read_summary(folder.odometry.summary) == finished.result.odometry
    corrected, own = read_trajectory(folder.trajectory), read_trajectory(folder.odometry.trajectory)
    np.testing.assert_array_equal(corrected.times, own.times)
    assert corrected.status == own.status
    assert folder.spool.stat().st_size == finished.result.summary.spool_bytes > 0
    points = len(read_ply(folder.map_ply).points)  # merging thins what came in apart from each other
    assert 0.95 * summary.map_points < points <= summary.map_points and points > 1000


def test_the_loop_is_closed_and_nothing_gets_worse(finished: Finished) -> None:
    assert finished.result.summary.loops_accepted >= 1
    after, before = (
        finished.error(read_trajectory(path)) for path in (finished.folder.trajectory, finished.folder.odometry.trajectory)
    )
    assert after <= before + 0.005


def test_the_head_of_the_report_says_what_is_not_to_be_trusted(finished: Finished, tmp_path: Path) -> None:
    summary = finished.result.summary.model_copy(update={"contradiction": "positions by satellite: fixes jump by 3.0 m"})
    copy = SlamFolder(tmp_path)
    shutil.copy(finished.folder.gnss, copy.gnss)
    page = write_slam_report(replace(finished.result, folder=copy, summary=summary)).read_text(encoding="utf-8")
    assert '<span class="state failed">finished</span> not to be trusted · loops closed' in page
    assert "fixes jump by 3.0 m" in page and summary.describe_state().endswith("fixes jump by 3.0 m")


def test_the_report_does_not_say_what_an_older_version_did_not_ask(finished: Finished, tmp_path: Path) -> None:
    gnss, copy = finished.result.summary.gnss, SlamFolder(tmp_path)
    assert gnss is not None
    shutil.copy(finished.folder.gnss, copy.gnss)
    older = GnssFacts.model_validate(gnss.model_dump(exclude={"unshown_slide_m", "unshown_turn_deg"}))
    for facts, is_told in ((gnss, True), (older, False)):
        summary = finished.result.summary.model_copy(update={"gnss": facts})
        page = write_slam_report(replace(finished.result, folder=copy, summary=summary)).read_text(encoding="utf-8")
        assert ("they might slide" in page) is is_told


def test_the_report_repeats_the_warnings_of_the_odometry(finished: Finished, tmp_path: Path) -> None:
    warnings = [WarningFacts(text="no point matched < 3 scans", count=2, first_s=1.5)]
    odometry = finished.result.odometry.model_copy(update={"warnings": warnings})
    copy = SlamFolder(tmp_path)
    shutil.copy(finished.folder.gnss, copy.gnss)
    page = write_slam_report(replace(finished.result, folder=copy, odometry=odometry)).read_text(encoding="utf-8")
    assert "odometry: no point matched &lt; 3 scans <small>(2 times, first at 1.5 s)" in page


def test_every_loop_is_in_the_table_and_in_the_report(finished: Finished) -> None:
    loops = finished.result.outcome.loops
    with finished.folder.loops.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(int(row["query"]), int(row["place"]), row["accepted"] == "1") for row in rows] == [
        (loop.query, loop.place, loop.is_accepted) for loop in loops
    ]
    assert all((row["refusal"] == "") == (row["accepted"] == "1") for row in rows)
    page = finished.folder.report.read_text(encoding="utf-8")
    assert "outside of the odometry&#x27;s time" in page  # escaped once
    for loop in loops:
        assert f"[{loop.query}, {loop.place}]" in page
    assert page.count("<img alt=") == 3 + sum(loop.measured > 0 for loop in loops)
    assert finished.folder.odometry.report.exists()
    assert sum(finished.result.summary.loops_refused.values()) == sum(not loop.is_accepted for loop in loops)


def test_a_path_that_nothing_showed_is_to_be_trusted_where_satellites_do(finished: Finished) -> None:
    vague, sensors = "by its own covariance the run knows its last position to 90 m only", "the clocks are apart"
    located, refused = (cast(Georeference, SimpleNamespace(fit=fit, contradiction=None)) for fit in (object(), None))
    for contradiction, unknown, earth, doubt in (
        (None, None, located, None),
        (vague, vague, None, vague),
        (vague, vague, refused, vague),
        (vague, vague, located, None),
        (sensors, vague, located, sensors),
        (sensors, None, located, sensors),
    ):
        odometry = finished.result.odometry.model_copy(update={"contradiction": contradiction, "unknown_position": unknown})
        assert doubt_of_run(odometry, replace(finished.result.outcome, doubt=None), earth) == doubt


def test_one_doubt_does_not_hide_another(finished: Finished) -> None:
    odometry = finished.result.odometry.model_copy(update={"contradiction": "the clocks are apart"})
    outcome = replace(finished.result.outcome, doubt="local maps 3 and 4 do not fit")
    earth = cast(Georeference, SimpleNamespace(fit=None, contradiction="fixes jump"))
    said = "the clocks are apart; local maps 3 and 4 do not fit; positions by satellite: fixes jump"
    assert doubt_of_run(odometry, outcome, earth) == said


def test_trajectory_and_map_are_laid_onto_the_earth(finished: Finished) -> None:
    folder, facts = finished.folder, finished.result.summary.gnss
    assert facts is not None and facts.refusal is None and facts.epsg == 32632 and facts.position_sigma_m is not None
    place = yaml.safe_load(folder.georeference.read_text(encoding="utf-8"))
    origin = EnuFrame(*place["origin"].values())
    trajectory = read_trajectory(folder.trajectory)
    truth = origin.to_enu(GNSS_ORIGIN.to_geodetic(finished.simulation.ground_truth(trajectory.times).p_world_imu))
    off = np.linalg.norm(trajectory.p - truth, axis=1)
    assert off.max() < max(4.0 * facts.position_sigma_m, 0.2)  # nothing was aligned
    rows = list(csv.DictReader(folder.gnss.open(encoding="utf-8")))
    assert sum(row["used"] == "1" for row in rows) == facts.used
    gated = sum(count for reason, count in facts.left_out.items() if reason.startswith("off "))
    assert gated + facts.used == len(rows) and 0 < gated < 0.3 * len(rows) and facts.stretches
    utm = np.loadtxt(folder.trajectory_utm, delimiter=",", skiprows=2)
    np.testing.assert_allclose(utm[:, 1:], to_utm(origin.to_geodetic(trajectory.p), 32632), atol=1e-3)
    page = folder.report.read_text(encoding="utf-8")
    assert "fixes over the ground track" in page and f"{origin.latitude:.7f}°" in page
    points = read_ply(folder.map_ply).points.mean(axis=0)
    expected = origin.to_enu(GNSS_ORIGIN.to_geodetic([[20.0, 20.0, 0.0]]))[0]  # the middle of the block
    assert np.linalg.norm((points - expected)[:2]) < 15.0


@pytest.mark.slow
def test_the_folder_says_all_that_the_run_did(finished: Finished) -> None:
    """The report is drawn again from the folder alone, and programs find poses and loops there."""
    again = load_slam_result(finished.folder.path)
    assert again.summary == finished.result.summary and again.odometry == finished.result.odometry
    for one, other in zip(again.outcome.loops, finished.result.outcome.loops, strict=True):
        assert (one.query, one.place, one.refusal, one.weight) == (other.query, other.place, other.refusal, other.weight)
        np.testing.assert_array_equal(one.information, other.information)
    page = finished.folder.report.read_bytes()
    finished.folder.report.unlink()
    assert isinstance(load_report(finished.folder.path), SlamResult)
    write_report(finished.folder.path)
    assert len(finished.folder.report.read_bytes()) == pytest.approx(len(page), rel=0.01)


def test_the_loop_search_beside_finds_what_the_same_local_maps_give(finished: Finished) -> None:
    slam, maps = Slam(load_slam_config(settings=SETTINGS).slam), finished.result.maps
    for number in range(len(maps)):
        slam.add(maps[number])
    expected, found = slam.outcome(), finished.result.outcome
    for one, other in zip(found.loops, expected.loops, strict=True):  # positions by satellite have moved the maps since
        np.testing.assert_allclose(one.T_place_query, other.T_place_query, atol=1e-9)
    assert [(loop.query, loop.place, loop.refusal is None) for loop in found.loops] == [
        (loop.query, loop.place, loop.refusal is None) for loop in expected.loops
    ]


def test_a_folder_with_results_is_replaced_only_when_asked(finished: Finished) -> None:
    with pytest.raises(InputError, match="--overwrite"), claim_slam_folder(finished.folder.path):
        pass


def test_decisions_about_local_maps_that_there_are_not_are_told(finished: Finished) -> None:
    count = finished.result.summary.local_maps
    told = finished.result.summary.warnings
    only = f"pairs that do not exist, as there are local maps 0 to {count - 1} only"
    for text in (
        f"forbidden {only}: [400, 1]; take pairs from loops.csv",
        f"forced {only}: [500, 2], [501, 2]; take pairs from loops.csv",
    ):
        assert text in told and text in unescape(finished.folder.report.read_text(encoding="utf-8"))
    assert pairs_without_maps([(count - 1, 0)], [], count) == []


def test_decisions_of_a_user(tmp_path: Path) -> None:
    path = tmp_path / "loops.yaml"
    path.write_text("forbid: [[41, 3], [42, 3]]\nforce:\n  - [57, 12]\n")
    assert read_loop_decisions(path) == ([(41, 3), (42, 3)], [(57, 12)])
    path.write_text("")
    assert read_loop_decisions(path) == ([], [])
    for text, message in (
        ("forbid: [3]", "pairs of local maps under forbid"),
        ("remove: []", "the keys forbid and force"),
        ("a: [", "readable YAML"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            read_loop_decisions(path)
    with pytest.raises(InputError, match="readable YAML"):
        read_loop_decisions(tmp_path / "none.yaml")


def test_the_spool_gives_back_what_was_put_in_but_for_full_voxels(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    pose = np.array([1.0, 0, 0, 0, 5.0, 0, 0])
    spool = ScanSpool(tmp_path / "spool", 0.1)
    scans = []
    for k in range(3):
        points = random.uniform(-5.0, 5.0, (40, 3)).astype(np.float32)
        lidar = np.arange(40, dtype=np.uint8) if k % 2 == 0 else None  # alone, not at all, with intensities
        scans.append(SpooledScan(k, pose, points, np.arange(40, dtype=np.float32) if k else None, lidar))
        spool.append(scans[-1])
    spool.append(scans[0])  # nothing of it is new
    spool.forget()
    spool.append(scans[0])  # all of it is, for another local map
    back = list(spool.scans())
    assert [scan.time_ns for scan in back] == spool.poses()[0].tolist() == [0, 1, 2, 0, 0]
    assert [len(scan.p_body) for scan in back][3:] == [0, len(back[0].p_body)]
    for put, got, T in zip(scans, back, spool.poses()[1], strict=False):
        np.testing.assert_array_equal(got.T_odo_body, put.T_odo_body)
        np.testing.assert_array_equal(got.T_odo_body, T)
        rows = [put.p_body.tolist().index(point) for point in got.p_body.tolist()]
        for found, given in ((got.intensity, put.intensity), (got.lidar, put.lidar)):
            assert (found is None) == (given is None)
            assert found is None or given is None or found.tolist() == given[rows].tolist()
    spool.close()
    assert [scan.time_ns for scan in read_spool(tmp_path / "spool")] == [0, 1, 2, 0, 0]
    (tmp_path / "spool").write_bytes((tmp_path / "spool").read_bytes()[:-5])
    with pytest.raises(InputError, match="run it again"):
        list(read_spool(tmp_path / "spool"))


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[:-24],  # two points: what is left is points all the same
        lambda data: data[:8] + (2**60).to_bytes(8, "little") + data[16:],  # once more memory was asked for than there is
        lambda data: data[:8] + (-3).to_bytes(8, "little", signed=True) + data[16:],
        lambda data: data[:17] + b"\xff" * 8 + data[25:],  # a pose that is no number
        lambda data: data[:40] + data[48:],
    ],
)
def test_a_spool_that_is_damaged_is_not_read_as_another_one(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    pose = np.array([1.0, 0, 0, 0, 5.0, 0, 0])
    spool = ScanSpool(tmp_path / "spool", None)
    for k in range(3):
        spool.append(SpooledScan(k, pose, np.arange(30, dtype=np.float32).reshape(-1, 3), None))
    spool.close()
    assert len(list(read_spool(tmp_path / "spool"))) == 3
    (tmp_path / "spool").write_bytes(damage((tmp_path / "spool").read_bytes()))
    with pytest.raises(InputError, match="run it again"):
        list(read_spool(tmp_path / "spool"))


def test_no_byte_of_a_spool_changes_unnoticed(tmp_path: Path) -> None:
    """Once a flipped bit of a point or of a pose was a wall or a scan elsewhere in the joint map."""
    pose = np.array([1.0, 0, 0, 0, 5.0, 0, 0])
    spool = ScanSpool(tmp_path / "spool", None)
    for k in range(2):
        points = np.arange(9, dtype=np.float32).reshape(-1, 3)
        spool.append(SpooledScan(k, pose, points, np.arange(3, dtype=np.float32)))
    spool.mark()
    whole = spool.path.read_bytes()
    second = len(whole) // 2
    for at in range(len(whole)):
        spool.path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        said = f"{spool.path}: the scan that begins at byte {second * (at >= second)} is damaged"
        with pytest.raises(InputError, match=re.escape(said)):
            list(read_spool(spool.path))
        if at % second < second - 48:  # in the head
            with pytest.raises(InputError, match=re.escape(said)):
                spool.poses()
    spool.close()


def test_a_spool_goes_on_from_a_mark_with_the_same_bytes(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    pose = np.array([np.cos(0.4), 0, 0, np.sin(0.4), 5.0, -3.0, 0.3])
    scans = [SpooledScan(k, pose, random.uniform(-2.0, 2.0, (300, 3)).astype(np.float32), None) for k in range(8)]
    straight = ScanSpool(tmp_path / "straight", 0.3)
    for k, scan in enumerate(scans):
        straight.append(scan)
        if k == 3:
            straight.forget()
    broken = ScanSpool(tmp_path / "broken", 0.3)
    for k, scan in enumerate(scans[:7]):
        broken.append(scan)
        if k == 3:
            broken.forget()
        if k == 5:
            mark = broken.mark()
    broken.close()
    again = ScanSpool(tmp_path / "broken", 0.3, go_on=True)
    again.cut(mark)
    for scan in scans[6:]:
        again.append(scan)
    straight.close()
    again.close()
    assert (tmp_path / "broken").read_bytes() == (tmp_path / "straight").read_bytes()
    with pytest.raises(InputError, match="bytes of the checkpoint"):
        ScanSpool(tmp_path / "new", 0.3).cut(mark)


def test_a_lidar_alone_closes_loops_and_its_map_stands_upright(tmp_path: Path) -> None:
    """Nobody says where down is, and the LiDAR leans forward by 15°: surfaces tell."""
    lidar = SpinningLidar(channels=16, azimuth_steps=360, vertical_fov_deg=(-25.0, 15.0))
    leaning = replace(round_a_block().scenario, lidar=lidar, T_imu_lidar=mounting(-1.0, 15.0, 5.0, (0.6, 0.1, 0.4)))
    simulation = Simulation(leaning, seed=3)
    recording = as_recording(simulation, gnss=RECEIVER)
    recording.info.imu_topic = ""  # its samples still come: none may take part
    summary = run_slam(recording, tmp_path / "out", load_slam_config(settings=SETTINGS)).summary
    assert summary.state == "finished" and summary.contradiction is None and summary.gnss is None
    assert summary.loops_accepted >= 3 and summary.local_maps > 10
    upright, no_fixes = summary.warnings
    assert re.search(r"no IMU tells where down is: .* turned upright, by 15\.\d° from where the LiDAR began", upright)
    assert "positions by satellite are not used" in no_fixes
    folder = SlamFolder(tmp_path / "out")
    trajectory, odometry = read_trajectory(folder.trajectory), read_trajectory(folder.odometry.trajectory)
    truth = simulation.ground_truth(trajectory.times)
    p_world_lidar = truth.p_world_imu + truth.R_world_imu @ simulation.T_imu_lidar[:3, 3]
    before, after = (ate(found.p, p_world_lidar) for found in (odometry, trajectory))
    assert after < 0.02 and after < 1.1 * before
    up_lidar = np.swapaxes(truth.R_world_imu @ simulation.T_imu_lidar[:3, :3], 1, 2)[:, :, 2]
    worlds = [quaternion.to_matrix(found.q_wxyz) for found in (odometry, trajectory)]
    lean = [np.degrees(np.arccos((R @ up_lidar[..., None])[:, 2, 0])) for R in worlds]
    assert lean[0].min() > 14.0 and lean[1].max() < 0.3
    report = unescape(write_report(load_slam_result(folder.path)).read_text(encoding="utf-8"))
    assert "no IMU tells where down is" in report
    with pytest.raises(InputError, match=r"runs with an IMU, .* – got one of a LiDAR alone"):
        open_session_run(folder.path, "monday", needs_scans=False)


def test_settings_of_an_imu_are_refused_without_one_and_leave_no_folder(tmp_path: Path) -> None:
    recording = block()
    recording.info.imu_topic = ""
    with pytest.raises(InputError, match="settings of a LiDAR alone – got gyro_noise"):
        run_slam(recording, tmp_path / "out", load_slam_config(settings=["odometry.gyro_noise=0.01"]))
    assert not (tmp_path / "out").exists()
