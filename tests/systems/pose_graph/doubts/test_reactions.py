"""What the other fixed poses say of each, held against solves in which it is let go."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus import PoseGraphConfig, optimize_pose_graph
from boxplus._chi_square import chi_square_sf
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3
from boxplus.simulation.pose_graphs import simulate_pose_graph
from boxplus.systems.pose_graph.doubts.reactions import Reactions
from boxplus.systems.pose_graph.problem import pose_graph_problem

OPTIONS = PoseGraphConfig().solver


def _held(seed, dimension, fixed, **settings):
    """A walk with fixed poses where they are, at its minimum."""
    simulated = simulate_pose_graph(**{"dimension": dimension, "poses": 200, "loops": 60, "seed": seed} | settings)
    graph = replace(simulated.graph, poses=simulated.truth, fixed=np.array(fixed, dtype=np.int64))
    return optimize_pose_graph(graph, PoseGraphConfig(examine=False, start="file")).graph


@pytest.mark.parametrize("dimension", [2, 3])
def test_each_pose_is_put_where_a_solve_without_it_puts_it(dimension):
    graph = _held(1, dimension, [0, 40, 41, 90, 150], sigma_rotation=1e-4, sigma_translation=1e-3)
    found, manifold = Reactions.of(graph, OPTIONS), SE3 if dimension == 3 else SE2
    for row, off, squared in zip(found.rows, found.off, found.squared, strict=True):
        problem, poses = pose_graph_problem(replace(graph, fixed=np.setdiff1d(graph.fixed, [row])))
        solution = problem.solve(OPTIONS)
        there = manifold.boxminus(solution.values[0][[row]], graph.poses[[row]])[0]
        P = solution.covariance(poses[[row]])[0]
        apart = off - there  # the springs of the others give way by a thirtieth
        assert apart @ np.linalg.solve(P, apart) < 0.1**2 * max(squared, 1.0)
        np.testing.assert_allclose(squared, there @ np.linalg.solve(P, there), rtol=0.1)


@pytest.mark.parametrize("dimension", [2, 3])
def test_squares_of_sound_graphs_are_distributed_as_they_say(dimension):
    chances = []
    for seed in range(6):
        found = Reactions.of(_held(seed, dimension, range(0, 200, 10)), OPTIONS)
        chances += [chi_square_sf(*pair) for pair in zip(found.squared, found.directions.tolist(), strict=True)]
    assert abs(np.mean(np.array(chances) < 0.5) - 0.5) < 0.15
    assert min(chances) > 1e-4


def test_directions_that_no_edge_measures_are_not_judged():
    graph = _held(2, 2, range(0, 200, 25))
    touched = (graph.edges == 0).any(axis=1)
    alone = replace(graph, information=np.where(touched[:, None, None], np.diag([4e4, 0.0, 0.0]), graph.information))
    found = Reactions.of(alone, OPTIONS)
    assert found.directions.tolist() == [1] + 7 * [3]
    assert np.isfinite(found.off).all() and np.abs(found.off[0, 1:]).max() < 1e-6


def test_two_fixed_poses_of_a_piece_say_nothing_beyond_each_other():
    assert Reactions.of(_held(0, 2, [0, 100]), OPTIONS) is None
