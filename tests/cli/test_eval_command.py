"""`boxplus eval`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from boxplus.cli.eval import evaluate_command
from boxplus.errors import InputError
from boxplus.formats.trajectory import Trajectory, write_csv, write_tum

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
