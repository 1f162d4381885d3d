"""False loop closures: told from true ones, without and with agreement among the false ones."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus import InputError, PoseGraphConfig, losses, optimize_pose_graph
from boxplus.simulation.pose_graphs import simulate_pose_graph, without_false_loops
from boxplus.systems.pose_graph.problem import positions

GNC = PoseGraphConfig(robust="gnc")


def rms(simulated, result):
    off = positions(result.graph, result.graph.poses) - positions(result.graph, simulated.truth)
    return np.sqrt((off**2).sum(axis=1).mean())


@pytest.mark.parametrize(
    ("dimension", "seed", "share", "kind", "sigma"),
    [
        (2, 1, 0.3, "random", 0.002),
        (2, 3, 0.6, "clustered", 0.02),
        (2, 5, 0.6, "mixed", 0.005),
        (3, 1, 0.6, "clustered", 0.02),
        (3, 3, 0.3, "mixed", 0.005),
    ],
)
def test_loops_are_judged_right_and_the_map_is_that_of_the_true_ones(dimension, seed, share, kind, sigma):
    simulated = simulate_pose_graph(
        dimension=dimension,
        poses=500,
        seed=seed,
        false_share=share,
        false_kind=kind,
        sigma_rotation=sigma,
        sigma_translation=5 * sigma,
    )
    result = optimize_pose_graph(simulated.graph, GNC)
    kept, true = result.loops.is_kept & simulated.is_loop, simulated.is_loop & ~simulated.is_false
    assert (kept & true).sum() >= 0.98 * kept.sum() and (kept & true).sum() >= 0.98 * true.sum()
    assert result.loops.is_kept[~simulated.is_loop].all()
    known = optimize_pose_graph(without_false_loops(simulated))
    assert rms(simulated, result) < 1.2 * rms(simulated, known) + 0.02
    assert result.doubt is None and not result.fit.is_poor and result.start == "spanning_tree"
    np.testing.assert_array_equal(result.weights, result.loops.is_kept)
    np.testing.assert_allclose(result.loops.innovations, result.errors, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("loss", [losses.Tukey(4.685), losses.Welsch(2.985), losses.GemanMcClure(3.787)], ids=lambda x: x.name)
@pytest.mark.parametrize("dimension", [2, 3])
def test_losses_that_forget_start_from_the_loops_that_are_believed(dimension, loss):
    for seed in (1, 3):
        simulated = simulate_pose_graph(dimension=dimension, poses=300, seed=seed, false_share=0.03)
        result = optimize_pose_graph(simulated.graph, loss=loss)
        known = optimize_pose_graph(without_false_loops(simulated))
        assert result.start == "graduated" and result.solution.status == "converged"
        assert rms(simulated, result) < 1.3 * rms(simulated, known) + 0.02
        assert (result.weights[simulated.is_false] < 0.1).all()


def test_a_lie_that_odometry_contradicts_is_flagged():
    """Odometry that claims to be ten times better than it is: kept edges contradict each other, and the result says so."""
    simulated = simulate_pose_graph(poses=300, seed=1, false_share=0.3)
    graph = simulated.graph
    graph.information[~simulated.is_loop] *= 100.0
    result = optimize_pose_graph(graph, GNC)
    assert result.fit.is_poor and "times what the information matrices promise" in result.doubt


def test_a_graph_of_loops_alone_and_one_of_odometry_alone():
    simulated = simulate_pose_graph(poses=60, loops=0, seed=0)
    assert optimize_pose_graph(simulated.graph, GNC).loops is None
    simulated = simulate_pose_graph(poses=200, loops=80, seed=0)
    scattered = type(simulated.graph)(
        2,
        np.random.default_rng(0).permutation(200),
        None,
        simulated.graph.edges,
        simulated.graph.measurements,
        simulated.graph.information,
        np.array([0]),
    )
    result = optimize_pose_graph(scattered, GNC)
    assert result.loops.report.refused == 0 and result.doubt is None


def test_what_does_not_go_together_is_refused():
    graph = simulate_pose_graph(poses=100, loops=10).graph
    with pytest.raises(InputError, match="no other robust loss"):
        optimize_pose_graph(graph, GNC, loss=losses.Huber(1.0))
    with pytest.raises(InputError, match="chordal objective without a robust loss"):
        optimize_pose_graph(graph, PoseGraphConfig(certify=True))
