"""`boxplus lio` of several recordings: each comes out as it would alone, in the table and in the lines of `--json`."""

from __future__ import annotations

import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

import boxplus.report
import boxplus.runs.lidar_inertial.odometry_run as odometry_run
from boxplus.cli import app
from boxplus.runs.storage import state_codec
from boxplus.simulation import SpinningLidar, simulate
from boxplus.simulation.recording_writer import write_recording

FAST = ("--no-map", "--no-report", "--set", "scan_voxel=0.5")
NAMES = ("a", "b", "c")


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with three recordings, alike but for their names, and the ground truth beside it."""
    folder = tmp_path_factory.mktemp("bags")
    (folder / "in").mkdir()
    first = write_recording(simulate("walk", duration_s=3.0, lidar=SpinningLidar(azimuth_steps=100)), folder / "a", "ros1")
    for name in NAMES:
        shutil.copy(first, folder / "in" / f"{name}.bag")
    return folder


def call(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


def lines(result: Result) -> dict[str, dict[str, Any]]:
    found = [json.loads(line) for line in result.stdout.splitlines()]
    return {Path(entry["output"]).name: entry for entry in found}


def row(text: str, name: str) -> list[str]:
    return next(line.split() for line in text.splitlines() if line.startswith(f" {name} "))


def interrupt_at(monkeypatch: pytest.MonkeyPatch, number: int, signals: int = 1) -> None:
    """Ctrl-C after 15 scans of the run of this number."""
    begun = {"runs": 0, "scans": 0}
    run, keep = odometry_run.run_odometry, odometry_run._Run.keep

    def counted(*arguments: Any, **words: Any) -> Any:
        begun["runs"], begun["scans"] = begun["runs"] + 1, 0
        return run(*arguments, **words)

    def kept(self: Any, estimate: Any) -> None:
        keep(self, estimate)
        begun["scans"] += 1
        if begun["runs"] == number and begun["scans"] == 15:
            for _ in range(signals):
                os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(odometry_run, "run_odometry", counted)
    monkeypatch.setattr(odometry_run._Run, "keep", kept)


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="SIGINT is sent differently on Windows")
@pytest.mark.parametrize("signals", [1, 2])
def test_a_batch_that_was_stopped_goes_on_where_it_was(
    bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, signals: int
) -> None:
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        interrupt_at(patch, 2, signals)
        stopped = call("lio", bags / "in", "-o", out, *FAST, "--json")
    assert stopped.exit_code == 130
    found = lines(stopped)
    assert [found[name]["outcome"] for name in NAMES] == ["finished", "interrupted", "not begun"]
    assert [found[name]["exit_code"] for name in NAMES] == [0, 130, None]
    assert found["c"]["run"] is None and Path(found["c"]["input"]).name == "c.bag"
    assert row(stopped.stderr, "c")[1:3] == ["not", "begun"] and row(stopped.stderr, "b")[1] == "interrupted"
    before = (out / "a" / "trajectory.csv").stat().st_mtime_ns

    again = call("lio", bags / "in", "-o", out, *FAST, "--json", "--resume")
    assert again.exit_code == 0, again.stderr
    found = lines(again)
    assert [found[name]["outcome"] for name in NAMES] == ["finished"] * 3
    # A second Ctrl-C stops at once, before a checkpoint is written: there, it begins anew.
    assert [found[name]["run"]["resumed"] for name in NAMES] == [0, 2 - signals, 0]
    assert (out / "a" / "trajectory.csv").stat().st_mtime_ns == before
    assert "a: finished before" in again.stderr
    expected = (out / "a" / "trajectory.csv").read_bytes()
    assert all((out / name / "trajectory.csv").read_bytes() == expected for name in NAMES)


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="SIGINT is sent differently on Windows")
def test_ctrl_c_after_the_last_scan_of_one_leaves_the_next_one_alone(
    bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(boxplus.report, "write_report", lambda _: os.kill(os.getpid(), signal.SIGINT))
    fast = [word for word in FAST if word != "--no-report"]
    result = call("lio", bags / "in", "-o", tmp_path / "out", *fast, "--json")
    assert result.exit_code == 130
    found = lines(result)
    assert [entry["outcome"] for entry in found.values()] == ["interrupted", "not begun", "not begun"]
    assert found["a"]["error"] == "interrupted: the report was not drawn, all other results are there"
    assert found["a"]["run"]["state"] == "finished"
    monkeypatch.undo()
    again = call("lio", bags / "in", "-o", tmp_path / "out", *FAST, "--json", "--resume")
    assert again.exit_code == 0 and "a: finished before" in again.stderr


@pytest.mark.slow
def test_what_was_finished_with_other_settings_is_not_passed_off_as_these(bags: Path, tmp_path: Path) -> None:
    assert call("lio", bags / "in" / "a.bag", "-o", tmp_path / "a", *FAST).exit_code == 0
    result = call("lio", bags / "in", "-o", tmp_path, *FAST, "--resume", "--json", "--set", "map_cell=0.3")
    assert result.exit_code == 3
    found = lines(result)
    assert found["a"]["outcome"] == "failed" and "map_cell: 0.25" in found["a"]["error"] and "0.3" in found["a"]["error"]
    assert found["b"]["outcome"] == found["c"]["outcome"] == "finished"


def test_what_was_finished_before_a_setting_was_added_is_finished_still(bags: Path, tmp_path: Path) -> None:
    words = ("lio", bags / "in" / "a.bag", "-o", tmp_path / "a", *FAST, "--json", "--resume")
    first = call(*words)  # nothing stands there: it is begun
    assert first.exit_code == 0, first.stderr
    written, rows = tmp_path / "a" / "config.yaml", tmp_path / "a" / "trajectory.csv"
    before, text = rows.stat().st_mtime_ns, written.read_text()
    assert "  map_cell: 0.25\n" in text
    written.write_text(text.replace("  map_cell: 0.25\n", ""))
    again = call(*words)
    assert again.exit_code == 0 and "a: finished before" in again.stderr and rows.stat().st_mtime_ns == before
    assert lines(again)["a"]["run"] == lines(first)["a"]["run"]
    refused = call(*words, "--set", "map_cell=0.4")
    assert refused.exit_code == 2 and "map_cell: 0.25" in lines(refused)["a"]["error"]


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="SIGINT is sent differently on Windows")
@pytest.mark.parametrize("batch", [False, True])
def test_what_was_stopped_under_another_boxplus_begins_anew(
    bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, batch: bool
) -> None:
    with monkeypatch.context() as patch:
        interrupt_at(patch, 1)
        given = (bags / "in", "-o", tmp_path) if batch else (bags / "in" / "a.bag", "-o", tmp_path / "a")
        assert call("lio", *given, *FAST).exit_code == 130
    monkeypatch.setattr(state_codec, "_PROGRAM", "boxplus 9.9.9, code 0123")
    again = call("lio", *given, *FAST, "--json", "--resume")
    assert again.exit_code == 0, again.stderr
    assert "warning: a: its checkpoint is damaged or of another version of boxplus: the run begins anew" in again.stderr
    found = lines(again)["a"]
    assert found["outcome"] == "finished" and found["run"]["resumed"] == 0 and found["run"]["scans"] == 29


@pytest.mark.slow
def test_one_that_fails_as_nobody_foresaw_leaves_the_others_unharmed(
    bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = odometry_run.run_odometry

    def fails(recording: Any, *arguments: Any, **words: Any) -> Any:
        if recording.info.path.name == "b.bag":
            raise ZeroDivisionError("by nothing")
        return run(recording, *arguments, **words)

    monkeypatch.setattr(odometry_run, "run_odometry", fails)
    result = call("lio", bags / "in", "-o", tmp_path / "out", *FAST, "--json")
    assert result.exit_code == 3, result.stderr
    found = lines(result)
    assert [found[name]["outcome"] for name in NAMES] == ["finished", "failed", "finished"]
    log = tmp_path / "out" / "b.traceback.txt"
    assert found["b"]["error"] == f"ZeroDivisionError: by nothing (an error of boxplus: {log} says where)"
    assert "raise ZeroDivisionError" in log.read_text()
    assert row(result.stderr, "b")[1] == "failed" and f"failed: b: {found['b']['error']}" in result.stderr
    monkeypatch.undo()
    assert call("lio", bags / "in", "-o", tmp_path / "out", *FAST, "--resume").exit_code == 0
    assert not log.exists()


def test_a_folder_with_one_recording_takes_a_ground_truth(bags: Path, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    shutil.copy(bags / "in" / "a.bag", tmp_path / "in" / "a.bag")
    result = call("lio", tmp_path / "in", "-o", tmp_path / "out", *FAST, "--gt", bags / "a.gt.tum", "--json")
    assert result.exit_code == 0, result.stderr
    assert lines(result)["a"]["evaluation"]["ate_translation_m"]["rmse"] < 0.1
    assert json.loads((tmp_path / "out" / "a" / "evaluation.json").read_text()) == lines(result)["a"]["evaluation"]


@pytest.mark.slow
@pytest.mark.parametrize(("spoilt", "code"), [({}, 2), ({"contradiction": "they differ"}, 3), ({"state": "interrupted"}, 130)])
def test_a_ground_truth_that_does_not_fit_hides_nothing(
    bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spoilt: dict[str, str], code: int
) -> None:
    run = odometry_run.run_odometry

    def spoil(*arguments: Any, **words: Any) -> Any:
        return run(*arguments, **words).model_copy(update=spoilt)

    monkeypatch.setattr(odometry_run, "run_odometry", spoil)
    (tmp_path / "other.tum").write_text("".join(f"{k} {k} 0 0 0 0 0 1\n" for k in range(20)))
    words = ("lio", bags / "in" / "a.bag", "-o", tmp_path / "out", *FAST, "--gt", tmp_path / "other.tum", "--json")
    result = call(*words)
    assert result.exit_code == code
    found = lines(result)["out"]
    assert found["exit_code"] == code and found["run"]["scans"] == 29 and found["evaluation"] is None
    assert "expected" in found["error"] and f"error: {found['error']}" in result.stderr


def test_what_cannot_be_run_is_a_line_of_json_too(tmp_path: Path) -> None:
    result = call("lio", tmp_path / "nowhere.bag", "-o", tmp_path / "out", "--json")
    assert result.exit_code == 2
    assert json.loads(result.stdout) == {
        "input": str(tmp_path / "nowhere.bag"),
        "output": str(tmp_path / "out"),
        "outcome": "failed",
        "exit_code": 2,
        "error": result.stderr.removeprefix("error: ").strip(),
        "evaluation": None,
        "run": None,
    }


@pytest.mark.skipif(os.name == "nt", reason="SIGINT is sent differently on Windows")
def test_ctrl_c_is_answered_in_quiet_runs_too(bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    interrupt_at(monkeypatch, 1)
    result = call("lio", bags / "in" / "a.bag", "-o", tmp_path / "out", *FAST, "--quiet")
    assert result.exit_code == 130 and result.stdout == ""
    assert result.stderr.startswith("interrupted: finishing the files; Ctrl-C again stops at once\n")


def test_paths_that_are_not_there_are_told_before_any_is_run(bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A typo is better told at once than in the table an hour later; a file that is there and no recording is in the table."""
    monkeypatch.chdir(tmp_path)
    result = call("lio", "wrong.bag", bags / "in" / "a.bag", "worse.bag", "-o", tmp_path / "out", *FAST, "--json")
    assert (result.exit_code, result.stdout) == (2, "")
    assert "got no file or folder wrong.bag and no worse.bag – check the path, nothing was run" in result.stderr
    assert list(tmp_path.iterdir()) == []
    page = (Path(__file__).parents[3] / "docs" / "command_line.md").read_text(encoding="utf-8")
    assert "One that is not there" in page and "refused before any is run (exit code 2)" in page
