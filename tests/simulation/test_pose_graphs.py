"""Simulated pose graphs: what is claimed of them holds."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus import SE2, SE3, InputError
from boxplus.manifolds import se2, se3
from boxplus.simulation.pose_graphs import GraphSimulationConfig, simulate_pose_graph, without_false_loops

GROUP = {2: (SE2, se2), 3: (SE3, se3)}


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("kind", ["random", "clustered", "mixed"])
def test_true_edges_have_the_stated_noise_and_false_ones_lie_far_off(dimension, kind):
    simulated = simulate_pose_graph(dimension=dimension, poses=600, false_share=0.4, false_kind=kind, seed=2)
    graph, truth = simulated.graph, simulated.truth
    manifold, group = GROUP[dimension]
    i, j = graph.edges.T
    error = manifold.boxminus(group.compose(group.inverse(truth[i]), truth[j]), graph.measurements)
    squares = np.einsum("na,nab,nb->n", error, graph.information, error)
    assert squares[~simulated.is_false].mean() == pytest.approx(manifold.dof, rel=0.05)
    assert (squares[simulated.is_false] > 100.0).mean() > 0.95
    assert simulated.is_false.sum() == 240 and simulated.is_loop.sum() == 600
    assert (j[~simulated.is_loop] - i[~simulated.is_loop] == 1).all() and (j - i)[simulated.is_loop].min() > 20
    np.testing.assert_array_equal(graph.poses[0], truth[0])
    assert len(without_false_loops(simulated).edges) == len(graph.edges) - 240


def test_clusters_agree_with_each_other():
    simulated = simulate_pose_graph(poses=600, loops=100, false_share=0.4, false_kind="clustered", cluster=10, seed=5)
    graph, truth = simulated.graph, simulated.truth
    rows = np.flatnonzero(simulated.is_false)
    i, j = graph.edges[rows].T
    # Where every false loop would put the world of j: the same for all of a cluster but for the noise of a measurement.
    moved = se2.compose(se2.compose(truth[i], graph.measurements[rows]), se2.inverse(truth[j]))
    gap = j - i
    for value in np.unique(gap):
        if np.count_nonzero(gap == value) >= 10:
            assert np.ptp(moved[gap == value][:, 0]) < 0.1
    assert max(np.count_nonzero(gap == value) for value in np.unique(gap)) >= 10


def test_same_settings_give_the_same_bits_and_another_seed_does_not():
    one, two, other = (simulate_pose_graph(GraphSimulationConfig(poses=100, seed=seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.graph.measurements, two.graph.measurements)
    assert not np.array_equal(one.truth, other.truth)


def test_wrong_use_is_refused():
    with pytest.raises(InputError, match="a configuration or single settings"):
        simulate_pose_graph(GraphSimulationConfig(), poses=50)
    with pytest.raises(InputError, match="ask for fewer loops"):
        simulate_pose_graph(poses=30, loops=500)
