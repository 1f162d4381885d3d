"""`slam --resume` where an earlier run left no checkpoint: begun anew, unless anything of a finished odometry stands."""

from __future__ import annotations

import json
from contextlib import nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.errors import InputError
from boxplus.formats.trajectory_writer import TrajectoryWriter
from boxplus.runs.lidar_inertial.summary import ExtrinsicFacts, RecordingFacts, RunSummary
from boxplus.runs.run_facts import State
from boxplus.runs.slam.config import dump_slam_config, load_slam_config
from boxplus.runs.slam.folder import SlamFolder, claim_slam_folder
from boxplus.runs.slam.slam_run import run_slam
from boxplus.runs.slam.summary import SlamSummary, read_slam_summary
from boxplus.simulation import SpinningLidar, simulate
from boxplus.simulation.live_recording import as_recording

WALK = simulate("walk", duration_s=3.0, lidar=SpinningLidar(azimuth_steps=100))
NOW = datetime.now(UTC)
STATES: tuple[State, ...] = ("running", "failed")


def left_by(path: Path, state: State, odometry: State | None, rows: int = 5) -> SlamFolder:
    """What a run without a checkpoint leaves, as far as it came."""
    folder = SlamFolder(path)
    folder.odometry.path.mkdir(parents=True)
    folder.config.write_text(dump_slam_config(load_slam_config()), encoding="utf-8")
    SlamSummary(versions={}, state=state, started=NOW, updated=NOW, recording="walk.bag").write(folder.summary)
    if odometry is not None:
        facts = RecordingFacts(path="", format="", lidar_topic="", imu_topic="imu", duration_s=1.0, messages=1)
        extrinsic = ExtrinsicFacts(source="given", text="", estimation="", T_imu_lidar_start=np.eye(4).tolist())
        RunSummary(versions={}, state=odometry, process=1, started=NOW, updated=NOW, recording=facts, extrinsic=extrinsic).write(
            folder.odometry.summary
        )
    with TrajectoryWriter(folder.odometry.path) as writer:
        for k in range(rows):
            writer.append(100_000_000 * (k + 1), np.eye(3), np.zeros(3), np.eye(6), "ok")
    return folder


def content(folder: SlamFolder) -> dict[str, bytes]:
    return {path.relative_to(folder.path).as_posix(): path.read_bytes() for path in folder.path.rglob("*") if path.is_file()}


def resumed(folder: SlamFolder, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr("boxplus.recordings.open_recording", lambda *_: nullcontext(as_recording(WALK)))
    monkeypatch.setattr("boxplus.cli.terminal.interrupt.stop_on_interrupt", lambda _: nullcontext(lambda: True))
    words = ["slam", "walk.bag", "-o", str(folder.path), "--T-imu-lidar", "xyz: 0 0 0", "--json", "--resume"]
    return CliRunner().invoke(app, words)


@pytest.mark.slow
@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize(("odometry", "rows"), [("running", 5), ("failed", 5), ("running", 0), (None, 0)])
def test_a_run_that_was_killed_before_its_first_checkpoint_begins_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, state: State, odometry: State | None, rows: int
) -> None:
    folder = left_by(tmp_path / "out", state, odometry, rows)
    called = resumed(folder, monkeypatch)
    assert called.exit_code == 130 and json.loads(called.stdout)["outcome"] == "interrupted", called.stderr
    assert "out: stopped before its first checkpoint: the run begins anew" in called.stderr
    assert not folder.odometry.holds_estimates() and folder.odometry.checkpoint.is_file()
    summary = read_slam_summary(folder.summary)
    assert (summary.state, summary.resumed) == ("interrupted", 0)


def test_from_python_it_begins_anew_as_well(tmp_path: Path) -> None:
    folder = left_by(tmp_path / "out", "running", "running")
    result = run_slam(as_recording(WALK), folder.path, load_slam_config(), resume=True, should_stop=lambda: True)
    assert (result.summary.state, result.summary.resumed, result.summary.scans) == ("interrupted", 0, 0)
    assert not folder.odometry.holds_estimates()


def cut_in_half(text: str) -> str:
    return text[: len(text) // 2]


def of_another_version(text: str) -> str:
    return text.replace("{", '{"field_of_tomorrow": 1,', 1)


def of_another_command(text: str) -> str:
    return text.replace("boxplus lio", "boxplus vio")


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (cut_in_half, r"run\.json as this version .* – got the file: .*odometry.run\.json.* – put the file .* --overwrite"),
        (of_another_version, r"run\.json as this version .* – got field_of_tomorrow: .*odometry.run\.json.* --overwrite"),
        (of_another_command, "with a checkpoint in odometry/ – got none"),
        (None, "with a checkpoint in odometry/ – got none"),
    ],
)
def test_a_finished_odometry_stays_whatever_its_summary_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, state: State, damage: Any, said: str
) -> None:
    folder = left_by(tmp_path / "out", state, "finished")
    file = folder.odometry.summary
    if damage is None:
        file.unlink()
    else:
        file.write_text(damage(file.read_text(encoding="utf-8")), encoding="utf-8")
    before = content(folder)
    with pytest.raises(InputError, match=said):
        run_slam(as_recording(WALK), folder.path, load_slam_config(), resume=True)
    called = resumed(folder, monkeypatch)
    assert called.exit_code == 2 and "begins anew" not in called.stderr, called.stderr
    assert content(folder) == before


def test_results_of_a_run_that_was_interrupted_in_good_order_stay(tmp_path: Path) -> None:
    folder = left_by(tmp_path / "out", "interrupted", "interrupted")  # whose checkpoint somebody removed
    before = content(folder)
    with (
        pytest.raises(InputError, match="with a checkpoint in odometry/ – got none"),
        claim_slam_folder(folder.path, resume=True),
    ):
        pass
    assert content(folder) == before


def test_an_odometry_that_ends_while_the_folder_is_claimed_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = left_by(tmp_path / "out", "running", "finished")
    before, asked = content(folder), iter([True, False])
    monkeypatch.setattr(SlamFolder, "stopped_before_its_first_checkpoint", lambda _: next(asked))
    with pytest.raises(InputError, match="the results of an earlier run"), claim_slam_folder(folder.path, resume=True):
        pass
    assert content(folder) == before
