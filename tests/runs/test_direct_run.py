"""`boxplus vo` over a folder that is written here: files, verdicts, exit codes; and which images make a frame."""

from __future__ import annotations

import csv
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from boxplus.cameras.wide_angle import Equidistant
from boxplus.cli import app
from boxplus.errors import RecordingError
from boxplus.formats.trajectory import read_trajectory
from boxplus.recordings.cameras.info import CameraRecordingInfo, CameraStream
from boxplus.runs.frame_pairs import choose_cameras, frame_pairs
from boxplus.sensors.camera_image import CameraImage
from tests.systems.direct_odometry.scenes import CAMERA, SHAPE, drive, errors

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


def test_a_run_writes_what_it_found(tmp_path: Path) -> None:
    recording, out = tum_folder(tmp_path / "room"), tmp_path / "out"
    code, text = run(str(recording), "-o", str(out), "--set", "patches=100")
    assert code == 0, text
    facts = json.loads((out / "run.json").read_text())
    assert facts["program"] == "boxplus vo"
    assert facts["state"] == "finished"
    assert facts["status"] == {"ok": 6}
    assert facts["cameras"] == ["rgb", "depth"]
    found = read_trajectory(out / "trajectory.csv")
    T = drive(60, 6).T[-1]
    degrees, metres = errors(np.concatenate([found.q_wxyz[-1], found.p[-1]]), T)
    assert degrees < 0.5
    assert metres < 0.03
    with (out / "frames.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["ok"] * 6
    assert "patches: 100" in (out / "config.yaml").read_text()
    assert "Direct odometry" in (out / "report.html").read_text()
    assert "6 ok" in text
    code, text = run(str(recording), "-o", str(out))
    assert code == 2
    assert "--overwrite" in text


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
    with pytest.raises(RecordingError, match="one camera alone"):
        choose_cameras(info(one))
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
    rejected: Counter[str] = Counter()
    found = [(a.time_ns // 1_000_000, b.time_ns // 1_000_000) for a, b in frame_pairs(events, cameras, rejected)]
    assert found == [(0, 10), (100, 130), (200, 195), (400, 410)]
    assert dict(rejected) == {"images of rgb without one of depth": 1}
