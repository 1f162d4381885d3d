"""`boxplus ba`: every format in and out, what the terminal and the page say, and how it fails."""

from __future__ import annotations

import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from typer.testing import CliRunner, Result

from boxplus.cli import app
from boxplus.formats.clouds.ply import read_ply
from boxplus.formats.reconstructions.bal import read_bal, write_bal
from boxplus.formats.reconstructions.colmap import read_colmap, write_colmap
from boxplus.formats.reconstructions.gbp import read_gbp, write_gbp
from boxplus.manifolds import so3
from boxplus.systems.bundle_adjustment.bundle_adjustment import adjust_bundle
from tests.small_problems import bal_problem, colmap_model, gbp_problem


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["ba", *map(str, arguments)])


class _Page(HTMLParser):
    """Collects headings, and every address a browser would load by itself."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.headings: list[str] = []
        self.loads: list[str] = []
        self._in_heading = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._in_heading = tag in ("h1", "h2")
        self.loads += [value or "" for name, value in attrs if name in ("src", "srcset", "data", "poster")]

    def handle_data(self, data: str) -> None:
        if self._in_heading:
            self.headings.append(data)
            self._in_heading = False


@pytest.fixture(scope="module")
def adjusted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    folder = tmp_path_factory.mktemp("ba")
    write_bal(folder / "scene.txt.bz2", bal_problem())
    result = call(folder / "scene.txt.bz2", "-o", folder / "out")
    assert result.exit_code == 0, result.output
    return folder, result


def test_the_terminal_shows_every_step_and_why_it_stopped(adjusted: tuple[Path, Result]) -> None:
    folder, result = adjusted
    summary = json.loads((folder / "out" / "run.json").read_text())
    lines = result.output.splitlines()
    assert lines[0] == "scene.txt.bz2"
    assert any(line.startswith("input") and "BAL file; 6 cameras, 40 points, 240 observations" in line for line in lines)
    head = next(k for k, line in enumerate(lines) if " ".join(line.split()) == "step cost change gradient largest δ λ time [s]")
    steps = lines[head + 1 : head + 1 + len(summary["history"])]
    assert [int(line.split()[0]) for line in steps] == list(range(len(steps)))
    assert float(steps[-1].split()[1]) == pytest.approx(summary["cost"], rel=1e-8)
    assert any(line.startswith("converged: ") for line in lines)
    assert "error [px]" in result.output
    assert "Schur elimination of 40 'points'" in " ".join(result.output.split())


def test_bal_goes_back_to_bal(adjusted: tuple[Path, Result]) -> None:
    folder, _ = adjusted
    written = read_bal(folder / "out" / "adjusted.txt.bz2")
    expected = adjust_bundle(bal_problem()).reconstruction
    assert_allclose(written.cameras, expected.cameras, rtol=1e-12, atol=1e-12)
    assert_allclose(written.points, expected.points, rtol=1e-12)
    assert_array_equal(written.pixels, expected.pixels)
    scene = read_ply(folder / "out" / "scene.ply")
    assert len(scene.points) == 46
    assert_allclose(scene.points[:40], expected.points, rtol=1e-6)


def test_the_page_is_self_contained(adjusted: tuple[Path, Result]) -> None:
    folder, _ = adjusted
    text = (folder / "out" / "report.html").read_text(encoding="utf-8")
    page = _Page(text)
    assert page.loads == []
    assert page.headings == ["scene.txt.bz2", "Warnings", "Before and after", "Errors", "Cost", "Facts"]
    body = text.split("<body>")[1]
    assert body.count('class="plot"') == 3
    for told in ("Schur elimination", "cost ½ Σ (‖e‖²/σ²) over the observations, σ = 1 px", "Levenberg-Marquardt", "converged"):
        assert told in body
    for name in ("before_after.png", "errors.png", "cost.png"):
        assert (folder / "out" / "plots" / name).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_an_earlier_run_is_replaced_only_on_request(adjusted: tuple[Path, Result]) -> None:
    folder, _ = adjusted
    out = folder / "out"
    refused = call(folder / "scene.txt.bz2", "-o", out)
    assert refused.exit_code == 2
    assert "got the results of an earlier run" in refused.stderr and "--overwrite" in refused.stderr
    (out / "notes.txt").write_text("mine")
    again = call(folder / "scene.txt.bz2", "-o", out, "--overwrite", "--no-report")
    assert again.exit_code == 0, again.output
    assert (out / "notes.txt").read_text() == "mine"
    assert not (out / "report.html").exists() and not (out / "plots").exists()
    (out / "notes.txt").unlink()
    (folder / "full").mkdir(exist_ok=True)
    (folder / "full" / "thesis.tex").write_text("mine")
    other = call(folder / "scene.txt.bz2", "-o", folder / "full", "--overwrite")
    assert other.exit_code == 2 and "other files" in other.stderr
    (out / "run.json").write_text('{"program": "boxplus lio"}')
    foreign = call(folder / "scene.txt.bz2", "-o", out, "--overwrite")
    assert foreign.exit_code == 2 and "one of 'boxplus lio'" in foreign.stderr
    assert call(folder / "scene.txt.bz2", "-o", folder / "new").exit_code == 0
    assert (folder / "new" / "report.html").exists()


@pytest.mark.slow
@pytest.mark.parametrize("format", ["text", "binary"])
def test_colmap_goes_back_to_colmap(tmp_path: Path, format: str) -> None:
    model = colmap_model("SIMPLE_RADIAL", format)
    write_colmap(tmp_path / "sparse", model)
    result = call(tmp_path / "sparse", "-o", tmp_path / "out", "--refine-intrinsics", "--loss", "huber:2", "--threads", "1")
    assert result.exit_code == 0, result.output
    assert f"COLMAP model ({format}, cameras SIMPLE_RADIAL)" in result.output and "Huber(2)" in result.output
    written = read_colmap(tmp_path / "out" / "adjusted")
    assert written.format == format
    assert written.camera_params[0][0] == pytest.approx(500.0, rel=0.01)
    assert written.image_names == model.image_names
    assert_array_equal(written.point_of, model.point_of)
    assert 0.0 < written.errors.max() < 3.0
    again = call(tmp_path / "sparse", "-o", tmp_path / "out", "--overwrite", "--no-report")
    assert again.exit_code == 0, again.output
    assert read_colmap(tmp_path / "out" / "adjusted").camera_params[0][0] == model.camera_params[0][0]


def test_common_intrinsics_are_recognised(tmp_path: Path) -> None:
    write_gbp(tmp_path / "desk.txt", gbp_problem())
    before = read_gbp(tmp_path / "desk.txt")
    assert_allclose(before.T_camera_world, gbp_problem().T_camera_world, atol=1e-14)
    result = call(tmp_path / "desk.txt", "-o", tmp_path / "out", "--no-report", "--method", "dogleg")
    assert result.exit_code == 0, result.output
    assert "with common intrinsics" in result.output and "radius" in result.output
    assert_array_equal(read_gbp(tmp_path / "out" / "adjusted.txt").pixels, before.pixels)


def test_limits_are_told(tmp_path: Path) -> None:
    write_bal(tmp_path / "scene.txt", bal_problem())
    result = call(tmp_path / "scene.txt", "-o", tmp_path / "out", "--max-iterations", "0")
    assert result.exit_code == 3
    assert "not to be trusted: no minimum was reached (iteration limit of 0 reached): the cost of" in " ".join(
        result.output.split()
    )
    assert "stopped: iteration limit of 0 reached" in result.output
    text = (tmp_path / "out" / "report.html").read_text(encoding="utf-8").split("<body>")[1]
    assert "not converged: iteration limit of 0 reached" in text
    near = call(tmp_path / "scene.txt", "-o", tmp_path / "out", "--max-iterations", "2", "--overwrite", "--no-report")
    assert near.exit_code == 0 and "stopped: iteration limit of 2 reached" in near.output


def test_a_limit_after_steps_that_led_down_but_not_to_the_end_is_doubted(tmp_path: Path) -> None:
    write_bal(tmp_path / "scene.txt", bal_problem(off=4.0))
    for steps, code in ((1, 3), (3, 0)):
        limit = ("--max-iterations", str(steps), "--overwrite", "--no-report")
        result = call(tmp_path / "scene.txt", "-o", tmp_path / "out", *limit)
        assert result.exit_code == code and f"stopped: iteration limit of {steps} reached" in result.output
        told = " ".join(result.output.split())
        assert ("not to be trusted: no minimum was reached (iteration limit of 1 reached)" in told) == (code == 3)
        assert ("standard deviations of its own away from there" in told) == (code == 3)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["missing.txt"], "expected a bundle adjustment file or the folder of a COLMAP model – got missing.txt: no such file"),
        (["scene.txt", "--loss", "hub"], "expected --loss none or one of huber"),
        (["scene.txt", "--loss", "huber:x"], "expected a number as the scale of huber – got 'x'"),
        (["scene.txt", "--loss", "huber:-1"], "expected Huber scale positive and finite"),
        (["scene.txt", "--method", "gauss_newton"], "expected a method that damps its steps"),
        (["bad.txt"], "bad.txt, line 1"),
    ],
)
def test_bad_input_is_one_paragraph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], told: str) -> None:
    monkeypatch.chdir(tmp_path)
    write_bal(tmp_path / "scene.txt", bal_problem())
    (tmp_path / "bad.txt").write_text("6 forty 240\n")
    result = call(*arguments)
    assert result.exit_code == 2
    assert result.stderr.startswith("error: expected ") and result.stderr.count("\n") == 1
    assert told in result.stderr


def test_an_interrupt_keeps_what_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from contextlib import contextmanager

    from boxplus.cli.terminal import interrupt

    @contextmanager
    def at_once(announce: object):  # type: ignore[no-untyped-def]
        yield lambda: True

    monkeypatch.setattr(interrupt, "stop_on_interrupt", at_once)
    write_bal(tmp_path / "scene.txt", bal_problem())
    result = call(tmp_path / "scene.txt", "-o", tmp_path / "out")
    assert result.exit_code == 130
    summary = json.loads((tmp_path / "out" / "run.json").read_text())
    assert summary["state"] == "interrupted" and summary["history"][-1]["number"] == 0
    assert "stopped: interrupted after step 0; everything up to there is written" in result.output
    assert np.isfinite(read_bal(tmp_path / "out" / "adjusted.txt").points).all()
    assert "interrupted" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8").split("<body>")[1]


def test_a_script_gets_json_or_silence(tmp_path: Path) -> None:
    write_bal(tmp_path / "scene.txt", bal_problem())
    result = call(tmp_path / "scene.txt", "-o", tmp_path / "out", "--no-report", "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["run"] == json.loads((tmp_path / "out" / "run.json").read_text())
    silent = call(tmp_path / "scene.txt", "-o", tmp_path / "out", "--no-report", "--quiet", "--overwrite")
    assert (silent.exit_code, silent.stdout, silent.stderr) == (0, "", "")


def test_a_folder_without_a_model_says_what_it_holds(tmp_path: Path) -> None:
    write_bal(tmp_path / "scene.txt", bal_problem())
    result = call(tmp_path)
    assert result.exit_code == 2
    assert (
        f"got {tmp_path}, a folder with scene.txt – give the folder that has them (often sparse/0), or one BAL" in result.stderr
    )


def test_inverted_poses_are_bad_input(tmp_path: Path) -> None:
    scene = bal_problem()
    cameras = scene.cameras.copy()
    cameras[:, :3] *= -1.0
    cameras[:, 3:6] = -np.einsum("nij,nj->ni", so3.exp(cameras[:, :3]), scene.cameras[:, 3:6])
    write_bal(tmp_path / "scene.txt", replace(scene, cameras=cameras))
    result = call(tmp_path / "scene.txt", "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert "if the poses are inverted" in " ".join(result.stderr.split())


def test_examinations_are_shown_under_what_they_ask(tmp_path: Path) -> None:
    scene = bal_problem()
    pixels = scene.pixels + np.abs(scene.pixels).max(axis=0)
    write_bal(tmp_path / "scene.txt", replace(scene, pixels=pixels))
    result = call(tmp_path / "scene.txt", "-o", tmp_path / "out")
    assert "examining the result: pixels from a corner?" in result.output.splitlines()
