"""Results under a robust loss or of the chordal objective, and lone joints between stretches of odometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus import PoseGraphConfig, losses, optimize_pose_graph
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.simulation.pose_graphs import simulate_pose_graph
from boxplus.systems.pose_graph.doubts.witnesses import lone_joints
from boxplus.systems.pose_graph.problem import consecutive_edges, with_edges

CHORDAL = PoseGraphConfig(objective="chordal")
FORGETTING = (losses.GemanMcClure(3.0), losses.Tukey(4.685), losses.Cauchy(2.0))


def _distance(result, truth) -> float:
    """[m] Root mean square of the positions in the plane from the truth, the first poses as one."""
    return float(np.sqrt(((result.graph.poses - truth)[:, 1:] ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("seed", range(4))
def test_a_convex_loss_that_false_loop_closures_bend_says_so(seed):
    simulated = simulate_pose_graph(poses=200, loops=100, false_share=0.2, seed=seed)
    bent = optimize_pose_graph(simulated.graph, loss=losses.Huber(1.345))
    assert _distance(bent, simulated.truth) > 1.0 and bent.doubt is not None
    sound = optimize_pose_graph(with_edges(simulated.graph, ~simulated.is_false), loss=losses.Huber(1.345))
    assert sound.doubt is None and _distance(sound, simulated.truth) < 0.5


@pytest.mark.parametrize("loss", FORGETTING)
@pytest.mark.parametrize("kind", ["random", "clustered"])
def test_a_loss_that_forgets_false_loop_closures_is_believed(loss, kind):
    simulated = simulate_pose_graph(poses=200, loops=100, false_share=0.3, false_kind=kind, seed=3)
    assert optimize_pose_graph(simulated.graph, loss=loss).doubt is None


@pytest.mark.parametrize("loss", [losses.Huber(1.345), *FORGETTING])
def test_odometry_that_is_too_long_is_found_under_a_robust_loss(loss):
    simulated = simulate_pose_graph(poses=200, loops=100, seed=1)
    measured = simulated.graph.measurements.copy()
    measured[~simulated.is_loop, 1:] *= 1.05
    assert (
        "steps of the odometry are too long"
        in optimize_pose_graph(replace(simulated.graph, measurements=measured), loss=loss).doubt
    )


@pytest.mark.parametrize("loss", FORGETTING)
def test_odometry_that_slipped_is_found_under_a_loss_that_forgets(loss):
    simulated = simulate_pose_graph(poses=200, loops=100, seed=1)
    measured = simulated.graph.measurements.copy()
    measured[36, 1] += 1.0
    assert optimize_pose_graph(replace(simulated.graph, measurements=measured), loss=loss).doubt is not None


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_chordal_objective_is_held_against_the_logarithmic_error(dimension):
    simulated = simulate_pose_graph(dimension=dimension, poses=200, loops=100, seed=0)
    assert optimize_pose_graph(simulated.graph, CHORDAL).doubt is None
    graph, back = simulated.graph, simulated.is_loop
    edges = np.where(back[:, None], graph.edges[:, ::-1], graph.edges)
    wrong = optimize_pose_graph(replace(graph, edges=edges), CHORDAL)
    assert "with the logarithmic error" in wrong.doubt
    assert optimize_pose_graph(replace(graph, edges=edges), CHORDAL.model_copy(update={"examine": False})).doubt is None


@pytest.mark.parametrize("settings", [{}, {"config": CHORDAL}, {"loss": losses.Huber(1.0)}, {"loss": losses.Tukey(4.685)}])
def test_stretches_that_hang_together_by_one_loop_closure_are_not_believed(settings):
    simulated = simulate_pose_graph(poses=200, loops=100, seed=0)
    graph = simulated.graph
    over = (graph.edges.min(axis=1) < 100) & (graph.edges.max(axis=1) >= 100)
    loops = np.flatnonzero(over & ~consecutive_edges(graph))
    rows = ~over
    rows[loops[0]] = True
    one, other = graph.edges[loops[0]]
    text = f"100 poses hang on the loop closure {one} → {other} alone"
    joined = with_edges(graph, rows)
    assert text in optimize_pose_graph(joined, **settings).doubt
    anchored = replace(joined, fixed=np.array([0, 199]))  # the file says where both are
    assert text not in (optimize_pose_graph(anchored, **settings).doubt or "")
    rows[loops[1:]] = True
    assert "alone" not in (optimize_pose_graph(with_edges(graph, rows), **settings).doubt or "")


def test_a_small_part_on_one_loop_closure_is_a_note():
    simulated = simulate_pose_graph(poses=200, loops=100, seed=0)
    graph = simulated.graph
    over = (graph.edges.min(axis=1) < 190) & (graph.edges.max(axis=1) >= 190)
    loops = np.flatnonzero(over & ~consecutive_edges(graph))
    rows = ~over
    rows[loops[0]] = True
    result = optimize_pose_graph(with_edges(graph, rows))
    assert result.doubt is None and any("10 poses hang on the loop closure" in note for note in result.notes)


@pytest.mark.parametrize("settings", [{"config": PoseGraphConfig(robust="gnc")}, {"loss": losses.GemanMcClure(3.0)}])
def test_nearly_all_loop_closures_refused_is_a_doubt(settings):
    simulated = simulate_pose_graph(poses=200, loops=100, seed=0)
    measured = simulated.graph.measurements.copy()
    measured[~simulated.is_loop, 1:] *= 1000.0  # odometry in millimetres
    result = optimize_pose_graph(replace(simulated.graph, measurements=measured), **settings)
    assert "of 100 loop closures were refused, and" in result.doubt


def test_lone_joints_are_found_in_any_number_of_pieces():
    """More than a hundred were not looked at, and a thousand took minutes."""
    pieces, each = 1000, 4
    ids = (np.arange(pieces)[:, None] * 10 + np.arange(each)).reshape(-1)
    first = np.arange(pieces) * each
    inside = np.concatenate([np.stack([first + k, first + k + 1], 1) for k in range(each - 1)])
    twice = np.concatenate([np.stack([first[:-1] + k, first[1:] + k], 1) for k in (0, 2)])
    middle = 2 * (first[1:] == first[pieces // 2])  # joined once where the others are joined twice
    edges = np.concatenate([inside, twice[np.tile(middle == 0, 2)], [[first[pieces // 2] - 2, first[pieces // 2] + 1]]])
    count = len(edges)
    graph = PoseGraph(2, ids, None, edges, np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1)), np.zeros(0, dtype=np.int64))
    (found,) = lone_joints(graph, consecutive_edges(graph))
    assert found.is_grave and found.sentence.startswith("2000 poses hang on the loop closure 4992 → 5001 alone")
    rows = np.r_[: len(inside) + pieces - 2, count - 1]  # every one of them joined once
    once = with_edges(graph, np.isin(np.arange(count), rows))
    (_, *rest) = lone_joints(once, consecutive_edges(once))
    assert len(rest) == 5 and rest[-1].sentence.startswith("994 more stretches of odometry hang on one loop closure each")
    assert not lone_joints(replace(graph, fixed=np.array([0, len(ids) - 1])), consecutive_edges(graph))


def test_a_narrow_loss_of_sound_edges_is_not_said_to_silence_them():
    graph = simulate_pose_graph(dimension=3, poses=100, loops=80, seed=2).graph
    result = optimize_pose_graph(graph, loss=losses.Cauchy(1.0))
    assert (result.weights < 0.1).mean() > 0.05
    assert result.notes == () and result.doubt is None
    assert result.fit.sentence.startswith("under this loss too few edges count")
