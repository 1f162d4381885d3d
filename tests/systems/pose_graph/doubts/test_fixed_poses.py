"""Poses that the file fixes, held against what the edges say of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus import PoseGraphConfig, losses, optimize_pose_graph
from boxplus.simulation.pose_graphs import simulate_pose_graph

GNC = PoseGraphConfig(robust="gnc")
WAYS = [(None, None), (GNC, None), (None, losses.Huber(1.345)), (None, losses.GemanMcClure(3.0))]


def _fixed(seed, dimension=2, at=(0, 120), off=0.0):
    """A walk, some poses of which are fixed where they are, the last of these `off` m away."""
    simulated = simulate_pose_graph(dimension=dimension, poses=200, loops=100, seed=seed)
    poses = simulated.truth.copy()
    poses[at[-1], -1] += off
    return replace(simulated.graph, poses=poses, fixed=np.array(at, dtype=np.int64))


@pytest.mark.parametrize(("config", "loss"), WAYS)
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_pose_that_is_fixed_in_the_wrong_place_is_told(config, loss, dimension):
    result = optimize_pose_graph(_fixed(1, dimension, off={2: 1.0, 3: 3.0}[dimension]), config, loss=loss)
    assert "the edges contradict the poses that the file fixes: as seen from pose 0 they put pose 120" in result.doubt


@pytest.mark.parametrize(("config", "loss"), WAYS)
@pytest.mark.parametrize("at", [(0, 120), (0, 1, 2), (3, 50, 100, 150, 199)])
@pytest.mark.parametrize("seed", range(3))
def test_poses_that_are_fixed_where_they_are_are_believed(config, loss, at, seed):
    assert optimize_pose_graph(_fixed(seed, at=at), config, loss=loss).doubt is None


@pytest.mark.parametrize("seed", range(3))
def test_the_fixed_pose_is_named_that_stands_against_the_others(seed):
    graph = _fixed(seed, at=(0, 60, 120, 180))
    for moved in (0, 120):
        poses = graph.poses.copy()
        poses[moved, 1] += 2.0
        doubt = optimize_pose_graph(replace(graph, poses=poses)).doubt
        assert f"as seen from the other fixed poses they put pose {moved} " in doubt and "more elsewhere" in doubt


@pytest.mark.parametrize(("config", "loss"), WAYS[:2])
def test_a_fixed_pose_that_its_neighbours_contradict_is_told_however_far_the_first_is(config, loss):
    """The first, through 150 noisy turns, knows less of it than it is off by."""
    simulated = simulate_pose_graph(dimension=3, poses=300, loops=10, seed=1, sigma_rotation=0.05)
    for off, is_told in ((0.0, False), (4.0, True)):
        poses = simulated.truth.copy()
        poses[150, -1] += off
        graph = replace(simulated.graph, poses=poses, fixed=np.arange(0, 300, 15))
        doubt = optimize_pose_graph(graph, config, loss=loss).doubt or ""
        assert ("as seen from the other fixed poses they put pose 150" in doubt) == is_told


@pytest.mark.parametrize("seed", [1136, 1141, 1241])
def test_where_rotations_bend_a_lot_a_fixed_pose_is_asked_about_by_a_solve(seed):
    """To first order the edges put one of these 87 to 110 deg off, by more than 6 standard deviations: it is 17 to 60 deg."""
    simulated = simulate_pose_graph(dimension=3, poses=150, loops=10, seed=seed, sigma_rotation=0.2)
    graph = replace(simulated.graph, poses=simulated.truth, fixed=np.arange(0, 150, 5))
    assert optimize_pose_graph(graph, PoseGraphConfig(start="file")).doubt is None


def test_information_that_is_too_large_contradicts_no_fixed_pose():
    graph = _fixed(2)
    result = optimize_pose_graph(replace(graph, information=9.0 * graph.information))
    assert "fixes" not in (result.doubt or "")


def test_nothing_is_asked_of_pieces_that_fixed_poses_alone_hold():
    graph = _fixed(1, off=1.0)
    apart = (graph.edges < 60).all(axis=1) | (graph.edges >= 60).all(axis=1)
    pieces = replace(
        graph, edges=graph.edges[apart], measurements=graph.measurements[apart], information=graph.information[apart]
    )
    assert "the edges contradict the poses that the file fixes" not in (optimize_pose_graph(pieces).doubt or "")
