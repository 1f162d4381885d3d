"""`boxplus vo` over a folder that is written here: files, verdicts, exit codes; and which images make a frame."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from boxplus.cameras.wide_angle import Equidistant
from boxplus.cli import app
from boxplus.errors import InputError, RecordingError
from boxplus.formats.clouds.ply import read_ply
from boxplus.formats.trajectory import read_trajectory
from boxplus.recordings.cameras.info import CameraRecordingInfo, CameraStream
from boxplus.recordings.cameras.open import open_camera_recording
from boxplus.report import write_report
from boxplus.runs.direct.config import DirectRunConfig
from boxplus.runs.direct.direct_run import run_direct_odometry
from boxplus.runs.direct.frame_log import read_frame_log
from boxplus.runs.direct.frame_pairs import FramePairs, choose_cameras
from boxplus.runs.direct.summary import read_direct_summary
from boxplus.runs.settings_file import load_settings
from boxplus.sensors.images.camera_image import CameraImage
from boxplus.simulation.cameras import as_camera_recording, make_camera_fault, make_rig, simulate_cameras, write_camera_recording
from tests.report.unpacked import figures_of
from tests.systems.direct_odometry.scenes import CAMERA, SHAPE, Room, drive, errors

pytest.importorskip("cv2")
STEREO = np.eye(4)
STEREO[0, 3] = 0.1


def tum_folder(path: Path, frames: int = 6, covered_from: int | None = None) -> Path:
    """A TUM RGB-D folder of a rendered room at 10 Hz; from some frame on the lens is covered."""
    import cv2

    seen, rng = drive(60, frames), np.random.default_rng(0)
    for name in ("rgb", "depth"):
        (path / name).mkdir(parents=True)
    lists: dict[str, list[str]] = {"rgb": ["# time file"], "depth": ["# time file"]}
    truth = []
    for k in range(frames):
        t = f"{100.0 + 0.1 * k:.6f}"
        dark = covered_from is not None and k >= covered_from
        grey = np.rint(rng.normal(5.0, 2.0, SHAPE)).clip(0, 255) if dark else seen.grey[k]
        cv2.imwrite(str(path / "rgb" / f"{t}.png"), grey.astype(np.uint8))
        cv2.imwrite(str(path / "depth" / f"{t}.png"), np.rint(5000.0 * seen.depth[k]).astype(np.uint16))
        for name in lists:
            lists[name].append(f"{t} {name}/{t}.png")
        q, p = seen.T[k, :4], seen.T[k, 4:]
        truth.append(f"{t} {p[0]} {p[1]} {p[2]} {q[1]} {q[2]} {q[3]} {q[0]}")
    for name, lines in lists.items():
        (path / f"{name}.txt").write_text("\n".join(lines) + "\n")
    (path / "groundtruth.txt").write_text("\n".join(truth) + "\n")
    head = "# fx fy cx cy width height depth_factor"
    (path / "intrinsics.txt").write_text(f"{head}\n{CAMERA.fx} {CAMERA.fy} {CAMERA.cx} {CAMERA.cy} 160 120 5000\n")
    return path


def run(*words: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["vo", *words])
    return result.exit_code, result.output


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tum_folder(tmp_path_factory.mktemp("recorded") / "room", 12)


def test_a_run_writes_what_it_found(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    code, text = run(str(recorded), "-o", str(out), "--set", "patches=100", "--gt", str(recorded / "groundtruth.txt"))
    assert code == 0, text
    summary = read_direct_summary(out / "run.json")
    assert summary.state == "finished" and summary.contradiction is None and summary.status == {"ok": 12}
    assert [(camera.name, camera.use, camera.images) for camera in summary.cameras] == [
        ("rgb", "image", 12),
        ("depth", "depth", 12),
    ]
    found, frames = read_trajectory(out / "trajectory.csv"), read_frame_log(out / "frames.csv")
    degrees, metres = errors(np.concatenate([found.q_wxyz[-1], found.p[-1]]), drive(60, 12).T[-1])
    assert degrees < 0.5 and metres < 0.03
    assert summary.frames == len(found) == len(frames) == 12
    assert np.array_equal(found.time_ns, frames.time_ns) and (frames.status == "ok").all()
    assert frames.column("is_keyframe").sum() == summary.keyframes > 0
    ms = summary.timing.frame_ms
    assert ms is not None and ms.mean == pytest.approx(frames.column("total_ms").mean())
    assert json.loads((out / "evaluation.json").read_text())["alignment"]["kind"] == "se3"
    assert load_settings(DirectRunConfig, out / "config.yaml").odometry.patches == 100
    page = (out / "report.html").read_text(encoding="utf-8")
    assert any('"ahead [m]"' in figure and '"up [m]"' in figure for figure in figures_of(page))  # upright
    for shown in ("Status and residuals", "Landmarks and trajectory", "12 frames", "image: rgb, Pinhole", "ATE"):
        assert shown in page
    assert {path.name for path in (out / "plots").iterdir()} == {"trajectory.png", "residuals.png"}
    assert "12 ok" in text and "SE(3) alignment" in " ".join(text.split())
    again = CliRunner().invoke(app, ["vo", str(recorded), "-o", str(out), "--json"])
    assert again.exit_code == 2 and "--overwrite" in again.stderr and json.loads(again.stdout)["exit_code"] == 2
    assert CliRunner().invoke(app, ["report", str(out)]).exit_code == 0


def test_the_sparse_map_lies_on_the_walls(recorded: Path, tmp_path: Path) -> None:
    with open_camera_recording(recorded) as recording:
        config = DirectRunConfig.model_validate({"odometry": {"window": 2, "keyframe_flow": 0.004}})
        recording.info.cameras[0] = replace(recording.info.cameras[0], line_delay_s=1e-4)
        summary = run_direct_odometry(recording, tmp_path / "out", config)
    assert "line_delay states a rolling shutter" in summary.warnings[0].text
    points, room = read_ply(tmp_path / "out" / "landmarks.ply").points, Room(60)
    assert summary.keyframes > 4  # most of them have left the window
    assert len(points) == summary.landmarks > 100 * summary.keyframes
    off = np.minimum(np.abs(points - room.low), np.abs(points - room.high)).min(axis=1)
    assert np.median(off) < 0.01
    assert np.percentile(off, 95) < 0.05


def test_settings_of_a_run_repeat_it(recorded: Path, tmp_path: Path) -> None:
    first, again = tmp_path / "first", tmp_path / "again"
    assert run(str(recorded), "-o", str(first), "--set", "patches=100", "--no-report", "--duration", "0.45")[0] == 0
    assert run(str(recorded), "-o", str(again), "--config", str(first / "config.yaml"), "--no-report")[0] == 0
    assert (first / "trajectory.csv").read_bytes() == (again / "trajectory.csv").read_bytes()
    assert len(read_trajectory(first / "trajectory.csv")) == 5


def test_a_run_that_is_asked_to_stop_keeps_what_it_has(recorded: Path, tmp_path: Path) -> None:
    asked = iter([False] * 9 + [True])
    with open_camera_recording(recorded) as recording:
        summary = run_direct_odometry(recording, tmp_path / "out", should_stop=lambda: next(asked))
        assert summary.state == "interrupted" and 0 < summary.frames < 6
        with pytest.raises(InputError, match="the results of an earlier run"):
            run_direct_odometry(recording, tmp_path / "out")
    assert len(read_trajectory(tmp_path / "out" / "trajectory.csv")) == summary.frames
    assert "interrupted" in write_report(tmp_path / "out").read_text(encoding="utf-8")


def test_a_killed_run_leaves_everything_up_to_its_last_frame(recorded: Path, tmp_path: Path) -> None:
    folder = tmp_path / "killed"
    program = (
        "import os, signal\n"
        "from boxplus.recordings.cameras.open import open_camera_recording\n"
        "from boxplus.runs.direct.direct_run import run_direct_odometry\n"
        "def killed(progress):\n"
        "    if progress.count == 7:\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        f"with open_camera_recording({str(recorded)!r}) as recording:\n"
        f"    run_direct_odometry(recording, {str(folder)!r}, progress=killed)\n"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == -signal.SIGKILL
    summary = read_direct_summary(folder / "run.json")
    assert "ended without a word" in summary.describe_state()
    assert len(read_trajectory(folder / "trajectory.csv")) == len(read_frame_log(folder / "frames.csv")) == 7
    assert "ended without a word" in write_report(folder).read_text(encoding="utf-8")


def test_a_run_that_lost_its_view_is_not_to_be_trusted(tmp_path: Path) -> None:
    recording, out = tum_folder(tmp_path / "room", covered_from=4), tmp_path / "out"
    code, text = run(str(recording), "-o", str(out), "--no-report")
    assert code == 3, text
    assert "not to be trusted" in text
    assert json.loads((out / "run.json").read_text())["status"] == {"ok": 4, "lost": 2}


def test_depths_in_another_unit_are_refused(tmp_path: Path) -> None:
    recording = tum_folder(tmp_path / "room", 2)
    stated = recording / "intrinsics.txt"
    stated.write_text(stated.read_text().replace(" 5000\n", " 5\n"))  # a thousandth
    code, text = run(str(recording), "-o", str(tmp_path / "out"))
    assert code == 2
    assert "check the unit of the depth" in " ".join(text.split())
    assert json.loads((tmp_path / "out" / "run.json").read_text())["state"] == "failed"


@pytest.mark.parametrize("words", [["--set", "patch=3"], ["--set", "patches"], ["--set", "window=1"]])
def test_wrong_settings_are_refused(tmp_path: Path, words: list[str]) -> None:
    code, text = run(str(tmp_path), "-o", str(tmp_path / "out"), *words)
    assert code == 2
    assert words[1].partition("=")[0] in text


def test_one_camera_says_that_the_scale_is_not_known(tmp_path: Path) -> None:
    simulation = simulate_cameras("room_moving", 1, duration_s=1.6, rig=make_rig("mono", None, 0.4, 20.0))
    recording = write_camera_recording(simulation, tmp_path / "room", "tum", images="pgm")
    out = tmp_path / "out"
    code, text = run(str(recording), "-o", str(out), "--gt", str(recording / "groundtruth.txt"))
    assert code == 0, text
    summary = read_direct_summary(out / "run.json")
    assert (summary.kind, summary.scale) == ("mono", "unknown")
    assert summary.frames_before_start > 0 and "pixels" in summary.start_problem
    assert summary.frames + summary.frames_before_start == summary.cameras[0].images
    assert json.loads((out / "evaluation.json").read_text())["alignment"]["kind"] == "sim3"
    words = " ".join(text.split())
    assert "units of unknown scale" in words and "one camera alone does not tell the scale" in words
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "scale: lengths in units of about" in page and "rotation and scale aligned" in page


def test_one_camera_that_only_sees_its_first_frames_is_refused_with_the_reason(recorded: Path, tmp_path: Path) -> None:
    code, text = run(str(recorded), "-o", str(tmp_path / "out"), "--mono", "--duration", "0.25")
    words = " ".join(text.split())
    assert code == 2
    assert "two views of one camera" in words and "of which a rotation leaves" in words
    assert json.loads((tmp_path / "out" / "run.json").read_text())["frames_before_start"] == 3


@pytest.mark.slow
def test_a_stereo_run_that_is_not_to_be_trusted_says_what_may_be_the_cause(tmp_path: Path) -> None:
    simulation = simulate_cameras("room_moving", 1, duration_s=2.5, rig=make_rig("stereo", "pinhole", 0.35, 10.0))
    swapped = as_camera_recording(simulation, make_camera_fault("swapped_cameras"))
    summary = run_direct_odometry(swapped, tmp_path / "swapped")
    assert summary.contradiction is not None
    assert any(w.text.startswith("this may be the cause") and "swapped" in w.text for w in summary.warnings)
    sound = run_direct_odometry(as_camera_recording(simulation), tmp_path / "sound")
    assert sound.contradiction is None and not any("may be the cause" in warning.text for warning in sound.warnings)


def stream(index: int, name: str, kind: str = "intensity", **other: object) -> CameraStream:
    unit = 0.001 if kind == "depth" else None
    made = CameraStream(index, name, kind, name, "", 160, 120, 10, 10.0, unit, CAMERA, np.eye(4), None)  # type: ignore[arg-type]
    return replace(made, **other)  # type: ignore[arg-type]


def info(*cameras: CameraStream) -> CameraRecordingInfo:
    return CameraRecordingInfo(Path("x"), "test", [], 1.0, 10, list(cameras), None)


def test_cameras_are_chosen_or_refused() -> None:
    one, depth = stream(0, "rgb"), stream(1, "depth", "depth")
    assert choose_cameras(info(one, depth)).kind == "rgbd"
    pair = choose_cameras(info(one, stream(1, "right", T_body_camera=STEREO)))
    assert pair.kind == "stereo"
    assert pair.stereo is not None
    np.testing.assert_allclose(np.asarray(pair.stereo.T_right_left)[4:], [-0.1, 0.0, 0.0])
    assert choose_cameras(info(one)).kind == choose_cameras(info(one, depth), mono=True).kind == "mono"
    with pytest.raises(RecordingError, match=r"depth alone has no grey values.*as mono16"):
        choose_cameras(info(depth))
    with pytest.raises(RecordingError, match="register the depth to the images"):
        choose_cameras(info(one, replace(depth, width=320, height=240)))
    with pytest.raises(RecordingError, match="depths that are registered"):
        choose_cameras(info(one, replace(depth, T_body_camera=STEREO)))
    with pytest.raises(RecordingError, match="undistort the images"):
        choose_cameras(info(replace(one, model=Equidistant(100.0, 100.0, 80.0, 60.0, 0.0, 0.0, 0.0, 0.0)), depth))


def test_frames_are_the_closest_images() -> None:
    cameras = choose_cameras(info(stream(0, "rgb"), stream(1, "depth", "depth")))
    grey, depth = np.zeros(SHAPE, np.uint8), np.ones(SHAPE, np.uint16)
    stamps = [(0, 0), (1, 10), (0, 100), (1, 130), (1, 195), (0, 200), (0, 300), (0, 400), (1, 410)]  # camera, ms
    events = [
        CameraImage(camera, "x", ms * 1_000_000, depth if camera else grey, depth_unit_m=0.001 if camera else None)
        for camera, ms in stamps
    ]
    pairs = FramePairs(cameras)
    frames = [pair for event in events for pair in pairs.push(event)] + pairs.flush()
    found = [(a.time_ns // 1_000_000, b.time_ns // 1_000_000) for a, b in frames]
    assert found == [(0, 10), (100, 130), (200, 195), (400, 410)]
    assert dict(pairs.rejected) == {"images of rgb without one of depth": 1}
