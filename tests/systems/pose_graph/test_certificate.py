"""The certificate of global optimality: granted at known optima, refused at local minima, and a true bound everywhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus import SE2, SE3, InputError, PoseGraph, PoseGraphConfig, optimize_pose_graph
from boxplus.formats.graphs.g2o import read_g2o
from boxplus.residuals.chordal_pose import chordal_weights
from boxplus.simulation.pose_graphs import simulate_pose_graph
from boxplus.systems.pose_graph.certificate import _matrices, certify
from boxplus.systems.pose_graph.problem import chi2

CHORDAL = PoseGraphConfig(objective="chordal", certify=True)


def turning_ring(count=20, turns=1.0):
    """A ring measured as it is, with poses that turn `turns` times on the way around."""
    angle = 2.0 * np.pi / count
    measured = np.tile([angle, 1.0, 0.0], (count, 1))
    edges = np.stack([np.arange(count), np.roll(np.arange(count), -1)], 1)
    theta = turns * angle * np.arange(count)
    steps = np.stack([np.cos(theta), np.sin(theta)], 1)
    poses = np.column_stack([theta, np.cumsum(steps, axis=0) - steps])
    return PoseGraph(2, np.arange(count), poses, edges, measured, np.tile(np.eye(3), (count, 1, 1)), np.array([0]))


@pytest.mark.parametrize("name", ["tinyGrid3D", "smallGrid3D", "parking-garage", "sphere2500", "intel", "MIT", "manhattan"])
def test_known_optima_are_certified(shared_data, name):
    result = optimize_pose_graph(read_g2o(shared_data / "graphs" / f"{name}.g2o"), CHORDAL)
    assert result.certificate.is_certified and result.doubt is None
    assert result.certificate.objective == pytest.approx(result.chi2, rel=1e-10)
    assert 0.0 <= result.certificate.gap <= 1e-6 * result.chi2
    assert result.certificate.sentence.startswith("certified: the global minimum of SE-Sync's objective")


def test_a_minimum_that_winds_once_too_often_is_not_certified():
    graph = turning_ring(turns=2.0)
    local = optimize_pose_graph(graph, PoseGraphConfig(objective="chordal", certify=True, start="file"))
    assert local.solution.status == "converged" and local.chi2 > 0.5
    assert local.doubt == local.certificate.sentence and not local.certificate.is_certified
    assert local.certificate.least_eigenvalue < -1e-3 and local.certificate.sentence.startswith("not certified")
    best = optimize_pose_graph(graph, CHORDAL)
    assert best.chi2 < 1e-6 and best.certificate.is_certified and best.doubt is None
    assert local.certificate.lower_bound <= best.chi2


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_bound_holds_at_any_poses(dimension):
    graph = simulate_pose_graph(dimension=dimension, poses=100, loops=30, block=2, seed=1).graph
    best = optimize_pose_graph(graph, CHORDAL)
    rng = np.random.default_rng(0)
    manifold = SE3 if dimension == 3 else SE2
    for size in (1e-6, 1e-3, 0.1):
        poses = manifold.boxplus(best.graph.poses, size * rng.standard_normal((100, manifold.dof)))
        found = certify(replace(graph, poses=poses))
        assert found.lower_bound <= best.chi2 * (1.0 + 1e-9)
        assert found.objective == pytest.approx(chi2(graph, poses, "chordal"), rel=1e-10)


@pytest.mark.parametrize("winding", [1.0, 2.0])
def test_least_eigenvalue_against_the_dense_dual_with_translations_eliminated(winding):
    graph = turning_ring(12, winding)
    graph = optimize_pose_graph(graph, PoseGraphConfig(objective="chordal", start="file")).graph
    R, _ = _matrices(graph.poses)
    n, d = len(R), 2
    kappa, tau = chordal_weights(graph.information)
    Z, z = _matrices(graph.measurements)
    M = np.zeros(((d + 1) * n, (d + 1) * n))
    for k, (i, j) in enumerate(graph.edges):
        a, b = np.zeros(((d + 1) * n, d)), np.zeros((d + 1) * n)
        a[d * i : d * i + d], a[d * j : d * j + d] = -Z[k], np.eye(d)
        b[d * i : d * i + d], b[d * n + i], b[d * n + j] = -z[k], -1.0, 1.0
        M += kappa[k] * a @ a.T + tau[k] * np.outer(b, b)
    A, B, C = M[: d * n, : d * n], M[: d * n, d * n :], M[d * n :, d * n :]
    Q = A - B @ np.linalg.pinv(C) @ B.T
    XQ = np.concatenate(list(R), axis=1) @ Q
    for k in range(n):
        own = R[k].T @ XQ[:, d * k : d * k + d]
        Q[d * k : d * k + d, d * k : d * k + d] -= 0.5 * (own + own.T)
    least = np.linalg.eigvalsh(Q)[0]
    found = certify(graph).least_eigenvalue
    if winding == 1.0:
        assert abs(least) < 1e-10 and abs(found) < 1e-8
    else:  # in steps of about three
        assert found <= least < found / 3.5


def test_what_cannot_be_certified_is_refused():
    graph = turning_ring()
    with pytest.raises(InputError, match="one held pose in every piece"):
        certify(replace(graph, fixed=np.array([0, 3])))
    with pytest.raises(InputError, match="a graph with poses"):
        certify(replace(graph, poses=None))
