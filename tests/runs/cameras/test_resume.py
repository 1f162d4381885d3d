"""Runs with cameras that are interrupted go on from their checkpoint: the same rows to the bit, each once."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.formats.clouds.ply import read_ply
from boxplus.formats.trajectory import read_trajectory
from boxplus.recordings.cameras.open import open_camera_recording
from boxplus.runs.direct.config import DirectRunConfig
from boxplus.runs.direct.direct_run import run_direct_odometry
from boxplus.runs.visual_inertial.config import VioRunConfig
from boxplus.runs.visual_inertial.visual_run import run_visual_odometry
from boxplus.simulation.cameras import make_rig, simulate_cameras, write_camera_recording

pytestmark = pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="corners are followed with OpenCV")
VIO = VioRunConfig.model_validate({"odometry": {"cell_size": 12, "features": 100}})
VO = DirectRunConfig.model_validate({"odometry": {"patches": 200}})
LINES = VioRunConfig.model_validate({"odometry": {"cell_size": 12, "features": 100, "lines": True}})
MONO = DirectRunConfig.model_validate({"odometry": {"patches": 200}, "streams": {"mono": True}})
Runner = Callable[..., Any]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """At rest for two seconds."""
    simulation = simulate_cameras("room", 1, duration_s=3.2, rig=make_rig("stereo", None, 0.3, 10.0))
    return write_camera_recording(simulation, tmp_path_factory.mktemp("recorded") / "room", "euroc")


def run(runner: Runner, config: Any, recorded: Path, folder: Path, events: int | None = None, *, resume: bool = False) -> Any:
    """All of a recording, or so many events of it."""
    asked = iter(range(10**6))
    with open_camera_recording(recorded) as recording:
        return runner(recording, folder, config, resume=resume, should_stop=lambda: events is not None and next(asked) >= events)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("runner", "config", "stops"),
    [
        (run_visual_odometry, VIO, (15, 50)),  # before the start was found, and after it
        (run_visual_odometry, LINES, (75,)),
        (run_direct_odometry, VO, (60,)),
        (run_direct_odometry, MONO, (72, 17)),  # while the first two views are looked for, and from them on
    ],
)
def test_an_interrupted_run_goes_on(runner: Runner, config: Any, stops: tuple[int, ...], recorded: Path, tmp_path: Path) -> None:
    whole, out = tmp_path / "whole", tmp_path / "out"
    expected = run(runner, config, recorded, whole)
    assert expected.state == "finished" and not (whole / "checkpoint.npz").exists()
    for number, events in enumerate(stops):
        stopped = run(runner, config, recorded, out, events, resume=number > 0)
        assert stopped.state == "interrupted" and (out / "checkpoint.npz").is_file()
    found = run(runner, config, recorded, out, resume=True)
    assert found.state == "finished" and found.resumed == len(stops) and not (out / "checkpoint.npz").exists()
    resumed, straight = read_trajectory(out / "trajectory.csv"), read_trajectory(whole / "trajectory.csv")
    assert len(straight) > 1
    for name in ("time_ns", "p", "q_wxyz", "covariance", "status"):
        assert np.array_equal(getattr(resumed, name), getattr(straight, name)), name
    assert np.array_equal(read_ply(out / "landmarks.ply").points, read_ply(whole / "landmarks.ply").points)
    assert len((out / "frames.csv").read_text().splitlines()) == len(straight) + 1
    for name in ("frames", "keyframes", "frames_before_start", "status", "rejected", "warnings", "first_time_ns", "last_time_ns"):
        assert getattr(found, name) == getattr(expected, name), name


def test_rows_after_the_checkpoint_are_written_once(recorded: Path, tmp_path: Path) -> None:
    """The checkpoint is seconds old when a process is killed, and the last row may be cut."""
    whole, out = tmp_path / "whole", tmp_path / "out"
    run(run_visual_odometry, VIO, recorded, whole)
    run(run_visual_odometry, VIO, recorded, out, 75)
    early = (out / "checkpoint.npz").read_bytes()
    run(run_visual_odometry, VIO, recorded, out, 6, resume=True)
    (out / "checkpoint.npz").write_bytes(early)
    with (out / "trajectory.csv").open("a") as file:
        file.write("123,ok,0.")
    run(run_visual_odometry, VIO, recorded, out, resume=True)
    for name in ("trajectory.csv", "trajectory.tum", "trajectory.kitti.txt"):
        assert (out / name).read_bytes() == (whole / name).read_bytes()


def test_what_cannot_go_on_is_refused(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(InputError, match="with a checkpoint"):
        run(run_visual_odometry, VIO, recorded, out, resume=True)
    run(run_visual_odometry, VIO, recorded, out, 20)
    other = VioRunConfig.model_validate({"odometry": {"cell_size": 12, "features": 90}})
    with pytest.raises(InputError, match="features: 100"):
        run(run_visual_odometry, other, recorded, out, resume=True)
