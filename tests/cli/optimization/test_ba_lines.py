"""`boxplus ba` on a line set: in, out, report, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from typer.testing import CliRunner, Result

from boxplus.cli import app
from boxplus.formats.reconstructions.vgg_lines import read_vgg_lines
from boxplus.formats.reconstructions.vgg_writer import write_vgg_lines
from tests.systems.bundle_adjustment.line_scenes import house, perturbed


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["ba", *map(str, arguments)])


def test_a_line_set_is_adjusted_and_reported(tmp_path: Path) -> None:
    data = perturbed(house(0), 0)
    source = write_vgg_lines(tmp_path / "house", data)
    done = call(source, "-o", tmp_path / "out", "--sigma", "0.2")
    assert done.exit_code == 0, done.output
    summary = json.loads((tmp_path / "out" / "run.json").read_text())
    assert summary["sizes"] == {"cameras": 7, "lines": 15, "segments": 105, "points": 20, "pixels": 140}
    assert summary["errors"]["rms"] < 0.4 < summary["errors_initial"]["rms"] and summary["doubt"] is None
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Lines with the largest errors" in page and "lines, seen 105 times" in page
    assert (tmp_path / "out" / "plots" / "before_after.png").is_file() and (tmp_path / "out" / "scene.ply").is_file()
    adjusted = read_vgg_lines(tmp_path / "out" / "adjusted")
    assert len(adjusted.segments) == 105 and len(adjusted.pixels) == 140
    assert np.abs(adjusted.T_camera_world - data.T_camera_world).max() > 1e-3
    again = call(source, "-o", tmp_path / "out")
    assert again.exit_code == 2 and "overwrite" in again.output
    exact = write_vgg_lines(tmp_path / "exact", house(0))
    lines_only = call(exact, "-o", tmp_path / "alone", "--no-points", "--triangulate", "--no-report")
    assert lines_only.exit_code == 0 and not (tmp_path / "alone" / "report.html").exists()
    assert "lines triangulated from the segments" in lines_only.output


def test_options_of_the_other_kind_are_refused(tmp_path: Path) -> None:
    source = write_vgg_lines(tmp_path / "house", house(0))
    refused = call(source, "-o", tmp_path / "out", "--refine-intrinsics")
    assert refused.exit_code == 2 and "the intrinsics of line sets are held" in refused.output
    (tmp_path / "scene.txt").write_text("1 1 1\n")
    assert "with a line set" in call(tmp_path / "scene.txt", "--triangulate").output
