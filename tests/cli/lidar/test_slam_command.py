"""`boxplus slam` as a user calls it."""

from __future__ import annotations

import os
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import boxplus.recordings
import boxplus.runs.slam.slam_run
from boxplus.cli import app
from boxplus.cli.lidar.slam import _compared
from boxplus.errors import InputError
from boxplus.formats.trajectory import Trajectory
from boxplus.formats.trajectory_writer import TrajectoryWriter
from boxplus.runs.slam.folder import SlamFolder


@pytest.mark.parametrize(
    ("words", "threads"),
    [([], 3), (["--threads", "1"], 1), (["--set", "odometry.threads=4"], 4), (None, min(2, os.cpu_count() or 1))],
)
def test_threads_are_those_of_the_file_unless_an_option_says_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str] | None, threads: int
) -> None:
    used: list[Any] = []

    def run_slam(recording: object, folder: object, config: Any, **options: object) -> None:
        used.append(config.odometry.threads)
        assert config.scans.frame == "world"
        raise InputError("a run", "enough of it", "stop")

    info = SimpleNamespace(path=Path("walk.bag"), format="ros1", duration_s=1.0, message_count=1, evidence=[], imu_topic="")
    monkeypatch.setattr(boxplus.recordings, "open_recording", lambda *_: nullcontext(SimpleNamespace(info=info)))
    monkeypatch.setattr(boxplus.runs.slam.slam_run, "run_slam", run_slam)
    (tmp_path / "settings.yaml").write_text("odometry: {threads: 3}\n")
    given = [] if words is None else ["--config", str(tmp_path / "settings.yaml"), *words]
    result = CliRunner().invoke(app, ["slam", "walk.bag", "-o", str(tmp_path / "out"), "--save-scans", "world", *given])
    assert result.exit_code == 2 and "enough of it" in result.stderr
    assert used == [threads]


def test_a_ground_truth_is_compared_with_the_odometry_and_with_loops_closed(tmp_path: Path) -> None:
    random, folder = np.random.default_rng(3), SlamFolder(tmp_path)
    times = np.arange(50) * 100_000_000
    p = np.cumsum(random.normal(0.0, 0.5, (50, 3)), axis=0)
    truth = Trajectory(times, p, np.tile([1.0, 0.0, 0.0, 0.0], (50, 1)))
    for run, sigma in ((folder.odometry, 0.3), (folder, 0.01)):
        run.path.mkdir(exist_ok=True)
        with TrajectoryWriter(run.path) as writer:
            for k, time in enumerate(times.tolist()):
                writer.append(time, np.eye(3), p[k] + random.normal(0.0, sigma, 3), np.eye(6), "ok")
    result: Any = SimpleNamespace(folder=folder)
    odometry, corrected = _compared(result, truth)
    assert odometry.evaluation is not None and corrected.evaluation is not None
    before, after = (found["ate_translation_m"]["rmse"] for found in (odometry.evaluation, corrected.evaluation))
    assert 0.3 < before < 0.8 and 0.005 < after < 0.03, (before, after)
    assert set(folder.own_files()) >= {folder.evaluation, folder.odometry.evaluation}  # cleared by --overwrite


def test_a_ground_truth_that_cannot_be_used_is_refused_before_the_run(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["slam", "walk.bag", "-o", str(tmp_path / "out"), "--gt", str(tmp_path / "none.tum")])
    assert result.exit_code == 2 and "none.tum" in result.stderr and not (tmp_path / "out").exists()


@pytest.mark.parametrize("words", [["slam", "--T-imu-lidar", "xyz: 0 0 1"], ["localize", "--map", "nowhere"]])
@pytest.mark.parametrize("is_there", [False, True])
def test_a_run_that_is_refused_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], is_there: bool
) -> None:
    """Once an empty one with the lock of a run that never was."""
    info = SimpleNamespace(path=Path("walk.bag"), format="ros1", duration_s=1.0, message_count=1, evidence=[], imu_topic="")
    monkeypatch.setattr(boxplus.recordings, "open_recording", lambda *_: nullcontext(SimpleNamespace(info=info)))
    out = tmp_path / "out"
    if is_there:
        out.mkdir()
    result = CliRunner().invoke(app, [words[0], "walk.bag", "-o", str(out), *words[1:]])
    assert (result.exit_code == 2 and "settings of a LiDAR alone" in result.stderr) or "nothing at nowhere" in result.stderr
    assert list(tmp_path.rglob("*")) == [out] * is_there


@pytest.mark.parametrize("command", ["lio", "slam", "vio", "vo"])
@pytest.mark.parametrize("words", [["--overwrite", "--resume"], ["--resume", "--overwrite"]])
def test_an_earlier_run_is_replaced_or_gone_on_with(command: str, words: list[str], tmp_path: Path) -> None:
    result = CliRunner().invoke(app, [command, "walk.bag", "-o", str(tmp_path / "out"), *words])
    assert result.exit_code == 2 and "expected overwrite or resume – got both – to go on" in result.stderr
