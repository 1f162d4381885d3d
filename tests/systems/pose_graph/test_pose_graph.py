"""Pose graphs: known optima, starts that reach them, and graphs in several pieces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import special_ortho_group

from boxplus import SE2, SE3, InputError, PoseGraph, PoseGraphConfig, losses, optimize_pose_graph
from boxplus.formats.graphs.g2o import read_g2o
from boxplus.manifolds import se2, se3
from boxplus.systems.pose_graph.problem import chi2
from boxplus.systems.pose_graph.start import _nearest_rotations, chordal_start, held_poses, spanning_tree_start


def random_graph(
    dimension: int, count: int = 30, noise: float = 0.0, seed: int = 0, pieces: int = 1
) -> tuple[PoseGraph, np.ndarray]:
    """A graph without initial poses, and the poses it was measured at; first poses of the pieces are the identity."""
    rng = np.random.default_rng(seed)
    manifold, group = (SE3, se3) if dimension == 3 else (SE2, se2)
    truth = manifold.random(rng, count)
    piece = np.arange(count) % pieces
    for k in range(pieces):
        truth[k] = manifold.identity()
    i, j = np.array(
        [(a, b) for a in range(count) for b in range(count) if a != b and piece[a] == piece[b] and rng.random() < 0.3]
    ).T
    chain = np.arange(count - pieces)
    i, j = np.concatenate([i, chain]), np.concatenate([j, chain + pieces])
    exact = group.compose(group.inverse(truth[i]), truth[j])
    measured = manifold.boxplus(exact, noise * rng.standard_normal((len(i), manifold.dof)))
    information = np.tile(np.eye(manifold.dof) / max(noise, 0.1) ** 2, (len(i), 1, 1))
    ids = 10 * np.arange(count)
    return PoseGraph(dimension, ids, None, np.stack([i, j], 1), measured, information, np.zeros(0, dtype=np.int64)), truth


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("pieces", [1, 3])
def test_both_starts_are_exact_without_noise(dimension, pieces):
    graph, truth = random_graph(dimension, pieces=pieces)
    manifold = SE3 if dimension == 3 else SE2
    np.testing.assert_array_equal(held_poses(graph), np.arange(pieces))
    for start in (spanning_tree_start(graph), chordal_start(graph)):
        np.testing.assert_allclose(manifold.boxminus(start, truth), 0.0, atol=1e-6)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("fixed", [[], [3, 7, 20]])
def test_the_chordal_start_is_the_same_in_any_order_of_elimination(dimension, fixed):
    graph, truth = random_graph(dimension, noise=0.05)
    graph = replace(graph, poses=truth, fixed=np.array(fixed, dtype=np.int64))
    order = np.random.default_rng(0).permutation(len(graph.ids) - len(held_poses(graph)))
    np.testing.assert_allclose(chordal_start(graph, order), chordal_start(graph), atol=1e-9)


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_optimum_does_not_depend_on_the_start(dimension):
    graph, _ = random_graph(dimension, noise=0.05)
    results = [optimize_pose_graph(graph, PoseGraphConfig(start=start)) for start in ("chordal", "spanning_tree")]
    assert [result.start for result in results] == ["chordal", "spanning_tree"]
    assert results[0].chi2 == pytest.approx(results[1].chi2, rel=1e-8)
    assert results[0].chi2 == pytest.approx(2.0 * results[0].solution.cost, rel=1e-9)
    assert results[0].chi2 <= results[0].chi2_start
    # m residuals of `dof` rows less the free variables: χ² is about as large.
    freedom = graph.information.shape[1] * (len(graph.edges) - len(graph.ids) + 1)
    assert 0.25 * 0.7 * freedom < results[0].chi2 < 1.3 * freedom


def test_fixed_poses_of_the_file_are_held():
    graph, truth = random_graph(3, noise=0.02)
    held = PoseGraph(3, graph.ids, truth, graph.edges, graph.measurements, graph.information, np.array([4, 9]))
    result = optimize_pose_graph(held)
    np.testing.assert_array_equal(result.held, [4, 9])
    np.testing.assert_array_equal(result.graph.poses[[4, 9]], held.poses[[4, 9]])
    assert np.abs(SE3.boxminus(result.graph.poses, truth)).max() < 0.2


def test_a_robust_loss_ignores_a_false_loop_closure():
    graph, truth = random_graph(3, noise=0.02)
    measurements = graph.measurements.copy()
    measurements[5] = SE3.boxplus(measurements[5], [0.0, 0.0, 1.0, 3.0, -2.0, 1.0])
    spoiled = PoseGraph(3, graph.ids, None, graph.edges, measurements, graph.information, graph.fixed)
    plain, robust = optimize_pose_graph(spoiled), optimize_pose_graph(spoiled, loss=losses.GemanMcClure(3.0))
    errors = [np.abs(SE3.boxminus(result.graph.poses, truth)).max() for result in (plain, robust)]
    assert errors[1] < 0.1 < errors[0]


def test_a_file_without_poses_cannot_be_the_start():
    graph, _ = random_graph(2)
    with pytest.raises(InputError, match="poses in the file"):
        optimize_pose_graph(graph, PoseGraphConfig(start="file"))


def test_nearest_rotations_equal_those_of_the_svd():
    rng = np.random.default_rng(0)
    M = special_ortho_group.rvs(3, size=200, random_state=1) * rng.uniform(0.05, 5.0, (200, 1, 1))
    M += 0.3 * rng.standard_normal(M.shape) * np.abs(np.linalg.det(M))[:, None, None] ** (1 / 3)
    M[0], M[1] = np.diag([1.0, 1.0, -0.5]), np.diag([1.0, 2.0, 0.0])
    U, _, Vt = np.linalg.svd(M)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    np.testing.assert_allclose(_nearest_rotations(M.copy()), U @ Vt, atol=1e-9)


@pytest.mark.parametrize(("name", "expected"), [("intel", 45.0042), ("MIT", 41.2069), ("CSAIL", 40.5509)])
def test_optima_of_the_shared_graphs(shared_data, name, expected):
    result = optimize_pose_graph(read_g2o(shared_data / "graphs" / f"{name}.g2o"))
    assert result.solution.status == "converged"
    assert round(result.chi2, 4) == expected
    assert chi2(result.graph, result.graph.poses) == result.chi2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "optimum", "digits"),
    [
        ("smallGrid3D", 1025.398, 3),
        ("parking-garage", 1.26252, 5),
        ("CSAIL", 31.7037, 4),
        ("intel", 52.3482, 4),
        ("MIT", 61.154, 3),
        ("manhattan", 6431.39, 2),
        ("cubicle", 717.126, 3),
        ("sphere2500", 1687.006, 3),
    ],
)
def test_certified_optima_of_se_sync(shared_data, name, optimum, digits):
    """The global optima of its objective, certified by others (shared/data/graphs/SOURCE.md)."""
    result = optimize_pose_graph(read_g2o(shared_data / "graphs" / f"{name}.g2o"), PoseGraphConfig(objective="chordal"))
    assert result.start == "chordal"
    assert round(result.chi2, digits) == optimum


@pytest.mark.parametrize(("cross_block", "expected"), [("auto", 2712.969), ("dropped", 2745.552)])
def test_cubicle_depends_on_how_its_information_is_read(shared_data, cross_block, expected):
    graph = read_g2o(shared_data / "graphs" / "cubicle.g2o", cross_block=cross_block)
    assert len(graph.warnings) == (cross_block == "auto")
    assert round(optimize_pose_graph(graph).chi2, 3) == expected


def test_errors_of_edges_add_up():
    graph, _ = random_graph(3, noise=0.05)
    for objective in ("logarithm", "chordal"):
        result = optimize_pose_graph(graph, PoseGraphConfig(objective=objective))
        assert (result.errors**2).sum() == pytest.approx(result.chi2, rel=1e-12)
        assert result.chi2 == pytest.approx(2.0 * result.solution.cost, rel=1e-9)
        assert (result.errors_start**2).sum() == pytest.approx(result.chi2_start, rel=1e-12)
