"""`boxplus eval`."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from boxplus.cli.eval import evaluate_command
from boxplus.errors import InputError
from boxplus.evaluation.frames import transformed
from boxplus.formats.trajectory import Trajectory, read_trajectory, write_csv, write_tum
from boxplus.manifolds import quaternion, so3
from boxplus.runs.transform import parse_transform
from boxplus.simulation import SpinningLidar, simulate
from boxplus.simulation.recording_writer import write_recording

app = typer.Typer()
app.command()(evaluate_command)


@pytest.fixture
def files(tmp_path: Path) -> tuple[str, str]:
    t = np.arange(0.0, 40.0, 0.1)
    p = np.stack([5 * np.cos(t / 3), 5 * np.sin(t / 2), np.sin(t)], axis=1)
    q = np.stack([np.cos(t / 10), 0 * t, 0 * t, np.sin(t / 10)], axis=1)
    truth = Trajectory(np.round(t * 1e9).astype(np.int64), p, q)
    estimate = Trajectory(truth.time_ns, p + np.random.default_rng(0).normal(scale=0.01, size=p.shape), q)
    write_tum(tmp_path / "truth.tum", truth)
    write_csv(tmp_path / "estimate.csv", estimate)
    return str(tmp_path / "estimate.csv"), str(tmp_path / "truth.tum")


def test_text_begins_with_the_association(files: tuple[str, str]) -> None:
    result = CliRunner().invoke(app, [*files])
    assert result.exit_code == 0
    assert result.output.startswith("Association\nmatched 400 of 400 poses of the estimate (nearest stamps within 0.02 s)")
    for line in (
        "Alignment: SE(3) alignment",
        "Absolute trajectory error: 400 poses",
        "Relative pose error over 10 m",
        "over 1 s",
    ):
        assert line in result.output


def test_json_and_plots(files: tuple[str, str], tmp_path: Path) -> None:
    arguments = [*files, "--json", "--align", "sim3", "--interpolate", "--rpe-time", "0", "--plot", str(tmp_path / "plots")]
    result = CliRunner().invoke(app, arguments)
    data = json.loads(result.stdout)
    assert data["alignment"]["kind"] == "sim3"
    assert data["association"]["method"] == "interpolate"
    assert [errors["unit"] for errors in data["rpe"]] == ["m"]
    assert data["ate_translation_m"]["rmse"] == pytest.approx(0.0173, rel=0.1)
    assert len(list((tmp_path / "plots").glob("*.png"))) == 3


def test_offset_and_refusals(files: tuple[str, str]) -> None:
    result = CliRunner().invoke(app, [*files, "--offset", "100"])
    assert isinstance(result.exception, InputError)
    assert "two trajectories that overlap in time" in str(result.exception)
    assert CliRunner().invoke(app, [*files, "--align", "affine"]).exit_code == 2
    assert isinstance(CliRunner().invoke(app, [*files, "--format", "kitti"]).exception, InputError)


def test_several_estimates_come_in_one_table_and_one_plot(files: tuple[str, str], tmp_path: Path) -> None:
    short = read_trajectory(files[0]).select(np.arange(100))
    write_tum(tmp_path / "short.tum", short)
    (tmp_path / "broken.tum").write_text("1 2 3\n")
    names = [files[0], str(tmp_path / "short.tum"), str(tmp_path / "broken.tum")]
    result = CliRunner().invoke(
        app, [*names, files[1], "--plot", str(tmp_path / "plots"), "--rpe-turn", "20", "--rpe-frames", "5"]
    )
    assert isinstance(result.exception, InputError)
    assert "3 estimates that can be compared – got 1 that cannot" in str(result.exception)
    head, *rows = result.stdout.splitlines()
    assert head.split()[:4] == ["estimate", "matches", "ATE", "rmse"]
    assert [row.split()[:2] for row in rows[:2]] == [["estimate", "400"], ["short", "100"]]
    for delta in ("10 m", "1 s", "20°", "5 frames"):
        assert f"RPE {delta} rmse m" in head
    assert "broken: not compared, expected a trajectory in TUM" in result.stdout
    assert "not compared over the same stretch of 39.9 s: short (0.0 to 9.9 s)" in result.stdout
    alone = json.loads(CliRunner().invoke(app, [names[1], files[1], "--json", "--rpe-turn", "20", "--rpe-frames", "5"]).stdout)
    figures = [alone["ate_translation_m"][name] for name in ("rmse", "mean", "median", "max")]
    assert rows[1].split()[2:6] == [f"{figure:.6f}" for figure in figures]
    assert {path.name for path in (tmp_path / "plots").iterdir()} == {"trajectories.png", "errors.png"}
    together = CliRunner().invoke(app, [*names[:2], files[1], "--json"])
    assert together.exit_code == 0
    assert list(json.loads(together.stdout)["estimates"]) == ["estimate", "short"]


def test_aligned_trajectories_are_saved_as_they_were_compared(files: tuple[str, str], tmp_path: Path) -> None:
    truth = read_trajectory(files[1])
    left, right = np.eye(4), np.eye(4)
    left[:3] = [[0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 2]]
    right[:3, 3] = [0.0, 0.3, 1.2]
    late = transformed(read_trajectory(files[0]), left=left, right=right)
    write_tum(tmp_path / "late.tum", Trajectory(late.times - 500_000_000, late.p, late.q_wxyz))
    arguments = [str(tmp_path / "late.tum"), files[1], "--offset", "0.5", "--transform-right", "xyz: 0 0.3 1.2", "--json"]
    result = CliRunner().invoke(app, [*arguments, "--save-aligned", str(tmp_path / "saved")])
    assert result.exit_code == 0
    assert json.loads(result.stdout)["ate_translation_m"]["rmse"] == pytest.approx(0.0173, rel=0.1)
    saved = {path.name: read_trajectory(path) for path in (tmp_path / "saved").iterdir()}
    assert saved.keys() == {"late.aligned.tum", "ground_truth.tum"}
    moved_truth = transformed(truth, right=right)
    np.testing.assert_allclose(saved["ground_truth.tum"].p, moved_truth.p, atol=2e-9)
    np.testing.assert_array_equal(saved["late.aligned.tum"].times, truth.times)
    assert np.linalg.norm(saved["late.aligned.tum"].p - moved_truth.p, axis=1).max() < 0.1
    flat = CliRunner().invoke(
        app, [*arguments, "--project-to-plane", "xy", "--save-aligned", str(tmp_path / "flat"), "--align", "origin"]
    )
    assert json.loads(flat.stdout)["plane"] == "xy"
    assert not read_trajectory(tmp_path / "flat" / "late.aligned.tum").p[:, 2].any()


def test_swapped_arguments_are_noticed(files: tuple[str, str], tmp_path: Path) -> None:
    assert "swapped" not in CliRunner().invoke(app, [*files]).output
    result = CliRunner().invoke(app, [files[1], files[0]])
    assert "by their names, truth.tum is the ground truth and estimate.csv the estimate: are they swapped?" in result.output
    run = tmp_path / "run"
    run.mkdir()
    write_tum(run / "trajectory.tum", read_trajectory(files[0]))
    assert "by their names" in CliRunner().invoke(app, [files[0], str(run / "trajectory.tum")]).output
    assert "matched 400 of 400" in CliRunner().invoke(app, [str(run), files[1]]).output
    (tmp_path / "drive.bag").write_bytes(b"#ROSBAG V2.0")
    for recording in (tmp_path / "drive.bag", tmp_path):
        swapped = CliRunner().invoke(app, [str(recording), files[1]])
        assert "estimated trajectories first, the ground truth last" in str(swapped.exception)
    against = CliRunner().invoke(app, [*files, str(tmp_path / "drive.bag")])
    assert "one estimate, its places alone, against positions by satellite – got another one" in str(against.exception)


def test_what_is_refused_names_options_of_the_command(files: tuple[str, str], tmp_path: Path) -> None:
    path = read_trajectory(files[1])
    write_tum(tmp_path / "between.tum", Trajectory(path.times + 50_000_000, path.p, path.q_wxyz))
    write_tum(tmp_path / "line.tum", Trajectory(path.times, path.p * [1.0, 0.0, 0.0], path.q_wxyz))
    between, line = str(tmp_path / "between.tum"), str(tmp_path / "line.tum")
    for words, expected in (
        ([*files, "--max-diff", "0"], "expected a positive --max-diff [s] – got 0.0 – "),
        ([*files, "--interpolate", "--max-gap", "-1"], "expected a positive --max-gap [s] – got -1.0 – "),
        ([*files, "--rpe-distance", "-1"], "expected a positive number in --rpe-distance – got -1 m – "),
        ([*files, "--offset", "100"], "give the clocks' difference with --offset (equal starts: --offset "),
        (
            [between, files[1]],
            "– raise --max-diff, use --interpolate, or correct the clocks with --offset; the motions suggest --off",
        ),
        ([line, files[1]], "– compare with --align origin, by the first pose, or --align none"),
        ([*files, "--n-to-align", "1000"], "choose another --n-to-align, or leave it out"),
    ):
        assert expected in str(CliRunner().invoke(app, words).exception)
    shown = CliRunner().invoke(app, [*files, "--rpe-distance", "10000"]).output
    assert "use a smaller --rpe-distance" in shown
    several = CliRunner().invoke(app, [files[0], between, files[1]]).output
    assert "between: not compared, expected at least 10 matched poses" in several and "raise --max-diff" in several


@pytest.mark.parametrize("wanted", ["xyz: 0 0 0", "xyz_rpy_deg: 0.2 0 0 0 0 30", "xyz: 0 0.5 0"])
@pytest.mark.parametrize("given", ["xyz_rpy_deg: 0 0 0 0 0 90", "xyz: 0.4 -0.3 0.6"])
def test_a_pose_of_the_body_that_was_given_is_part_of_what_is_advised(
    files: tuple[str, str], tmp_path: Path, given: str, wanted: str
) -> None:
    path = read_trajectory(files[1])
    turning = so3.exp(np.stack([np.sin(path.times * 1e-9), np.cos(0.7 * path.times * 1e-9), path.times * 1e-10], axis=1))
    truth = Trajectory(path.times, path.p, quaternion.from_matrix(turning))
    write_tum(tmp_path / "truth.tum", truth)
    write_tum(tmp_path / "run.tum", transformed(truth, right=parse_transform(wanted)))
    arguments = [str(tmp_path / "run.tum"), str(tmp_path / "truth.tum"), "--json", "--transform-right"]
    errors, advised = [], given
    for _ in range(3):  # first the turn, then the lever
        result = json.loads(CliRunner().invoke(app, [*arguments, advised]).stdout)
        errors.append((result["ate_translation_m"]["rmse"], result["ate_rotation_deg"]["rmse"]))
        text = " ".join(result["warnings"])
        found = re.search(r"--transform-right (?:'([^']+)' in place of the one given|left out)", text)
        if found is None:
            break
        advised = found[1] or "xyz: 0 0 0"
    assert errors[-1][0] < 0.05 and errors[-1][1] < 1.0 and np.max(errors[0]) > 0.2


def test_an_estimate_in_the_place_of_the_ground_truth_is_noticed_by_what_it_holds(files: tuple[str, str], tmp_path: Path) -> None:
    estimate = read_trajectory(files[0])
    known = replace(estimate, covariance=np.tile(1e-4 * np.eye(6), (len(estimate), 1, 1)))
    write_csv(tmp_path / "first.csv", known)
    write_tum(tmp_path / "second.tum", read_trajectory(files[1]))
    first, second = str(tmp_path / "first.csv"), str(tmp_path / "second.tum")
    told = "first.csv says how well each pose is known, as estimates do, and second.tum does not: are they swapped?"
    assert told in CliRunner().invoke(app, [second, first]).output
    for words in ([first, second], [first, first]):
        assert "swapped" not in CliRunner().invoke(app, words).output


def test_one_file_twice_is_two_estimates_with_short_names(files: tuple[str, str]) -> None:
    found = json.loads(CliRunner().invoke(app, [files[0], files[0], files[1], "--json"]).stdout)
    assert list(found["estimates"]) == ["estimate", "estimate (2)"]


def test_a_recording_without_positions_by_satellite_says_so(files: tuple[str, str], tmp_path: Path) -> None:
    simulated = simulate("walk", duration_s=0.3, lidar=SpinningLidar(azimuth_steps=50))
    recording = write_recording(simulated, tmp_path / "walk", "ros1")
    refused = str(CliRunner().invoke(app, [files[0], str(recording)]).exception)
    assert "positions by satellite (sensor_msgs/NavSatFix) – got none in walk.bag – give the trajectory" in refused
