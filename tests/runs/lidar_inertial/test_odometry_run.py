"""A run from a recording to its output folder: what is written, and what is left when it does not come to its end."""

from __future__ import annotations

import errno
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from boxplus.errors import InputError, OutputError
from boxplus.formats.clouds.pcd import read_pcd
from boxplus.formats.clouds.ply import read_ply
from boxplus.formats.trajectory import read_trajectory
from boxplus.maps.tiles.store import TileStore
from boxplus.recordings.info import Evidence
from boxplus.recordings.recording import Event, Recording
from boxplus.report import write_report
from boxplus.runs.lidar_inertial import odometry_run
from boxplus.runs.lidar_inertial.config import load_run_config
from boxplus.runs.lidar_inertial.extrinsic import choose_extrinsic
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.runs.lidar_inertial.scan_log import SHARES, read_scan_log
from boxplus.runs.lidar_inertial.summary import RunSummary, read_summary
from boxplus.runs.run_folder import RunFolder
from boxplus.runs.run_loop import Progress
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import BEFORE_START
from boxplus.simulation import Fault, SpinningLidar, simulate
from boxplus.simulation.live_recording import as_recording
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry

LIDAR = SpinningLidar(azimuth_steps=200)


def walk(duration_s: float = 3.0) -> Recording:
    return as_recording(simulate("walk", duration_s=duration_s, lidar=LIDAR))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunFolder, RunSummary]:
    folder = RunFolder(tmp_path_factory.mktemp("run") / "out")
    return folder, run_odometry(walk(), folder.path)


def test_folder_holds_everything_and_agrees_with_itself(finished: tuple[RunFolder, RunSummary]) -> None:
    folder, summary = finished
    assert summary.state == "finished"
    assert read_summary(folder.summary) == summary
    trajectory, scans = read_trajectory(folder.trajectory), read_scan_log(folder.scans)
    assert len(trajectory) == len(scans) == summary.scans == sum(summary.status.values()) > 20
    np.testing.assert_array_equal(trajectory.times, scans.time_ns)
    assert (summary.first_time_ns, summary.last_time_ns) == (trajectory.times[0], trajectory.times[-1])
    assert summary.path_length_m == pytest.approx(trajectory.path_length_m, abs=1e-4)
    assert trajectory.status == tuple(scans.status)
    for other in ("trajectory.tum", "trajectory.kitti.txt"):
        np.testing.assert_allclose(read_trajectory(folder.path / other).p, trajectory.p, atol=1e-5)
    store = TileStore.open(folder.tiles)
    assert store.report == ()
    assert summary.map.merged_points == len(read_ply(folder.map_ply).points) == len(read_pcd(folder.map_pcd).points)
    assert summary.map.stored_points >= summary.map.merged_points > 1000
    assert summary.extrinsic.source == "recording"
    assert [part.part for part in summary.sensors] == ["gyroscope", "clocks", "mounting", "lengths"]
    assert summary.not_shown is not None and "points too long or too short" in summary.not_shown  # it hardly moved
    assert summary.timing.scan_ms is not None
    assert summary.timing.scan_ms.median <= summary.timing.scan_ms.p99 <= summary.timing.scan_ms.max
    stages = scans.pairs("timing_ms")
    assert set(summary.timing.stages_ms) == set(stages) and "sensors compared" in stages
    np.testing.assert_array_less(sum(stages.values()), scans.column("total_ms") + 0.01)


def test_a_recording_is_known_again_by_its_first_points(finished: tuple[RunFolder, RunSummary], tmp_path: Path) -> None:
    kept = finished[1].recording.first_points
    other = as_recording(simulate("walk", seed=1, duration_s=1.0, lidar=LIDAR))
    settings = load_run_config(settings=["scan_voxel=1.0", "map.save=false"])
    assert run_odometry(walk(1.0), tmp_path / "again", settings).recording.first_points == kept is not None
    assert run_odometry(other, tmp_path / "other", settings).recording.first_points not in (None, kept)


def test_scan_log_gives_back_the_estimates(finished: tuple[RunFolder, RunSummary]) -> None:
    folder, summary = finished
    scans = read_scan_log(folder.scans)
    shares = scans.matrix(SHARES)
    assert shares.shape == (len(scans), 6) and ((shares >= 0) & (shares <= 1)).all()
    used, rejected = scans.column("points_used"), sum(scans.pairs("rejected").values())
    np.testing.assert_array_equal((used + rejected)[1:], scans.column("points_filtered")[1:])
    np.testing.assert_allclose(np.linalg.norm(scans.column("gravity"), axis=1), 9.81, atol=0.1)
    assert {reason: int(count.sum()) for reason, count in scans.pairs("rejected").items()} == summary.rejected["points"]
    np.testing.assert_allclose(sum(scans.pairs("timing_ms").values()), scans.column("total_ms"), atol=1e-3)


def test_cut_last_row_of_the_scan_log_is_left_out(finished: tuple[RunFolder, RunSummary], tmp_path: Path) -> None:
    text = finished[0].scans.read_text(encoding="utf-8")
    cut = tmp_path / "scans.csv"
    cut.write_text(text[: -len(text.splitlines()[-1]) // 2], encoding="utf-8")
    assert len(read_scan_log(cut)) < finished[1].scans


@pytest.mark.slow
def test_config_of_a_run_repeats_it_to_the_bit(finished: tuple[RunFolder, RunSummary], tmp_path: Path) -> None:
    folder, _ = finished
    config = load_run_config(folder.config)
    assert yaml.safe_load(folder.config.read_text())["recording"]["lidar_topic"] == "/lidar/points"
    run_odometry(walk(), tmp_path / "again", config)
    again = RunFolder(tmp_path / "again")
    assert again.trajectory.read_bytes() == folder.trajectory.read_bytes()
    assert again.map_ply.read_bytes() == folder.map_ply.read_bytes()


def test_progress_runs_from_start_to_end(tmp_path: Path) -> None:
    seen: list[Progress] = []
    run_odometry(walk(2.0), tmp_path / "out", progress=seen.append)
    shares = [progress.share for progress in seen]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert seen[0].status == "starting"
    assert seen[-1].stage == "merging the map"


def test_without_map(tmp_path: Path) -> None:
    summary = run_odometry(walk(2.0), tmp_path / "out", load_run_config(overrides={"map": {"save": False}}))
    assert summary.map.stored_points == 0
    assert not (tmp_path / "out" / "map").exists()
    assert not (tmp_path / "out" / "map.ply").exists()


def test_asked_to_stop_the_results_are_complete(tmp_path: Path) -> None:
    seen: list[Progress] = []
    summary = run_odometry(
        walk(), tmp_path / "out", progress=seen.append, should_stop=lambda: bool(seen) and seen[-1].count >= 15
    )
    assert summary.state == "interrupted"
    assert 15 <= summary.scans < 29
    assert "trajectory and map are complete up to there" in read_summary(tmp_path / "out" / "run.json").describe_state()
    assert len(read_trajectory(tmp_path / "out" / "trajectory.csv")) == summary.scans
    assert summary.map.merged_points is not None
    assert TileStore.open(tmp_path / "out" / "map").report == ()


def test_keyboard_interrupt_leaves_a_readable_folder(tmp_path: Path) -> None:
    def interrupt(progress: Progress) -> None:
        if progress.count >= 15:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_odometry(walk(), tmp_path / "out", progress=interrupt)
    summary = read_summary(tmp_path / "out" / "run.json")
    assert summary.state == "interrupted"
    assert len(read_trajectory(tmp_path / "out" / "trajectory.csv")) == summary.scans >= 15


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="no SIGKILL on Windows")
def test_killed_run_is_readable_and_says_so(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "out")
    script = (
        "from boxplus.simulation import SpinningLidar, simulate\n"
        "from boxplus.simulation.live_recording import as_recording\n"
        "from boxplus.runs.lidar_inertial import odometry_run\n"
        "odometry_run._SUMMARY_EVERY_S = 0.0\n"
        "recording = as_recording(simulate('walk', lidar=SpinningLidar(azimuth_steps=200)))\n"
        f"odometry_run.run_odometry(recording, {str(folder.path)!r})\n"
    )
    process = subprocess.Popen([sys.executable, "-c", script])
    try:
        deadline = time.monotonic() + 300.0
        while process.poll() is None and time.monotonic() < deadline:
            if folder.summary.exists() and read_summary(folder.summary).scans >= 20:
                break
            time.sleep(0.02)
        assert process.poll() is None, "the run ended before it could be killed"
        assert "still running" in read_summary(folder.summary).describe_state()
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    summary = read_summary(folder.summary)
    assert summary.state == "running"
    assert "interrupted (the process ended without a word) after at least" in summary.describe_state()
    count = len(read_trajectory(folder.trajectory))
    assert count >= summary.scans >= 20
    assert abs(len(read_scan_log(folder.scans)) - count) <= 1
    store = TileStore.open(folder.tiles)
    assert "did not close it" in store.report[0]
    assert store.point_count >= summary.map.stored_points > 0

    from boxplus.report import write_report

    assert "ended without a word" in write_report(folder.path).read_text(encoding="utf-8")


def test_full_disk_is_told_and_what_was_written_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write, full = os.write, [False]

    def fill(progress: Progress) -> None:
        full[0] = full[0] or progress.count >= 15

    def limited(file: int, data: bytes) -> int:
        if full[0]:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(file, data)

    monkeypatch.setattr(os, "write", limited)
    with pytest.raises(
        OutputError, match="got a full disk – free some space or choose another output folder; everything written"
    ):
        run_odometry(walk(), tmp_path / "out", progress=fill)
    summary = read_summary(tmp_path / "out" / "run.json")
    assert summary.state == "failed"
    assert "full disk" in str(summary.error)
    assert "stopped by an error after" in summary.describe_state()
    assert len(read_trajectory(tmp_path / "out" / "trajectory.csv")) == summary.scans >= 15


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may write everywhere")
def test_unwritable_folder(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="got no permission to write there"):
        run_odometry(walk(), tmp_path / "out")


def test_file_in_the_way(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    with pytest.raises(OutputError, match="something else of that name in the way"):
        run_odometry(walk(), tmp_path / "out")


def test_foreign_folder_is_refused_and_earlier_run_too(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(
        InputError, match="expected a new or empty output folder, or one with an earlier run of boxplus – got other"
    ):
        run_odometry(walk(), tmp_path, overwrite=True)
    run_odometry(walk(2.0), tmp_path / "out")
    with pytest.raises(InputError, match="add --overwrite to replace them"):
        run_odometry(walk(2.0), tmp_path / "out")


@pytest.mark.slow
def test_overwriting_replaces_a_run_and_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "out"
    run_odometry(walk(2.0), out)
    foreign = [out / "notes.txt", out / "plots" / "mine.png", out / "trajectory_corrected.tum"]
    foreign[1].parent.mkdir(exist_ok=True)
    for path in foreign:
        path.write_text("mine")
    summary = run_odometry(walk(3.0), out, overwrite=True)
    assert [path.read_text() for path in foreign] == ["mine"] * 3
    assert len(read_trajectory(out / "trajectory.csv")) == summary.scans
    assert summary.map.merged_points == len(read_ply(out / "map.ply").points)


def test_recording_without_imu_cover_is_refused_with_the_reasons(tmp_path: Path) -> None:
    scans = [event for event in walk(2.0) if isinstance(event, Scan)]
    source = walk(2.0)
    recording = Recording(source.info, lambda tally: iter(scans), lambda: None)
    with pytest.raises(
        InputError, match=r"scans that IMU samples cover.*got 19 scans and 0 IMU samples.*× scan without any IMU sample"
    ):
        run_odometry(recording, tmp_path / "out")
    assert read_summary(tmp_path / "out" / "run.json").state == "failed"
    assert run_odometry(walk(2.0), tmp_path / "out").state == "finished"  # nothing of the failed run is worth a question


def test_gaps_are_found(tmp_path: Path) -> None:
    source = walk(4.0)
    begin = int(next(event.time_ns[0] for event in source if isinstance(event, ImuSamples)))

    def with_gap() -> list[Scan | ImuSamples]:
        events: list[Scan | ImuSamples] = []
        for event in source:
            if isinstance(event, ImuSamples):
                since = (event.time_ns - begin) * 1e-9
                keep = (since < 2.0) | (since > 2.5)
                event = ImuSamples(event.time_ns[keep], event.gyro[keep], event.accel[keep])
            events.append(event)
        return events

    summary = run_odometry(Recording(source.info, lambda tally: iter(with_gap()), lambda: None), tmp_path / "out")
    assert [round(gap.duration_s, 1) for gap in summary.imu_gaps] == [0.5]
    assert summary.scan_gaps == []
    assert any("IMU gap of" in warning.text and warning.count > 1 for warning in summary.warnings)


@pytest.mark.slow
def test_corridor_says_what_was_not_measured(tmp_path: Path) -> None:
    summary = run_odometry(as_recording(simulate("corridor", duration_s=6.0, lidar=LIDAR)), tmp_path / "out")
    assert summary.status["weak"] > 0.5 * summary.scans
    text = summary.warnings[0].text
    assert re.match(rf"{summary.status['weak']} of {summary.scans} scans are weak; the longest stretch, from ", text)
    assert "was not determined by the LiDAR in its " in text
    assert "position along (" in text


def test_view_sees_every_estimate(tmp_path: Path) -> None:
    class Eye:
        def __init__(self) -> None:
            self.times: list[int] = []

        def show(self, estimate: odometry_run.Estimate) -> None:
            self.times.append(estimate.time_ns)

    eye = Eye()
    run_odometry(walk(2.0), tmp_path / "out", view=eye)
    np.testing.assert_array_equal(eye.times, read_trajectory(tmp_path / "out" / "trajectory.csv").times)


def test_a_recorded_extrinsic_that_is_in_doubt_is_a_warning() -> None:
    recording = walk(1.0)
    config = load_run_config().odometry
    assert choose_extrinsic(recording, config).warning == ""
    recording.info.evidence.append(Evidence("T_imu_lidar", "static transforms", "warning", "the static transforms disagree"))
    assert choose_extrinsic(recording, config).warning == "the static transforms disagree"
    given = config.model_copy(update={"T_imu_lidar": tuple(map(tuple, recording.info.T_imu_lidar.tolist()))})
    assert choose_extrinsic(recording, given).warning == ""


def test_a_run_without_a_start_says_what_is_wrong_with_the_recording(tmp_path: Path) -> None:
    recording = walk(1.0)
    recording.info.evidence.append(Evidence("clocks", "differ", "error", "LiDAR and IMU are stamped by different clocks"))
    recording.shift_lidar(-7200.0)
    with pytest.raises(InputError, match=r"none of them usable \(.*; clocks: LiDAR and IMU are stamped by different clocks\)"):
        run_odometry(recording, tmp_path / "out")


@pytest.mark.slow
def test_extrinsic_is_estimated_when_nobody_gives_it() -> None:
    simulation = simulate("spin", duration_s=8.0, lidar=SpinningLidar(azimuth_steps=400))
    recording = as_recording(simulation)
    config = load_run_config().odometry
    assert choose_extrinsic(recording, config).source == "recording"
    given = config.model_copy(update={"T_imu_lidar": tuple(map(tuple, np.eye(4).tolist()))})
    assert choose_extrinsic(recording, given).source == "given"
    recording.info.T_imu_lidar = None
    extrinsic = choose_extrinsic(recording, config)
    assert extrinsic.source in ("estimated", "identity")
    assert "neither --T-imu-lidar, the configuration nor the recording" in extrinsic.warning
    assert "give --T-imu-lidar for the best result" in extrinsic.warning
    assert extrinsic.applied_to(config).extrinsic_estimation == "gated"
    decided = load_run_config(settings=["extrinsic_estimation=off"]).odometry
    assert extrinsic.applied_to(decided).extrinsic_estimation == "off"
    assert extrinsic.sigma is not None
    if extrinsic.sigma[0] < 5.0:  # the turn about one axis leaves the rotation about it open
        turn = extrinsic.T_imu_lidar[:3, :3].T @ simulation.T_imu_lidar[:3, :3]
        assert np.degrees(np.arccos((np.trace(turn) - 1.0) / 2.0)) < 5.0


def test_extrinsic_without_any_turn_is_identity_with_the_reason() -> None:
    recording = as_recording(simulate("at_rest", duration_s=3.0, lidar=LIDAR))
    recording.info.T_imu_lidar = None
    extrinsic = choose_extrinsic(recording, load_run_config().odometry)
    assert extrinsic.source == "identity"
    np.testing.assert_array_equal(extrinsic.T_imu_lidar, np.eye(4))
    assert "identity assumed" in extrinsic.warning
    assert "nobody gave T_imu_lidar, and the motion did not show it" in extrinsic.unknown


@pytest.mark.slow
def test_a_mounting_that_was_assumed_is_not_trusted_unless_the_motion_bears_it_out(tmp_path: Path) -> None:
    def without_mounting(scenario: str, duration_s: float) -> Recording:
        simulation = simulate(scenario, duration_s=duration_s, lidar=SpinningLidar(azimuth_steps=300))
        recording = as_recording(simulation)
        recording.info.T_imu_lidar = None
        return recording

    still = run_odometry(without_mounting("at_rest", 3.0), tmp_path / "still")
    assert still.extrinsic.source == "identity"
    assert still.contradiction is not None and "nobody gave T_imu_lidar" in still.contradiction
    moving = run_odometry(without_mounting("walk", 8.0), tmp_path / "moving")
    assert moving.extrinsic.source == "estimated"
    assert moving.contradiction is None


@pytest.mark.slow
def test_a_clock_that_steps_back_is_the_first_warning(tmp_path: Path) -> None:
    simulation = simulate("walk", duration_s=4.0, lidar=LIDAR)
    middle_ns = (simulation.start_ns + simulation.end_ns) // 2
    hour_ns = 3600 * 10**9

    def step_back(events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            if isinstance(event, Scan):
                shift = -hour_ns * (event.start_ns > middle_ns)
                yield replace(event, time_ns=event.time_ns + shift, start_ns=event.start_ns + shift, end_ns=event.end_ns + shift)
            else:
                yield replace(event, time_ns=event.time_ns - hour_ns * (event.time_ns > middle_ns))

    summary = run_odometry(as_recording(simulation, Fault("step", "the clock steps back", step_back)), tmp_path / "out")
    assert summary.state == "finished" and 15 <= summary.scans <= 21
    lidar, imu = (warning.text for warning in summary.warnings[:2])
    assert re.match(
        r"the times of the LiDAR step back by 3599\.9\d* s after \d+\.\d+ s and go on from there: 1\.\d s of it", lidar
    )
    assert re.match(r"the times of the IMU step back by (3600\.0|3599\.9)\d* s after", imu)


@pytest.mark.slow
def test_a_path_that_begins_late_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = simulate("walk", duration_s=3.6, lidar=LIDAR)
    begin_ns = simulation.start_ns + 2_200_000_000

    def without_first_samples(events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            if isinstance(event, Scan):
                yield event
            elif (later := event.time_ns >= begin_ns).any():
                yield ImuSamples(event.time_ns[later], event.gyro[later], event.accel[later])

    monkeypatch.setattr(LidarInertialOdometry, "counters", property(lambda self: {BEFORE_START: 15}))
    recording = as_recording(simulation, Fault("late", "the IMU begins late", without_first_samples))
    summary = run_odometry(recording, tmp_path / "out")
    (told,) = [warning.text for warning in summary.warnings if "have no pose" in warning.text]
    assert re.match(r"15 of the \d\d scans that were read have no pose: no start .* begin 2\.\d s after the first scan", told)


def test_a_lidar_alone(tmp_path: Path) -> None:
    recording = walk(4.0)
    recording.info.imu_topic = ""  # its samples still come: none may take part
    summary = run_odometry(recording, tmp_path / "out")
    assert summary.state == "finished" and summary.scans > 35 and summary.contradiction is None
    assert (summary.extrinsic.source, summary.start and summary.start.kind) == ("none", "lidar")
    assert summary.rejected["odometry"] == {"IMU sample, which takes no part": summary.imu_samples_read}
    folder = RunFolder(tmp_path / "out")
    assert len(read_trajectory(folder.trajectory)) == summary.scans
    write_report(folder.path)
    page = folder.report.read_text(encoding="utf-8")
    assert "no IMU takes part: poses are those of the LiDAR" in page
    config = load_run_config(folder.config).odometry
    assert config.T_imu_lidar is None
