"""Many loop closures refused: rightly, or because loop closures and odometry were read as what they are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus import PoseGraphConfig, optimize_pose_graph
from boxplus.manifolds import se2
from boxplus.simulation.pose_graphs import SimulatedPoseGraph, simulate_pose_graph

GNC = PoseGraphConfig(robust="gnc")


@pytest.mark.parametrize("share", [0.8, 0.9])
@pytest.mark.parametrize("seed", [1, 3])
def test_few_true_loop_closures_that_confirm_each_other_are_believed(share, seed):
    simulated = simulate_pose_graph(poses=200, loops=100, false_share=share, seed=seed)
    result = optimize_pose_graph(simulated.graph, GNC)
    np.testing.assert_array_equal(result.loops.is_kept, ~simulated.is_false)
    assert result.doubt is None


def test_loop_closures_that_are_all_false_are_not():
    simulated = simulate_pose_graph(poses=500, loops=400, false_share=0.995, seed=1)
    assert "agree by chance" in optimize_pose_graph(simulated.graph, GNC).doubt


def _moved(simulated: SimulatedPoseGraph, rows: np.ndarray, change) -> SimulatedPoseGraph:
    measured = simulated.graph.measurements.copy()
    measured[rows] = change(measured[rows])
    return replace(simulated, graph=replace(simulated.graph, measurements=measured))


MISREAD = {
    "odometry in kilometres": lambda s: _moved(s, ~s.is_loop, lambda z: z * [1.0, 0.001, 0.001]),
    "loop closures in feet": lambda s: _moved(s, s.is_loop, lambda z: z * [1.0, 3.28, 3.28]),
    "loop closures the other way round": lambda s: _moved(s, s.is_loop, se2.inverse),
    "loop closures that turn the other way": lambda s: _moved(s, s.is_loop, lambda z: z * [-1.0, 1.0, 1.0]),
    "loop closures with y to the right": lambda s: _moved(s, s.is_loop, lambda z: z * [1.0, 1.0, -1.0]),
}


@pytest.mark.parametrize("name", MISREAD)
def test_loop_closures_and_odometry_that_differ_in_what_they_are_are_not_believed(name):
    simulated = MISREAD[name](simulate_pose_graph(poses=200, loops=100, seed=1))
    assert "loop closures were refused, and" in optimize_pose_graph(simulated.graph, GNC).doubt
