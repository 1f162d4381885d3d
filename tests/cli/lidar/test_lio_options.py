"""`boxplus lio` for scripts and for many: --json, --quiet, --gt, several recordings; and `boxplus fleet run`, `localize`."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from boxplus._extras import installation
from boxplus.cli import app
from boxplus.runs.lidar_inertial.summary import read_summary
from boxplus.simulation import SpinningLidar, simulate
from boxplus.simulation.recording_writer import write_recording

FAST = ("--no-map", "--no-report", "--set", "scan_voxel=0.5")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording, its ground truth, a bag that is none, and a file that nobody takes for a recording."""
    folder = tmp_path_factory.mktemp("days")
    write_recording(simulate("walk", duration_s=4.0, lidar=SpinningLidar(azimuth_steps=100)), folder / "monday", "ros1")
    (folder / "tuesday.bag").write_bytes(b"torn")
    (folder / "notes.md").write_text("sunny")
    return folder


def call(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.mark.slow
def test_json_is_all_of_the_standard_output_and_the_ground_truth_is_compared_with(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = call("lio", folder / "monday.bag", "-o", out, *FAST, "--json", "--gt", folder / "monday.gt.tum")
    assert result.exit_code == 0, result.stderr
    (line,) = result.stdout.splitlines()
    assert json.loads(line)["run"] == json.loads((out / "run.json").read_text())
    assert "finished: 39 scans" in result.stderr and "against --gt" in result.stderr
    evaluation = json.loads((out / "evaluation.json").read_text())
    assert evaluation["ate_translation_m"]["rmse"] < 0.1
    evidence = next(line for line in result.stderr.splitlines() if line.startswith(" T_imu_lidar"))
    assert "from static transforms" in evidence  # in one line: what is no terminal is not wrapped
    again = call("lio", folder / "monday.bag", "-o", out, *FAST, "--quiet", "--overwrite")
    assert (again.exit_code, again.stdout, again.stderr) == (0, "", "")
    assert not (out / "evaluation.json").exists()  # it was of the run before


def test_a_ground_truth_of_another_day_does_not_cost_the_run(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "other.tum").write_text("".join(f"{k} {k} 0 0 0 0 0 1\n" for k in range(20)))
    result = call("lio", folder / "monday.bag", "-o", tmp_path / "out", *FAST, "--gt", tmp_path / "other.tum")
    assert result.exit_code == 2
    assert "finished: 39 scans" in result.stdout and "error: expected" in result.stderr
    assert read_summary(tmp_path / "out" / "run.json").state == "finished"
    result = call("lio", folder / "monday.bag", "-o", tmp_path / "none", "--gt", tmp_path / "nowhere.tum")
    assert result.exit_code == 2 and not (tmp_path / "none").exists()  # refused before the run
    (tmp_path / "kitti.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    result = call("lio", folder / "monday.bag", "-o", tmp_path / "none", "--gt", tmp_path / "kitti.txt")
    assert result.exit_code == 2 and "time stamps" in result.stderr and not (tmp_path / "none").exists()


def test_of_a_folder_the_failed_one_is_listed_and_the_other_unharmed(folder: Path, tmp_path: Path) -> None:
    result = call("lio", folder, "-o", tmp_path / "runs", *FAST, "--json")
    assert result.exit_code == 3
    found = {Path(entry["input"]).name: entry for entry in map(json.loads, result.stdout.splitlines())}
    assert set(found) == {"monday.bag", "tuesday.bag"}
    assert found["monday.bag"]["error"] is None and found["monday.bag"]["run"]["scans"] == 39
    assert found["tuesday.bag"]["run"] is None and "expected" in found["tuesday.bag"]["error"]
    rows = {line.split()[0]: line for line in result.stderr.splitlines() if line.startswith((" monday ", " tuesday "))}
    assert " finished " in rows["monday"] and " 39 " in rows["monday"] and str(tmp_path / "runs" / "monday") in rows["monday"]
    assert rows["tuesday"].split() == ["tuesday", "failed"]
    assert f"failed: tuesday: {found['tuesday.bag']['error']}" in result.stderr
    assert read_summary(tmp_path / "runs" / "monday" / "run.json").state == "finished"
    assert not (tmp_path / "runs" / "tuesday").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            ["monday.bag", "nowhere"],
            "expected recordings that are there – got no file or folder nowhere – check the path, nothing was run; results go",
        ),
        (
            ["monday.bag", "monday.bag", "--gt", "monday.gt.tum"],
            "expected one recording with --view or --gt – got 2 – run them one",
        ),
    ],
)
def test_what_cannot_be_run_together_is_said_first(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], told: str
) -> None:
    monkeypatch.chdir(folder)
    result = call("lio", *words, "-o", tmp_path / "out")
    assert result.exit_code == 2 and told in result.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["nowhere.bag", "--map", "MAP"], "expected a recording – got no file or folder nowhere.bag"),
        (["BAG", "--map", "nowhere"], "expected"),
        (["BAG", "--map", "MAP", "--set", "localization.least_fitt=1"], "did you mean least_fit?"),
        (["BAG"], "Missing option '--map'"),
    ],
)
def test_localize_refuses_bad_input(folder: Path, tmp_path: Path, words: list[str], told: str) -> None:
    (tmp_path / "empty").mkdir()
    given = {"BAG": str(folder / "monday.bag"), "MAP": str(tmp_path / "empty")}
    result = call("localize", *(given.get(word, word) for word in words), "-o", tmp_path / "out")
    assert result.exit_code == 2 and told in result.stderr, result.stderr
    assert not (tmp_path / "out" / "trajectory.tum").exists()


def test_fleet_refuses_a_folder_without_recordings(tmp_path: Path) -> None:
    result = call("fleet", "run", tmp_path, "-o", tmp_path / "fleet")
    assert result.exit_code == 2 and f"expected a folder with recordings – got none in {tmp_path}" in result.stderr


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs Ray, the extra fleet")
def test_a_fleet_names_the_recording_that_failed(folder: Path, tmp_path: Path) -> None:
    result = call("fleet", "run", folder, "-o", tmp_path / "fleet", "--workers", "1", "--set", "slam.appearance=scan_context")
    assert result.exit_code == 3
    assert " tuesday: failed" in result.stdout and " monday: finished" in result.stdout, result.stdout


def test_a_fleet_without_ray_names_the_extra(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    result = call("fleet", "run", folder, "-o", tmp_path / "fleet")
    assert result.exit_code == 2 and installation("fleet") in result.stderr
