"""`boxplus pgo`: every format in and out, starts and conventions as told, and how it fails."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from typer.testing import CliRunner, Result

from boxplus._extras import has, installation
from boxplus.cli import app
from boxplus.errors import InputError, SingularProblemError
from boxplus.formats.graphs.g2o import read_g2o, write_g2o
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.formats.graphs.toro import read_toro, write_toro
from boxplus.manifolds.se3 import SE3
from boxplus.simulation.pose_graphs import simulate_pose_graph
from boxplus.systems.pose_graph import pose_graph
from boxplus.systems.pose_graph.pose_graph import optimize_pose_graph
from tests.report.unpacked import figures_of
from tests.small_problems import loop_graph


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["pgo", *map(str, arguments)])


def words(result: Result) -> str:
    """The output without the line breaks of its tables."""
    return " ".join(result.output.split())


@pytest.mark.parametrize("dimension", [2, 3])
def test_g2o_goes_back_to_g2o(tmp_path: Path, dimension: int) -> None:
    graph = loop_graph(dimension)
    write_g2o(tmp_path / "loops.g2o", graph)
    result = call(tmp_path / "loops.g2o", "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    expected = optimize_pose_graph(graph)
    written = read_g2o(tmp_path / "out" / "optimized.g2o")
    assert_allclose(written.poses, expected.graph.poses, atol=1e-12)
    assert_allclose(written.information, graph.information, rtol=1e-14)
    summary = json.loads((tmp_path / "out" / "run.json").read_text())
    assert summary["chi2"] == pytest.approx(expected.chi2, rel=1e-9) == pytest.approx(2.0 * summary["cost"], rel=1e-9)
    assert summary["start"] == expected.start_reason and "cheaper than" in summary["start"]
    told = words(result)
    assert "adjusting" not in told and "several solves" not in told and not summary["is_last_of_several"]
    assert f"g2o, {dimension}D; 24 poses, 35 edges" in told and expected.start_reason in told
    assert "e = Log(Z⁻¹ Ti⁻¹ Tj), Ω in the order rotation, translation; cost ½ Σ of it, ½ χ²" in told
    assert ("taken for the full rotation vector" in told) == (dimension == 3)
    ply = (tmp_path / "out" / "graph.ply").read_bytes()
    assert b"element vertex 24\n" in ply and b"element edge 35\n" in ply


@pytest.mark.parametrize("dimension", [2, 3])
def test_toro_goes_back_to_toro(tmp_path: Path, dimension: int) -> None:
    graph = loop_graph(dimension)
    write_toro(tmp_path / "loops.graph", graph)
    result = call(tmp_path / "loops.graph", "-o", tmp_path / "out", "--start", "file", "--no-report")
    assert result.exit_code == 0, result.output
    assert f"TORO, {dimension}D" in result.output and "file, as asked for" in result.output
    written = read_toro(tmp_path / "out" / "optimized.graph")
    assert len(written.ids) == 24 and not (tmp_path / "out" / "report.html").exists()


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("with_poses", [True, False])
def test_the_page_shows_file_start_and_result(tmp_path: Path, dimension: int, with_poses: bool) -> None:
    write_g2o(tmp_path / "loops.g2o", loop_graph(dimension, with_poses))
    result = call(tmp_path / "loops.g2o", "-o", tmp_path / "out", "--loss", "cauchy")
    assert result.exit_code == 0, result.output
    body = (tmp_path / "out" / "report.html").read_text(encoding="utf-8").split("<body>")[1]
    assert any("before: in the file" in figure for figure in figures_of(body)) == with_poses
    for told in (
        "<b>graduated</b><span>start taken</span>",
        "Edges with the largest errors",
        "ρ Cauchy(2.385)",
        "dense Cholesky",
    ):
        assert told in body
    for name in ("before_after.png", "errors.png", "cost.png"):
        assert (tmp_path / "out" / "plots" / name).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_the_objective_of_se_sync(tmp_path: Path) -> None:
    write_g2o(tmp_path / "loops.g2o", loop_graph(3))
    result = call(tmp_path / "loops.g2o", "-o", tmp_path / "out", "--objective", "chordal", "--no-report")
    assert result.exit_code == 0, result.output
    assert "κ ‖Rj − Ri Rij‖² + τ ‖tj − ti − Ri tij‖², the objective of SE-Sync" in words(result)


def test_half_angles_are_converted_and_back(tmp_path: Path) -> None:
    graph = loop_graph(3)
    write_g2o(tmp_path / "half.g2o", graph, rotation_error="quaternion")
    result = call(tmp_path / "half.g2o", "-o", tmp_path / "out", "--rotation-error", "quaternion", "--no-report")
    assert result.exit_code == 0, result.output
    assert "taken for g2o's half angles" in words(result)
    written = read_g2o(tmp_path / "out" / "optimized.g2o", rotation_error="quaternion")
    assert_allclose(written.information, graph.information, rtol=1e-14)


def test_pieces_and_poses_without_edges_are_told(tmp_path: Path) -> None:
    one = loop_graph(3)
    assert one.poses is not None
    count = len(one.ids)
    lonely = PoseGraph(
        3,
        np.arange(2 * count + 1),
        np.vstack([one.poses, SE3.boxplus(one.poses, [0, 0, 0, 5.0, 0, 0]), one.poses[:1]]),
        np.vstack([one.edges, one.edges + count]),
        np.vstack([one.measurements, one.measurements]),
        np.concatenate([one.information, one.information]),
        np.array([5]),
    )
    write_g2o(tmp_path / "two.g2o", lonely)
    result = call(tmp_path / "two.g2o", "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    told = words(result)
    assert f"warning: the graph falls into 3 pieces without edges between them; poses {count}, {2 * count}, the first" in told
    assert f"warning: 1 pose has no edge and stays where it is: {2 * count}" in told
    assert "1 pose has no edge" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_a_singular_problem_explains_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def singular(*arguments: object, **options: object) -> None:
        raise SingularProblemError("the problem does not determine its variables: rotation z of poses[3] can move freely")

    monkeypatch.setattr(pose_graph, "optimize_pose_graph", singular)
    write_g2o(tmp_path / "loops.g2o", loop_graph(2))
    result = call(tmp_path / "loops.g2o", "-o", tmp_path / "out")
    assert result.exit_code == 1
    assert result.stderr == "error: the problem does not determine its variables: rotation z of poses[3] can move freely\n"


@pytest.mark.parametrize(
    ("text", "arguments", "told"),
    [
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n", ["--start", "file"], "poses in the file to start from"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0\n", [], "graph.g2o, line 1"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_XY 0 1\n", [], "graph.g2o, line 2"),
        ("EDGE_SE2 0 1 1 0 0 -1 0 0 1 0 1\n", [], "positive semi-definite information matrix"),
        ("", [], "at least one edge"),
    ],
)
def test_bad_input_is_one_paragraph(tmp_path: Path, text: str, arguments: list[str], told: str) -> None:
    (tmp_path / "graph.g2o").write_text(text)
    result = call(tmp_path / "graph.g2o", "-o", tmp_path / "out", *arguments)
    assert result.exit_code == 2, result.output
    assert result.stderr.startswith("error: expected ") and result.stderr.count("\n") == 1
    assert told in result.stderr


def test_unknown_lines_are_left_out_on_request_and_counted(tmp_path: Path) -> None:
    write_g2o(tmp_path / "loops.g2o", loop_graph(2))
    with (tmp_path / "loops.g2o").open("a") as file:
        file.write("EDGE_XY 0 1 2 3\n")
    refused = call(tmp_path / "loops.g2o", "-o", tmp_path / "out", "--no-report")
    assert "pose graph; --ignore-unknown leaves other lines out" in refused.stderr
    result = call(tmp_path / "loops.g2o", "-o", tmp_path / "out", "--ignore-unknown", "--no-report")
    assert result.exit_code == 0, result.output
    assert "warning: 1 line EDGE_XY was left out" in words(result)


def test_the_report_command_sends_back_to_the_page_that_is_there(tmp_path: Path) -> None:
    write_g2o(tmp_path / "loops.g2o", loop_graph(2))
    assert call(tmp_path / "loops.g2o", "-o", tmp_path / "out").exit_code == 0
    result = CliRunner().invoke(app, ["report", str(tmp_path / "out")])
    assert result.exit_code == 2
    expected = "the output folder of 'boxplus lio', 'slam', 'vio' or 'vo' – got one of 'boxplus pgo' ("
    assert expected in words(result) and f"– open {tmp_path / 'out' / 'report.html'}" in words(result)
    (tmp_path / "out" / "report.html").unlink()
    without = CliRunner().invoke(app, ["report", str(tmp_path / "out")])
    assert "its command draws its report: run it again, without --no-report" in words(without)


@pytest.mark.parametrize("view", ["http://127.0.0.1:9876", "rerun+http://example.org:9876/proxy", "window.txt", "a.rrd"])
def test_a_view_that_cannot_be_is_refused_before_anything_is_read(tmp_path: Path, view: str) -> None:
    """As it is said of a file that is no graph; a.rrd wants rerun, which is not installed for tests."""
    if view == "a.rrd" and has("rerun"):
        pytest.skip("rerun is installed")
    (tmp_path / "graph.g2o").write_text("no graph\n")
    result = call(tmp_path / "graph.g2o", "-o", tmp_path / "out", "--view", view)
    assert result.exit_code == 2 and ("--view" in words(result) or "rerun" in words(result) or "viewer" in words(result))
    assert "pose graph" not in words(result) and not (tmp_path / "out").exists()


def test_a_viewer_that_does_not_answer_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise InputError("a viewer that answers", "none", "open it")

    write_g2o(tmp_path / "loops.g2o", loop_graph(2))
    monkeypatch.setattr("boxplus._extras.require", lambda *_: None)
    monkeypatch.setattr("boxplus.report.live_view.ProblemView", refuse)
    result = call(tmp_path / "loops.g2o", "-o", tmp_path / "out", "--view", "rerun+http://127.0.0.1:9/proxy")
    assert result.exit_code == 2 and "a viewer that answers" in words(result)
    assert not (tmp_path / "out").exists()


def test_false_loop_closures_are_refused_and_listed(tmp_path: Path) -> None:
    simulated = simulate_pose_graph(poses=120, loops=40, block=3, seed=1, false_share=0.3)
    write_g2o(tmp_path / "false.g2o", simulated.graph)
    result = call(tmp_path / "false.g2o", "-o", tmp_path / "out", "--robust", "gnc")
    assert result.exit_code == 0, result.output
    told = words(result)
    assert "of 40 loop closures kept" in told
    # Each width of the loss is a solve of its own: their steps stood in one table, and the cost "before" was the last one's.
    assert "telling false loop closures from true ones step" not in told
    first, second = "telling false loop closures from true ones\n", "telling false loop closures from true ones, solve 2\n"
    assert result.output.count(first) == 1 and result.output.count(second) == 1
    assert "\nadjusting\n" in result.output and "adjusting again" not in told
    assert "(of the last of several solves, which began where the others led)" in told
    page = (tmp_path / "out" / "report.html").read_text()
    assert "of the last of several solves" in page and "of the last solve, all in" in page
    assert json.loads((tmp_path / "out" / "run.json").read_text())["is_last_of_several"]
    rows = [line.split(",") for line in (tmp_path / "out" / "edges.csv").read_text().splitlines()]
    assert rows[0] == ["from", "to", "kind", "weight", "error_sigma"] and len(rows) == 1 + len(simulated.graph.edges)
    weights, errors = (np.array([float(row[column]) for row in rows[1:]]) for column in (3, 4))
    assert (weights[simulated.is_false] == 0.0).all() and (weights[~simulated.is_loop] == 1.0).all()
    assert errors[simulated.is_false].min() > errors[weights == 1.0].max()
    assert "loop closures kept" in json.loads((tmp_path / "out" / "run.json").read_text())["loops"]
    assert "loop closures kept" in (tmp_path / "out" / "report.html").read_text()


def test_contradictions_and_local_minima_exit_with_3(tmp_path: Path) -> None:
    simulated = simulate_pose_graph(poses=300, seed=1, false_share=0.3)
    simulated.graph.information[~simulated.is_loop] *= 100.0
    write_g2o(tmp_path / "proud.g2o", simulated.graph)
    result = call(tmp_path / "proud.g2o", "-o", tmp_path / "out", "--robust", "gnc", "--no-report")
    assert result.exit_code == 3 and "not to be trusted: odometry and the loop closures that were kept contradict" in words(
        result
    )
    summary = json.loads((tmp_path / "out" / "run.json").read_text())
    assert summary["doubt"].startswith("odometry and the loop closures") and summary["state"] == "finished"
    count, turn = 20, np.pi / 10
    ring = np.stack([np.arange(count), np.roll(np.arange(count), -1)], 1)
    theta = 2.0 * turn * np.arange(count)
    steps = np.stack([np.cos(theta), np.sin(theta)], 1)
    poses = np.column_stack([theta, np.cumsum(steps, axis=0) - steps])
    measured = np.tile([turn, 1.0, 0.0], (count, 1))
    wound = PoseGraph(2, np.arange(count), poses, ring, measured, np.tile(np.eye(3), (count, 1, 1)), np.array([0]))
    write_g2o(tmp_path / "wound.g2o", wound)
    asked = ("--objective", "chordal", "--certify", "--no-report")
    local = call(tmp_path / "wound.g2o", "-o", tmp_path / "local", "--start", "file", *asked)
    assert local.exit_code == 3 and "not certified" in words(local)
    best = call(tmp_path / "wound.g2o", "-o", tmp_path / "best", *asked)
    assert best.exit_code == 0 and "optimality certified: the global minimum of SE-Sync's objective" in words(best)


def test_a_script_gets_json_or_silence(tmp_path: Path) -> None:
    write_g2o(tmp_path / "loops.g2o", loop_graph(2))
    result = call(tmp_path / "loops.g2o", "-o", tmp_path / "out", "--no-report", "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["run"] == json.loads((tmp_path / "out" / "run.json").read_text())
    assert "linear solver" in result.stderr
    silent = call(tmp_path / "loops.g2o", "-o", tmp_path / "out", "--no-report", "--quiet", "--overwrite")
    assert (silent.exit_code, silent.stdout, silent.stderr) == (0, "", "")
    at_once = ("--start", "file", "--max-iterations", "0")
    stopped = call(tmp_path / "loops.g2o", "-o", tmp_path / "out", "--no-report", "-q", "--overwrite", *at_once)
    why, *warnings, doubt = stopped.stderr.splitlines()
    assert all(line.startswith("warning: ") for line in warnings)
    assert (stopped.exit_code, stopped.stdout, why) == (3, "", "stopped: iteration limit of 0 reached")
    assert doubt.startswith("not to be trusted: no minimum was reached (iteration limit of 0 reached): the cost of")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--certify"], "got --objective logarithm – say --objective chordal --certify"),
        (["--certify", "--objective", "chordal", "--loss", "huber:2"], "got --loss huber:2 – say"),
        (
            ["--robust", "gnc", "--loss", "huber:2"],
            "expected --robust gnc alone, which has a loss of its own – got --loss huber:2",
        ),
    ],
)
def test_choices_that_exclude_each_other_are_named_as_options(tmp_path: Path, arguments: list[str], told: str) -> None:
    write_g2o(tmp_path / "loops.g2o", loop_graph(2))
    result = call(tmp_path / "loops.g2o", *arguments)
    assert result.exit_code == 2 and told in result.stderr


def test_a_folder_is_no_pose_graph(tmp_path: Path) -> None:
    result = call(tmp_path)
    assert result.exit_code == 2
    assert result.stderr == f"error: expected a pose graph file, g2o or TORO – got the folder {tmp_path} – give a file in it\n"


@pytest.mark.parametrize("missing", ["matplotlib", "plotly"])
def test_without_the_libraries_of_reports_there_is_none_and_that_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    write_g2o(tmp_path / "loops.g2o", loop_graph(2))
    result = call(tmp_path / "loops.g2o", "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert f"no report is drawn, for want of matplotlib or plotly: {installation('report')}" in words(result)
    assert (tmp_path / "out" / "optimized.g2o").exists() and not (tmp_path / "out" / "report.html").exists()
    quiet = call(tmp_path / "loops.g2o", "-o", tmp_path / "asked", "--no-report")
    assert "for want of" not in quiet.output
