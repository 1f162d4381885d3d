"""Reports of bundle adjustment and pose graphs: what is drawn, also of odd inputs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.formats.graphs.g2o import write_g2o
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.report.optimization.bundle_scene import Viewpoint, camera_centers, frustum_lines, scene_of
from boxplus.report.optimization.figures import cost_over_iterations, counts_per_bin, error_bins, error_histogram
from boxplus.report.optimization.graph_report import _kinds, _panels
from boxplus.runs.optimization_summary import ErrorFacts, IterationFacts
from boxplus.systems.bundle_adjustment.bundle_adjustment import adjust_bundle
from boxplus.systems.pose_graph.pose_graph import PoseGraphConfig, optimize_pose_graph
from boxplus.systems.pose_graph.problem import positions
from tests.small_problems import bal_problem, colmap_model, gbp_problem, in_camera, loop_graph


def test_bins_hold_every_valid_error() -> None:
    rng = np.random.default_rng(0)
    before, after = rng.lognormal(2.0, 1.0, 500), rng.lognormal(-1.0, 1.0, 500)
    after[:7] = np.nan
    after[7:20] = 1e-14  # would stretch the axis
    edges = error_bins(before, after)
    assert (np.diff(edges) > 0).all() and edges[-1] > before.max() and edges[-1] / edges[0] <= 1e5 * 1.001
    assert counts_per_bin(before, edges).sum() == 500 and counts_per_bin(after, edges).sum() == 493


@pytest.mark.parametrize("errors", [np.zeros(3), np.full(3, np.nan), np.ones(3), np.zeros(0)])
def test_odd_errors_are_drawn(errors: np.ndarray) -> None:
    assert error_histogram(errors, errors, "px").to_json()
    facts = ErrorFacts.of(errors)
    assert facts.invalid == np.isnan(errors).sum() and np.isfinite(facts.rms)


def iteration(number: int, cost: float, tried: float | None, accepted: bool = True) -> IterationFacts:
    return IterationFacts(
        number=number, cost=cost, tried_cost=tried, gradient=1.0, step=0.1, parameter=0.0, accepted=accepted, time_s=0.0
    )


def test_rejected_steps_do_not_squash_the_cost() -> None:
    history = [
        iteration(0, 100.0, 100.0),
        iteration(1, 100.0, 1e30, False),
        iteration(2, 100.0, None, False),
        iteration(3, 10.0, 10.0),
    ]
    figure = cost_over_iterations(history, "λ")
    rejected = next(trace for trace in figure.data if trace.name == "tried and rejected")
    assert list(rejected.x) == [1] and 100.0 < rejected.y[0] < 200.0 and rejected.customdata[0] == 1e30
    assert cost_over_iterations([iteration(0, 0.0, 0.0)], "λ").to_json()


@pytest.mark.parametrize("start", [bal_problem(0.0), gbp_problem(), colmap_model(off=0.0)], ids=["bal", "gbp", "colmap"])
def test_cameras_look_at_the_points(start: object) -> None:
    result = adjust_bundle(start)  # type: ignore[arg-type]
    scene = scene_of(result.reconstruction, result.errors, result.point_of)
    towards = scene.points.mean(axis=0) - scene.centers
    assert (np.einsum("ni,ni->n", towards, scene.forward) > 0.9 * np.linalg.norm(towards, axis=1)).all()
    assert_allclose(np.einsum("ni,ni->n", scene.forward, scene.up), 0.0, atol=1e-12)
    assert scene.up[:, 1].max() < -0.9  # the y axis of all three scenes points down
    if isinstance(result.reconstruction, ColmapModel):
        centers = in_camera(result.reconstruction.T_camera_world, camera_centers(result.reconstruction))
        assert_allclose(centers, 0.0, atol=1e-12)
    view = Viewpoint.of(scene, scene)
    assert_allclose(
        np.stack([view.right, view.depth, view.up]) @ np.stack([view.right, view.depth, view.up]).T, np.eye(3), atol=1e-9
    )
    assert view.inside(scene).mean() > 0.8
    assert frustum_lines(scene, 0.1).shape == (6, 12, 3)


def test_far_points_are_left_out_of_the_picture() -> None:
    result = adjust_bundle(bal_problem(0.0))
    scene = scene_of(result.reconstruction, result.errors, result.point_of)
    points = scene.points.copy()
    points[0] = 1e6
    far = scene_of(result.reconstruction, result.errors, result.point_of)
    object.__setattr__(far, "points", points)
    assert not Viewpoint.of(scene, far).inside(far)[0]


@pytest.mark.parametrize("dimension", [2, 3])
def test_edges_of_a_graph_are_drawn_once_each(dimension: int) -> None:
    graph = loop_graph(dimension)
    result = optimize_pose_graph(graph)
    kinds = _kinds(graph, result.errors)
    assert sum(map(len, kinds)) == len(graph.edges)
    assert (np.abs(np.diff(kinds[1], axis=1)) == 1).all()
    (before, p_before), (after, p_after) = _panels(graph, result)
    assert result.start == "chordal" and (before, after) == ("before: in the file", "after")
    assert graph.poses is not None and result.graph.poses is not None
    assert np.array_equal(p_before, positions(graph, graph.poses))  # and not the start that was taken
    assert np.array_equal(p_after, positions(graph, result.graph.poses))
    from_file = optimize_pose_graph(graph, PoseGraphConfig(start="file"))
    assert_allclose(result.errors_before, from_file.errors_start, rtol=1e-12)
    without = optimize_pose_graph(loop_graph(dimension, with_poses=False))
    assert np.array_equal(without.errors_before, without.errors_start)
    assert "the file has no poses" in _panels(loop_graph(dimension, with_poses=False), without)[0][0]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_graph_without_errors_is_drawn(dimension: int, tmp_path: Path) -> None:
    """Two poses and one edge that is exactly right: all errors and costs are zero."""
    poses = np.zeros((2, 7 if dimension == 3 else 3))
    poses[:, 0] = float(dimension == 3)
    poses[1, -1] = 1.0
    information = np.eye(6 if dimension == 3 else 3)[None]
    graph = PoseGraph(
        3 if dimension == 3 else 2, np.arange(2), poses, np.array([[0, 1]]), poses[1:], information, np.zeros(0, dtype=np.int64)
    )
    write_g2o(tmp_path / "exact.g2o", graph)
    result = CliRunner().invoke(app, ["pgo", str(tmp_path / "exact.g2o"), "-o", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    assert (tmp_path / "out" / "report.html").exists()
