"""False loop closures: told from true ones, without and with agreement among the false ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus import InputError, PoseGraphConfig, losses, optimize_pose_graph
from boxplus.manifolds import se2, se3
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3
from boxplus.simulation.pose_graphs import simulate_pose_graph, without_false_loops
from boxplus.systems.pose_graph.loops import judge_all_together
from boxplus.systems.pose_graph.problem import consecutive_edges, positions, with_edges
from tests.systems.pose_graph.laps import laps

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


@pytest.mark.parametrize("seed", [4, 7, 8])
def test_true_loops_that_odometry_alone_led_away_from_are_kept(seed):
    """What turns that err by 11 degrees a step lead to is no judge; all loop closures together are."""
    graph = laps(0.2, seed)
    result, known = optimize_pose_graph(graph, GNC), optimize_pose_graph(graph)
    assert result.loops.is_kept.mean() > 0.99 and result.doubt is None
    assert result.start == "chordal" and "leads too far astray" in result.start_reason
    assert result.chi2 < 1.05 * known.chi2


def test_loops_that_are_half_false_are_not_believed_together():
    simulated = simulate_pose_graph(dimension=2, poses=300, seed=3, false_share=0.5, false_kind="clustered", sigma_rotation=0.05)
    first = optimize_pose_graph(simulated.graph, GNC).loops
    start = optimize_pose_graph(simulated.graph, PoseGraphConfig(examine=False)).poses_start
    assert judge_all_together(simulated.graph, first, start, GNC.solver) is first


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dimension", "share", "kind"), [(2, 0.3, "random"), (2, 0.6, "mixed"), (2, 0.6, "clustered"), (3, 0.3, "mixed")]
)
def test_loops_of_three_thousand_poses_are_judged_right(dimension, share, kind):
    """Long ones: dead reckoning is off by far more than the city is wide."""
    simulated = simulate_pose_graph(dimension=dimension, poses=3000, seed=5, false_share=share, false_kind=kind)
    result = optimize_pose_graph(simulated.graph, GNC)
    kept, true = result.loops.is_kept & simulated.is_loop, simulated.is_loop & ~simulated.is_false
    assert (kept & true).sum() >= 0.98 * kept.sum() and (kept & true).sum() >= 0.98 * true.sum()
    known = optimize_pose_graph(without_false_loops(simulated), PoseGraphConfig(examine=False))
    assert rms(simulated, result) < 1.2 * rms(simulated, known) + 0.02
    assert result.doubt is None


@pytest.mark.slow
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


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("kind", ["random", "clustered"])
def test_robots_without_odometry_between_them_are_joined_by_the_loops_that_agree(dimension, kind):
    """The walk cut in two; every robot has a letter in the names of its poses."""
    simulated = simulate_pose_graph(dimension=dimension, poses=300, seed=1, false_share=0.4, false_kind=kind)
    rows = np.arange(len(simulated.graph.edges)) != 149
    graph = with_edges(simulated.graph, rows)
    names = np.where(np.arange(300) < 150, (97 << 56) + np.arange(300), (98 << 56) + np.arange(300) - 150)
    result = optimize_pose_graph(replace(graph, ids=names), GNC)
    kept, true = result.loops.is_kept & simulated.is_loop[rows], (simulated.is_loop & ~simulated.is_false)[rows]
    assert (kept & true).sum() >= 0.98 * kept.sum() and (kept & true).sum() >= 0.98 * true.sum()
    known = optimize_pose_graph(with_edges(graph, ~simulated.is_false[rows]))
    assert rms(simulated, result) < 1.2 * rms(simulated, known) + 0.02
    assert result.doubt is None


def two_robots(dimension, seed, true, false, *, twice=False):
    """A walk cut in two, with `true` loop closures between the halves and `false` ones, the last of which is there `twice`.

    Returns the graph, and how far from the truth the second robot is in the frame of the first for given poses.
    """
    rng = np.random.default_rng(seed)
    group = se3 if dimension == 3 else se2
    simulated = simulate_pose_graph(dimension=dimension, poses=120, seed=seed, loops=60, reach_m=4.0)
    graph = simulated.graph
    halves = graph.edges < 60
    between = halves[:, 0] != halves[:, 1]
    crossing = rng.permutation(np.flatnonzero(between & simulated.is_loop))
    chosen = np.append(crossing[:true], crossing[true : true + false])
    wrong = group.compose(simulated.truth[graph.edges[chosen[true:], 0]], graph.measurements[chosen[true:]])
    wrong[:, -dimension:] += rng.choice([-1.0, 1.0], (false, dimension)) * rng.uniform(4.0, 12.0, (false, dimension))
    graph.measurements[chosen[true:]] = group.compose(group.inverse(simulated.truth[graph.edges[chosen[true:], 0]]), wrong)
    rows = np.concatenate([np.flatnonzero(~between), chosen, chosen[-1:] if twice else chosen[:0]])
    graph = replace(
        graph, edges=graph.edges[rows], measurements=graph.measurements[rows], information=graph.information[rows],
        ids=np.where(np.arange(120) < 60, (97 << 56) + np.arange(120), (98 << 56) + np.arange(120) - 60),
    )  # fmt: skip

    def off(poses):
        there = [group.compose(group.inverse(T[:1]), T[60:61])[0, -dimension:] for T in (poses, simulated.truth)]
        return np.linalg.norm(there[0] - there[1])

    return graph, off


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(("true", "false"), [(1, 0), (0, 1), (1, 1), (0, 2), (2, 1), (1, 2), (0, 3), (3, 1), (4, 0), (5, 2)])
def test_robots_that_few_loops_join_wrongly_are_doubted(dimension, true, false):
    for seed in range(4):
        graph, off = two_robots(dimension, seed, true, false)
        result = optimize_pose_graph(graph, GNC)
        if off(result.graph.poses) > 1.5 or max(true, false) < 2:
            assert result.doubt is not None and "odometry falls into pieces" in result.doubt
        elif true > 2 * false:
            assert result.doubt is None


def test_a_loop_that_is_there_twice_is_one_witness():
    graph, off = two_robots(2, 0, 0, 1, twice=True)
    result = optimize_pose_graph(graph, GNC)
    assert off(result.graph.poses) > 3.0 and "alone" in result.doubt


@pytest.mark.parametrize(("dimension", "slip"), [(2, 1.0), (2, 3.0), (3, 3.0)])
def test_odometry_that_slipped_is_a_doubt_that_names_it(dimension, slip):
    for seed in (1, 3):
        simulated = simulate_pose_graph(dimension=dimension, poses=300, seed=seed, false_share=0.2)
        graph = simulated.graph
        group, manifold = (se3, SE3) if dimension == 3 else (se2, SE2)
        moved = np.zeros((1, manifold.dof))
        moved[0, -dimension:] = slip
        graph.measurements[140] = group.compose(graph.measurements[140], manifold.boxplus(manifold.identity()[None], moved)[0])
        result = optimize_pose_graph(graph, GNC)
        assert result.doubt is not None and ("140" in result.doubt or "slipped" in result.doubt)


def test_odometry_that_only_refused_loops_span_is_told():
    dense = simulate_pose_graph(poses=300, seed=1, false_share=0.5)
    assert not [note for note in optimize_pose_graph(dense.graph, GNC).notes if "confirmed by no" in note]
    few = simulate_pose_graph(poses=100, loops=6, block=2, seed=1)
    few.graph.measurements[50, 1:] += 5.0
    result = optimize_pose_graph(few.graph, GNC)
    refused = few.is_loop & ~result.loops.is_kept
    assert refused.any() and (result.doubt is not None or any("confirmed by no" in note for note in result.notes))


def test_odometry_alone_is_a_doubt_where_all_loops_were_refused():
    simulated = simulate_pose_graph(poses=100, loops=4, block=2, seed=1, false_share=1.0)
    result = optimize_pose_graph(simulated.graph, GNC)
    assert not result.loops.is_kept[simulated.is_loop].any() and "4 loop closures were refused" in result.doubt


def test_names_in_no_order_leave_the_order_of_the_file():
    simulated = simulate_pose_graph(poses=300, seed=1, false_share=0.3)
    graph = replace(simulated.graph, ids=np.random.default_rng(0).permutation(300) * 7 + 3)
    np.testing.assert_array_equal(consecutive_edges(graph), np.abs(np.diff(graph.edges, axis=1))[:, 0] == 1)
    result = optimize_pose_graph(graph, GNC)
    assert result.doubt is None and result.loops.is_kept[~simulated.is_loop].all()


def test_edges_that_leave_poses_tied_to_nothing_are_a_doubt():
    simulated = simulate_pose_graph(poses=100, loops=60, block=2, seed=1)
    graph = simulated.graph
    order = np.random.default_rng(0).permutation(100)
    mixed = replace(graph, ids=np.argsort(order), poses=graph.poses[order], edges=np.argsort(order)[graph.edges])
    assert not consecutive_edges(mixed)[:99].all()
    touching = (graph.edges == 99).any(axis=1)
    mixed.measurements[touching, 1:] += 40.0 * np.arange(touching.sum())[:, None]
    result = optimize_pose_graph(mixed, GNC)
    if result.weights[touching].max() == 0.0:
        assert "tied to nothing" in result.doubt


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
