"""`boxplus refine` from the folder of a run to its own."""

from __future__ import annotations

import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.formats.clouds.ply import read_ply
from boxplus.formats.trajectory import read_trajectory
from boxplus.recordings import open_recording
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.runs.refinement import refine_run
from boxplus.runs.refinement.folder import claim_refine_folder
from boxplus.runs.refinement.summary import RefineSummary
from boxplus.runs.settings_file import load_settings
from boxplus.simulation import SpinningLidar, simulate
from boxplus.simulation.recording_writer import write_recording

LIDAR = SpinningLidar(azimuth_steps=200)


def call(*words: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "200"})
    return result.exit_code, re.sub(r"\s+", " ", result.stdout), re.sub(r"\s+", " ", result.stderr)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The folder of a run, and its recording with the truth beside it."""
    base = tmp_path_factory.mktemp("refine")
    bag = write_recording(simulate("walk", duration_s=5.0, lidar=LIDAR), base / "walk", "ros1")
    with open_recording(bag) as recording:
        run_odometry(recording, base / "run")
    return base / "run", bag


@pytest.fixture(scope="module")
def refined(folders: tuple[Path, Path]) -> tuple[Path, str]:
    run, bag = folders
    code, out, err = call("refine", run, "--gt", bag.with_suffix(".gt.tum"), "--json")
    assert code == 0, err
    found = json.loads(out)
    assert found["run"] == json.loads((run.with_name("run_refined") / "run.json").read_text())
    assert found["evaluation"]["ate_translation_m"]["rmse"] == pytest.approx(found["run"]["ate_after_m"])
    return run.with_name("run_refined"), err


@pytest.mark.slow
def test_folder_holds_everything(folders: tuple[Path, Path], refined: tuple[Path, str]) -> None:
    folder, out = refined
    summary = RefineSummary.model_validate_json((folder / "run.json").read_bytes())
    before, after = read_trajectory(folders[0] / "trajectory.csv"), read_trajectory(folder / "trajectory.csv")
    np.testing.assert_array_equal(after.times, before.times)
    assert after.status == before.status and after.covariance is not None
    assert summary.state == "finished" and summary.scans == len(after)
    shift = np.linalg.norm(after.p - before.p, axis=1)
    if summary.accepted:
        assert shift.max() == pytest.approx(summary.largest_shift_m, abs=1e-6) and summary.largest_shift_m > 0.0
        assert len(read_ply(folder / "map.ply").points) > 1000
        assert "accepted: thickness" in out
    else:
        assert shift.max() < 1e-8 and not (folder / "map.ply").exists()
        assert "NOT accepted" in out
    assert summary.ate_before_m is not None and 0.0 < summary.ate_before_m < 0.1
    assert "Before and after" in (folder / "report.html").read_text(encoding="utf-8")
    assert not (folder / "points.spool").exists()


def test_a_run_that_was_not_accepted_keeps_its_trajectory(
    folders: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(refine_run.Refinement, "refusal", property(lambda self: "because"))
    (tmp_path / "other.tum").write_text("".join(f"{k} {k} 0 0 0 0 0 1\n" for k in range(20)))
    once = ("--no-report", "--set", "refinement.rounds=1", "--gt", tmp_path / "other.tum")
    code, out, err = call("refine", folders[0], "-o", tmp_path / "out", *once)
    assert code == 2 and "error: expected" in err  # of the ground truth; everything else is there
    assert "NOT accepted, the trajectory is that of the run: because" in out
    summary = json.loads((tmp_path / "out" / "run.json").read_text())
    assert summary["accepted"] is False and summary["refusal"] == "because"
    before, after = read_trajectory(folders[0] / "trajectory.csv"), read_trajectory(tmp_path / "out" / "trajectory.csv")
    np.testing.assert_allclose(after.p, before.p, atol=1e-8)
    assert before.covariance is not None and after.covariance is not None
    np.testing.assert_allclose(after.covariance, before.covariance, rtol=1e-6)
    assert not (tmp_path / "out" / "map.ply").exists()


def test_a_rejected_run_without_covariances_is_given_none(
    folders: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that was put together in Python may have none; those of the refinement are not those of its poses."""
    monkeypatch.setattr(refine_run.Refinement, "refusal", property(lambda self: "because"))
    run = refine_run.read_odometry_run(folders[0])
    bare = replace(run, trajectory=replace(run.trajectory, covariance=None), rows=replace(run.rows, covariance=None))
    config = load_settings(refine_run.RefineRunConfig, None, ["refinement.rounds=1"])
    with claim_refine_folder(tmp_path / "out", folders[0]) as folder:
        refine_run.refine_run(bare, folder, config)
    after = read_trajectory(tmp_path / "out" / "trajectory.csv")
    assert len(after) == len(run.trajectory) and after.covariance is None


def test_what_is_no_run_or_another_recording_is_refused(folders: tuple[Path, Path], tmp_path: Path) -> None:
    code, _, err = call("refine", tmp_path / "nothing", "-o", tmp_path / "out")
    assert code == 2 and "run.json" in err
    (tmp_path / "run.json").write_text('{"program": "boxplus vio"}')
    code, _, err = call("refine", tmp_path, "-o", tmp_path / "out")
    assert code == 2 and "expected the output folder of 'boxplus lio' or 'boxplus slam' – got one of 'boxplus vio'" in err
    code, _, err = call("refine", folders[0], "-o", folders[0] / "inside")
    assert code == 2 and "another folder than that of the run" in err
    code, _, err = call("refine", folders[0], "-o", tmp_path / "gone", "--recording", tmp_path / "gone.bag")
    assert code in (1, 2) and "gone.bag" in err
    other = write_recording(simulate("walk", seed=3, duration_s=2.0, lidar=LIDAR), tmp_path / "other", "ros1")
    code, _, err = call("refine", folders[0], "-o", tmp_path / "wrong", "--recording", other)
    assert code == 2 and "the recording that the odometry went over" in err
    assert json.loads((tmp_path / "wrong" / "run.json").read_text())["state"] == "failed"


def test_runs_that_cannot_be_believed_are_refused(folders: tuple[Path, Path], tmp_path: Path) -> None:
    facts = json.loads((folders[0] / "run.json").read_text())
    changes = {
        "the clocks differ": {"contradiction": "the clocks differ"},
        "come to its end": {"state": "failed"},
        "mounting of the LiDAR is known": {"extrinsic": facts["extrinsic"] | {"source": "identity"}},
    }
    for words, change in changes.items():
        copy = tmp_path / words.replace(" ", "_")
        shutil.copytree(folders[0], copy)
        (copy / "run.json").write_text(json.dumps(facts | change))
        code, _, err = call("refine", copy)
        assert code == 2 and words in err


def test_a_pose_without_a_covariance_is_refused(folders: tuple[Path, Path], tmp_path: Path) -> None:
    """Once a bare LinAlgError of NumPy."""
    run = with_weak_scans(folders[0], tmp_path / "spoilt", range(30, 33))
    lines = (run / "trajectory.csv").read_text().splitlines()
    cells = lines[32].split(",")
    lines[32] = ",".join([*cells[:-21], *["nan"] * 21])
    (run / "trajectory.csv").write_text("\n".join(lines) + "\n")
    code, _, err = call("refine", run, "-o", tmp_path / "out", "--recording", folders[1])
    assert code == 2 and "expected a covariance of every pose in trajectory.csv – got NaN or infinity" in err, err
    assert not (tmp_path / "out").exists()


def with_weak_scans(run: Path, folder: Path, weak: range) -> Path:
    """A copy of a run that says of some scans that they left a direction open."""
    shutil.copytree(run, folder)
    lines = (folder / "scans.csv").read_text().splitlines()
    at = lines[0].split(",").index("status")
    for k in weak:
        cells = lines[1 + k].split(",")
        lines[1 + k] = ",".join([*cells[:at], "weak", *cells[at + 1 :]])
    (folder / "scans.csv").write_text("\n".join(lines) + "\n")
    return folder


def test_covariances_are_those_of_the_run_from_the_first_weak_scan_on(folders: tuple[Path, Path], tmp_path: Path) -> None:
    """What a scan was not shown stays in all later poses, whatever planes seem to measure."""
    run = with_weak_scans(folders[0], tmp_path / "weak", range(30, 33))
    code, out, err = call("refine", run, "-o", tmp_path / "out", "--no-report", "--recording", folders[1])
    assert code == 0 and "3 scans were weak or lost" in out + err
    before, after = read_trajectory(run / "trajectory.csv"), read_trajectory(tmp_path / "out" / "trajectory.csv")
    assert before.covariance is not None and after.covariance is not None
    np.testing.assert_allclose(after.covariance[30:], before.covariance[30:], rtol=1e-6)
    sigma = [np.sqrt(np.trace(own[20:30, 3:, 3:].mean(axis=0))) for own in (before.covariance, after.covariance)]
    assert sigma[1] < sigma[0]


def test_poses_that_move_farther_than_the_run_allows_are_not_trusted(
    folders: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(refine_run, "_DOUBTED", 0.01)
    code, out, err = call("refine", folders[0], "-o", tmp_path / "out", "--no-report")
    said = "standard deviations of what the run claimed: one of the two is wrong"
    assert code == 3 and "not to be trusted: poses moved by up to" in out + err and said in out + err
    assert said in json.loads((tmp_path / "out" / "run.json").read_text())["doubt"]


def test_a_run_that_was_shown_little_is_refused(folders: tuple[Path, Path], tmp_path: Path) -> None:
    count = len(read_trajectory(folders[0] / "trajectory.csv"))
    run = with_weak_scans(folders[0], tmp_path / "tunnel", range(count // 2 + 1))
    code, _, err = call("refine", run, "--recording", folders[1])
    assert code == 2 and f"{count // 2 + 1} of {count} scans that were weak or lost" in err and "by satellite" in err


def test_results_are_replaced_on_demand_only(folders: tuple[Path, Path], refined: tuple[Path, str]) -> None:
    code, _, err = call("refine", folders[0])
    assert code == 2 and "the results of an earlier run" in err


def test_a_second_refinement_replaces_the_first_when_it_is_whole(
    folders: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once `--overwrite` cleared the folder before anything was computed, and a full disk left neither of the two."""
    run, out = folders[0], tmp_path / "out"
    once = ("-o", out, "--no-report", "--no-map", "--set", "refinement.rounds=1")
    assert call("refine", run, *once)[0] == 0
    (out / "plots").mkdir(exist_ok=True)
    (out / "plots" / "notes.txt").write_text("mine")
    open_log = (out / "log.txt").open("w")

    def there() -> dict[str, bytes]:
        return {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*") if path.is_file()}

    before = there()
    code, _, err = call("refine", run, *once, "--overwrite", "--recording", tmp_path / "gone.bag")
    assert code in (1, 2) and "gone.bag" in err and there() == before
    with claim_refine_folder(out, run, overwrite=True) as claimed:
        stopped = refine_run.refine_run(refine_run.read_odometry_run(run), claimed, should_stop=lambda: True)
        assert there() == before
    assert stopped.summary.state == "interrupted" and there() == before
    with monkeypatch.context() as patched:
        patched.setattr(refine_run._RefineRun, "_tell", lambda self, stage, share: (_ for _ in ()).throw(refine_run._Stopped))
        code, printed, _ = call("refine", run, *once, "--overwrite")
    assert code == 130 and there() == before
    assert f"nothing was refined; the earlier refinement in {out} stays as it was" in printed and "trajectory.csv" not in printed

    # A process that is killed leaves what it had begun beside the folder, and the next one takes it away.
    (tmp_path / "out.boxplus-tmp").mkdir()
    (tmp_path / "out.boxplus-tmp" / "run.json").write_text("{")
    code, _, err = call("refine", run, *once, "--overwrite")
    assert code == 0, err
    with open_log:
        open_log.write("still written to")  # as by `tee`
    assert (out / "log.txt").read_text() == "still written to"
    (out / "log.txt").write_text("")
    after = there()
    assert after.keys() == before.keys() and after["plots/notes.txt"] == b"mine" and after["run.json"] != before["run.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]

    # Between its two renames it leaves the earlier folder under another name.
    out.rename(tmp_path / "out.boxplus-earlier")
    code, _, err = call("refine", run, *once)
    assert code == 2 and "the results of an earlier run" in err and there() == after

    # What could not be kept is named before anything is computed.
    if hasattr(os, "mkfifo"):
        os.mkfifo(out / "pipe")
        code, _, err = call("refine", run, *once, "--overwrite")
        assert code == 2 and f"can be read – got {out / 'pipe'} – move it away" in err and there() == after


def test_stopping_leaves_no_half_results(folders: tuple[Path, Path], tmp_path: Path) -> None:
    with claim_refine_folder(tmp_path / "out", folders[0]) as claimed:
        run = refine_run.read_odometry_run(folders[0])
        result = refine_run.refine_run(run, claimed, should_stop=lambda: True)
    assert result.summary.state == "interrupted"
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"run.json", "config.yaml"}
