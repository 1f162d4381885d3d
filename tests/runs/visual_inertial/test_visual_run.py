"""Visual-inertial odometry over a simulated recording: its files, its end and its refusals."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.errors import InputError
from boxplus.evaluation.evaluation import evaluate
from boxplus.formats.clouds.ply import read_ply
from boxplus.formats.trajectory import read_trajectory
from boxplus.recordings.cameras.open import open_camera_recording
from boxplus.recordings.cameras.options import CameraRecordingOptions
from boxplus.report import write_report
from boxplus.report.cameras.visual_data import load_visual_run
from boxplus.runs.cameras.folder import VioFolder
from boxplus.runs.cameras.landmark_file import read_lines, write_lines
from boxplus.runs.direct.direct_run import run_direct_odometry
from boxplus.runs.settings_file import load_settings
from boxplus.runs.visual_inertial.config import VioRunConfig
from boxplus.runs.visual_inertial.frame_log import read_frame_log
from boxplus.runs.visual_inertial.rig_of_recording import rig_of_recording
from boxplus.runs.visual_inertial.summary import LengthFacts, VioSummary, read_vio_summary
from boxplus.runs.visual_inertial.visual_run import run_visual_odometry
from boxplus.sensors.images.camera_image import CameraImage
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation.cameras import as_camera_recording, make_camera_fault, make_rig, simulate_cameras, write_camera_recording
from boxplus.simulation.cameras.faults import CameraFault, covered_lens
from boxplus.systems.visual_inertial_odometry import VioConfig, VioEstimate
from boxplus.systems.visual_inertial_odometry.corners.carried import CARRIED
from boxplus.systems.visual_inertial_odometry.odometry import VisualInertialOdometry
from tests.report.unpacked import figures_of

pytestmark = pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="corners are followed with OpenCV")
SETTINGS = {"odometry": {"cell_size": 12, "features": 100}}
CONFIG = VioRunConfig.model_validate(SETTINGS)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A EuRoC folder, at rest for two seconds; beside it NAME.gt.tum."""
    simulation = simulate_cameras("room", 1, duration_s=3.2, rig=make_rig("stereo", None, 0.3, 15.0))
    return write_camera_recording(simulation, tmp_path_factory.mktemp("recorded") / "room", "euroc")


class Watcher:
    """A view that keeps what it is shown."""

    def __init__(self) -> None:
        self.seen: list[VioEstimate] = []

    def show(self, estimate: VioEstimate) -> None:
        self.seen.append(estimate)


@pytest.fixture(scope="module")
def watcher() -> Watcher:
    return Watcher()


@pytest.fixture(scope="module")
def finished(recorded: Path, tmp_path_factory: pytest.TempPathFactory, watcher: Watcher) -> tuple[VioFolder, VioSummary]:
    folder = VioFolder(tmp_path_factory.mktemp("run") / "out")
    with open_camera_recording(recorded) as recording:
        return folder, run_visual_odometry(recording, folder.path, CONFIG, view=watcher)


def test_a_view_is_shown_every_frame_as_it_is_written(finished: tuple[VioFolder, VioSummary], watcher: Watcher) -> None:
    folder, summary = finished
    assert [e.status for e in watcher.seen].count("starting") == summary.frames_before_start
    known = [e.time_ns for e in watcher.seen if e.status != "starting"]
    assert known == read_trajectory(folder.trajectory).time_ns.tolist()


@pytest.mark.slow
@pytest.mark.parametrize("rolling", [False, True])
def test_a_run_without_trouble_says_that_its_shutter_rolls(tmp_path: Path, rolling: bool) -> None:
    simulation = simulate_cameras("room_moving", 4, duration_s=7.5, rig=make_rig("stereo", None, 0.35, 10.0))
    fault = make_camera_fault("rolling_shutter") if rolling else None
    with as_camera_recording(simulation, fault) as recording:
        summary = run_visual_odometry(recording, tmp_path / "out", CONFIG)
    assert summary.contradiction is None
    said = [warning.text for warning in summary.warnings if "a rolling shutter is suspected" in warning.text]
    assert len(said) == rolling
    assert read_vio_summary(VioFolder(tmp_path / "out").summary).warnings == summary.warnings


def knowing_little(push: Callable[..., list[VioEstimate]], times: float) -> Callable[..., list[VioEstimate]]:
    """The same estimates, so many times as uncertain."""
    return lambda odometry, event: [replace(one, covariance=times**2 * one.covariance) for one in push(odometry, event)]


@pytest.mark.parametrize(("times", "of_use"), [(100.0, True), (1000.0, False)])
def test_positions_of_which_a_run_knows_little_are_told_and_those_of_no_use_are_not_to_be_trusted(
    recorded: Path,
    finished: tuple[VioFolder, VioSummary],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    times: float,
    of_use: bool,
) -> None:
    assert not any("own covariance" in warning.text for warning in finished[1].warnings)
    for name in ("push_image", "push_imu"):
        monkeypatch.setattr(VisualInertialOdometry, name, knowing_little(getattr(VisualInertialOdometry, name), times))
    with open_camera_recording(recorded) as recording:
        summary = run_visual_odometry(recording, tmp_path / "out", CONFIG)
    warned = [warning.text for warning in summary.warnings if "own covariance" in warning.text]
    assert (summary.contradiction is None) == of_use == bool(warned)
    (text,) = warned if of_use else [summary.contradiction or ""]
    assert re.search(r"knows some positions to \d.* c?m \(1 sigma\) only, of a way of \d+ cm", text)


def test_every_frame_with_a_state_has_a_row_everywhere(finished: tuple[VioFolder, VioSummary]) -> None:
    folder, summary = finished
    trajectory, frames = read_trajectory(folder.trajectory), read_frame_log(folder.frames)
    assert summary.state == "finished" and summary.contradiction is None
    assert summary.frames == len(trajectory) == len(frames) == sum(summary.status.values()) > 20
    assert summary.frames + summary.frames_before_start == summary.cameras[0].images
    assert np.array_equal(trajectory.time_ns, frames.time_ns) and (np.diff(frames.time_ns) > 0).all()
    assert trajectory.covariance is not None and np.linalg.eigvalsh(trajectory.covariance[-1])[0] > 0.0
    assert (frames.column("tracked") > 10).all() and (frames.column("sigma_bias_gyro") > 0.0).all()
    assert len(read_ply(folder.landmarks).points) == summary.landmarks > 30
    assert len((folder.path / "trajectory.tum").read_text().splitlines()) == summary.frames
    assert load_settings(VioRunConfig, folder.config).odometry == CONFIG.odometry
    assert read_vio_summary(folder.summary) == summary
    assert summary.start is not None and summary.start.kind == "at rest" and summary.start_facts


def test_the_trajectory_is_that_of_the_simulation(finished: tuple[VioFolder, VioSummary], recorded: Path) -> None:
    folder, summary = finished
    truth = read_trajectory(recorded.with_name("room.gt.tum"))
    evaluation = evaluate(read_trajectory(folder.trajectory), truth, alignment="yaw", method="interpolate")
    assert summary.path_length_m > 0.2 and evaluation.ate.rmse < 0.01


def test_what_the_imu_says_of_lengths_is_kept_and_said(finished: tuple[VioFolder, VioSummary]) -> None:
    folder, summary = finished
    assert summary.lengths is not None and read_vio_summary(folder.summary).lengths == summary.lengths
    assert "errors of less than 5.2% are not noticed" in LengthFacts(longer=0.027, sigma=0.013).text
    assert "errors of less than 2.0% are not noticed" in LengthFacts(longer=-0.001, sigma=0.004).text
    assert "a wrong baseline would not be noticed" in LengthFacts(longer=None, sigma=None).text


def test_lengths_that_nothing_tells_are_not_said_to_agree(finished: tuple[VioFolder, VioSummary]) -> None:
    """A run of three seconds has too few segments: no share of zero, which would read as lengths that agree."""
    folder, summary = finished
    assert summary.lengths is not None and summary.lengths.longer is None and summary.lengths.sigma is None
    assert json.loads(folder.summary.read_text())["lengths"] == {"longer": None, "sigma": None}


def test_the_report_says_what_the_run_was(finished: tuple[VioFolder, VioSummary]) -> None:
    folder, summary = finished
    page = write_report(folder.path).read_text(encoding="utf-8")
    for text in ("Landmarks and trajectory", "Status and corners", "Biases", f"{summary.frames} frames", "cam1: Pinhole"):
        assert text in page
    assert {path.name for path in folder.plots.iterdir()} == {"trajectory.png", "tracked.png", "biases.png"}


def test_a_gap_of_the_imu_that_images_bridge_is_a_warning(
    recorded: Path, tmp_path: Path, finished: tuple[VioFolder, VioSummary]
) -> None:
    path = shutil.copytree(recorded, tmp_path / "room")
    (samples,) = path.glob("mav0/imu0/data.csv")
    head, *rows = samples.read_text().splitlines()
    first_ns = int(rows[0].split(",")[0])
    kept = [row for row in rows if not 2.5e9 < int(row.split(",")[0]) - first_ns < 2.75e9]
    samples.write_text("\n".join([head, *kept]) + "\n")
    with open_camera_recording(path) as recording:
        summary = run_visual_odometry(recording, tmp_path / "out", CONFIG)
    (warning,) = (one for one in summary.warnings if one.text.startswith("a gap of 0.2"))
    assert summary.contradiction is None and warning.count == 1
    assert warning.first_s == pytest.approx(2.5 - summary.frames_before_start / 15.0, abs=0.1)
    assert not any("a gap" in one.text for one in finished[1].warnings)


def test_images_that_come_again_in_motion_are_left_out_and_said(
    recorded: Path, tmp_path: Path, finished: tuple[VioFolder, VioSummary]
) -> None:
    path = shutil.copytree(recorded, tmp_path / "room")
    for folder in path.glob("mav0/cam*/data"):
        images = sorted(folder.iterdir())
        stamps = np.array([int(image.stem) for image in images]) - int(images[0].stem)
        first, last = np.searchsorted(stamps, [2_600_000_000, 2_900_000_000])
        for image in images[first:last]:
            shutil.copy(images[first - 1], image)
    with open_camera_recording(path) as recording:
        summary = run_visual_odometry(recording, tmp_path / "out", CONFIG)
    (warning,) = (one for one in summary.warnings if "images again" in one.text)
    assert warning.count == 2 * (last - first) == 2 * (finished[1].frames - summary.frames)
    assert summary.contradiction is None and not any("images again" in one.text for one in finished[1].warnings)


def test_a_run_with_lines_says_so_and_is_as_good(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["vio", str(recorded), "-o", str(out), "--lines", "--no-report", "--set", "cell_size=12"])
    assert result.exit_code == 0, result.output
    folder, summary = VioFolder(out), read_vio_summary(out / "run.json")
    assert load_settings(VioRunConfig, folder.config).odometry.lines
    # The room has textures and hardly an edge: what is found of lines is in file and facts alike.
    assert summary.lines == (len(read_lines(folder.lines)) if folder.lines.exists() else 0)
    assert summary.rejected["lines"]["looks different"] > 0 and (read_frame_log(folder.frames).column("lines_tracked") >= 0).all()
    truth = read_trajectory(recorded.with_name("room.gt.tum"))
    assert evaluate(read_trajectory(folder.trajectory), truth, alignment="yaw", method="interpolate").ate.rmse < 0.01


def test_lines_are_drawn_and_do_not_outlive_their_run(
    finished: tuple[VioFolder, VioSummary], recorded: Path, tmp_path: Path
) -> None:
    folder = VioFolder(tmp_path / "again")
    shutil.copytree(finished[0].path, folder.path)
    assert not any('"name": "lines"' in figure for figure in figures_of(write_report(folder.path).read_text(encoding="utf-8")))
    ends = np.random.default_rng(1).normal(size=(9, 6)).astype(np.float32)
    write_lines(folder.lines, ends)
    assert any('"name": "lines"' in figure for figure in figures_of(write_report(folder.path).read_text(encoding="utf-8")))
    assert np.allclose(load_visual_run(folder.path).map_lines, ends, atol=1e-4)
    with open_camera_recording(recorded) as recording:
        run_visual_odometry(recording, folder.path, CONFIG, overwrite=True, should_stop=lambda: True)
    assert not folder.lines.exists()


def test_a_damaged_file_of_lines_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "lines.csv"
    ends = np.arange(12.0, dtype=np.float32).reshape(2, 6)
    write_lines(path, ends)
    assert np.array_equal(read_lines(path), ends)
    for text in ("", "a,b\n", path.read_text().replace("11.0000", "eleven"), path.read_text()[:-12]):
        path.write_text(text)
        with pytest.raises(InputError, match="boxplus vio --lines"):
            read_lines(path)


def test_a_second_run_replaces_the_first_only_when_asked(
    finished: tuple[VioFolder, VioSummary], recorded: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "again"
    shutil.copytree(finished[0].path, folder)
    (folder / "notes.txt").write_text("mine")
    with open_camera_recording(recorded) as recording:
        with pytest.raises(InputError, match="the results of an earlier run"):
            run_visual_odometry(recording, folder, CONFIG)
        stopped = run_visual_odometry(recording, folder, CONFIG, overwrite=True, should_stop=lambda: True)
    assert stopped.state == "interrupted" and stopped.frames == 0
    assert {path.name for path in folder.iterdir()} >= {"notes.txt", "run.json"} and not (folder / "landmarks.ply").exists()


@pytest.mark.slow
def test_a_killed_run_leaves_everything_up_to_its_last_frame(recorded: Path, tmp_path: Path) -> None:
    folder = VioFolder(tmp_path / "killed")
    command = [sys.executable, "-c", "from boxplus.cli import main; main()", "vio", str(recorded), "-o", str(folder.path)]
    process = subprocess.Popen([*command, "--set", "cell_size=12"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        limit = time.monotonic() + 120.0
        while time.monotonic() < limit and process.poll() is None:
            if folder.trajectory.exists() and folder.trajectory.read_bytes().count(b"\n") > 4:
                break
            time.sleep(0.005)
        assert process.poll() is None, "the run ended before it could be killed"
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    summary = read_vio_summary(folder.summary)
    assert "ended without a word" in summary.describe_state()
    rows = len(read_trajectory(folder.trajectory))
    assert rows >= 4 and abs(len(read_frame_log(folder.frames)) - rows) <= 1
    assert "ended without a word" in write_report(folder.path).read_text(encoding="utf-8")


def test_what_is_not_calibrated_is_refused_with_the_way_out(recorded: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    shutil.copytree(recorded, bare)
    for file in bare.rglob("*.yaml"):
        file.unlink()
    with (
        open_camera_recording(bare) as recording,
        pytest.raises(InputError, match=r"intrinsics and the mounting .* no cam0: model .* --calibration camchain\.yaml"),
    ):
        rig_of_recording(recording.info, VioConfig())
    camchain = recorded.with_name("room.calib.yaml")
    with open_camera_recording(bare, CameraRecordingOptions(calibration=camchain)) as recording:
        if recording.info.imu is not None and recording.info.imu.noise is None:
            with pytest.raises(InputError, match=r"noise densities of the IMU .* --set gyro_noise=…"):
                rig_of_recording(recording.info, VioConfig())
        given = VioConfig(gyro_noise=1e-3, accel_noise=1e-2, gyro_bias_walk=1e-5, accel_bias_walk=1e-4)
        assert len(rig_of_recording(recording.info, given).cameras) == 2
        assert len(rig_of_recording(recording.info, given.model_copy(update={"cameras": "first"})).cameras) == 1


def test_no_start_in_the_whole_recording_is_an_error_with_its_number(tmp_path: Path) -> None:
    simulation = simulate_cameras("room", 1, duration_s=0.6, rig=make_rig("mono", None, 0.2, 15.0))
    with pytest.raises(InputError, match=r"and no start \(.*s of frames were seen \(1 are needed\)"):
        run_visual_odometry(as_camera_recording(simulation), tmp_path / "out", CONFIG)
    summary = read_vio_summary(tmp_path / "out" / "run.json")
    assert summary.state == "failed" and summary.start is None and summary.frames_before_start > 5


@pytest.mark.slow
@pytest.mark.parametrize("covered_s", [0.0, 5.0])
def test_frames_without_a_pose_are_told_where_the_start_comes_late(tmp_path: Path, covered_s: float) -> None:
    """Of 200 frames 114 had no pose, of which nothing but their number was said."""
    simulation = simulate_cameras("room_moving", 4, duration_s=7.5, rig=make_rig("stereo", None, 0.25, 8.0))
    with as_camera_recording(simulation, covered_lens(0, 0.0, covered_s)) as recording:
        summary = run_visual_odometry(recording, tmp_path / "out", CONFIG)
    said = [warning.text for warning in summary.warnings if "no pose" in warning.text]
    assert summary.frames > 0 and len(said) == (covered_s > 0.0)
    if said:
        late_s = ((summary.first_time_ns or 0) - simulation.stamp_ns(0)) * 1e-9
        begin = f"{summary.frames_before_start} of the {summary.cameras[0].images} frames that were read have no pose: no start "
        assert said[0].startswith(begin) and late_s > covered_s
        assert f"begin {late_s:.1f} s after the first frame; let a recording start at rest" in said[0]
        assert ". Just before: not at rest: " in said[0]


def test_images_that_are_not_of_the_stated_size_are_the_reason_of_a_run_without_a_frame(tmp_path: Path) -> None:
    simulation = simulate_cameras("room", 1, duration_s=0.6, rig=make_rig("mono", None, 0.2, 15.0))
    sensor = simulation.scenario.rig.cameras[0].sensor
    width, height = sensor.width, sensor.height

    def halved(events: Iterable[CameraImage | ImuSamples]) -> Iterator[CameraImage | ImuSamples]:
        for event in events:
            yield replace(event, pixels=event.pixels[::2, ::2]) if isinstance(event, CameraImage) else event

    fault = CameraFault("halved", "images of half the size", (), "inspect", events=halved)
    with pytest.raises(InputError, match=rf"no images .* × messages: image of cam0 \(.* has {width}x{height}\)"):
        run_visual_odometry(as_camera_recording(simulation, fault), tmp_path / "vio", CONFIG)
    with pytest.raises(InputError, match=rf"none \(.* × messages: image of cam0 \(.* has {width}x{height}\)"):
        run_direct_odometry(as_camera_recording(simulation, fault), tmp_path / "vo")


@pytest.mark.slow
def test_a_part_of_the_platform_in_view_is_left_out_and_told(tmp_path: Path) -> None:
    simulation = simulate_cameras("room_moving", 4, duration_s=6.0, rig=make_rig("stereo", None, 0.35, 15.0))
    height = simulation.scenario.rig.cameras[0].sensor.height
    arm = np.random.default_rng(0).integers(40, 220, (height, 400), np.uint8).repeat(3, axis=0).repeat(3, axis=1)

    def with_arm(events: Iterable[CameraImage | ImuSamples]) -> Iterator[CameraImage | ImuSamples]:
        for event in events:
            if isinstance(event, CameraImage):
                pixels = event.pixels.copy()
                pixels[2 * height // 3 :] = arm[: height - 2 * height // 3, : pixels.shape[1]]
                event = replace(event, pixels=pixels)
            yield event

    fault = CameraFault("arm", "an arm fills a third of the view", (), "estimator", events=with_arm)
    summary = run_visual_odometry(as_camera_recording(simulation, fault), tmp_path / "out")
    (said,) = [warning.text for warning in summary.warnings if "part of the platform in view" in warning.text]
    assert "left out" in said and summary.rejected["corners"][CARRIED] >= 10
    assert summary.contradiction is None and summary.status.get("ok", 0) > 30
    sound = run_visual_odometry(as_camera_recording(simulation), tmp_path / "sound")
    assert CARRIED not in sound.rejected["corners"] and not any("platform" in warning.text for warning in sound.warnings)


def test_the_command_compares_with_the_truth_and_says_how_it_ended(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    truth = recorded.with_name("room.gt.tum")
    arguments = ["vio", str(recorded), "-o", str(out), "--gt", str(truth), "--set", "cell_size=12", "--mono", "--json"]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert "frames" in done.stderr and "at rest" in done.stderr and "yaw alignment" in " ".join(done.stderr.split())
    found, evaluation = json.loads(done.stdout), json.loads((out / "evaluation.json").read_text())
    assert found["evaluation"] == evaluation and evaluation["alignment"]["kind"] == "yaw"
    assert found["run"] == json.loads((out / "run.json").read_text()) and found["outcome"] == "finished"
    assert len(read_vio_summary(out / "run.json").cameras) == 1
    assert "ATE" in (out / "report.html").read_text(encoding="utf-8")
    assert CliRunner().invoke(app, ["report", str(out)]).exit_code == 0
    refused = CliRunner().invoke(app, arguments)
    assert refused.exit_code == 2
    unknown = CliRunner().invoke(app, [*arguments, "--overwrite", "--set", "featurs=3"])
    assert unknown.exit_code == 2


@pytest.mark.slow
def test_cameras_that_are_swapped_end_with_exit_code_3(tmp_path: Path) -> None:
    simulation = simulate_cameras("room", 2, duration_s=5.5, rig=make_rig("stereo", None, 0.3, 10.0))
    swapped = write_camera_recording(simulation, tmp_path / "swapped", "euroc", make_camera_fault("swapped_cameras"))
    out = tmp_path / "out"
    (tmp_path / "other.tum").write_text("".join(f"{k} {k} 0 0 0 0 0 1\n" for k in range(20)))
    arguments = ["vio", str(swapped), "-o", str(out), "--no-report", "--set", "cell_size=12", "--quiet"]
    done = CliRunner().invoke(app, [*arguments, "--gt", str(tmp_path / "other.tum")])
    assert done.exit_code == 3, done.output  # of the run, before that of a ground truth that does not fit
    assert done.stdout == "" and "not to be trusted: " in done.stderr and "error: expected" in done.stderr
    contradiction = read_vio_summary(out / "run.json").contradiction
    assert contradiction is not None and "which camera is which" in contradiction
    said = " ".join(warning.text for warning in read_vio_summary(out / "run.json").warnings)
    assert "this may be the cause" in said and "the cameras are swapped" in said
