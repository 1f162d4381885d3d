"""Rotations that noise leaves open: local minima among them, and what is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus import PoseGraphConfig, optimize_pose_graph
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.simulation.pose_graphs import simulate_pose_graph
from boxplus.systems.pose_graph.problem import pose_graph_problem
from boxplus.systems.pose_graph.start import chordal_start

OPEN = "noise adds up along the edges"


def _ring(poses, deviation, seed=0):
    """One loop of steps that turn by the same, with noise in every turn [rad]."""
    rng = np.random.default_rng(seed)
    measured = np.tile([2.0 * np.pi / poses, 1.0, 0.0], (poses, 1)) + rng.normal(0.0, [deviation, 0.01, 0.01], (poses, 3))
    edges = np.column_stack([np.arange(poses), (np.arange(poses) + 1) % poses])
    information = np.tile(np.diag([deviation**-2, 1e4, 1e4]), (poses, 1, 1))
    return PoseGraph(2, np.arange(poses), None, edges, measured, information, np.array([0]))


def test_turns_that_noise_adds_up_to_are_told():
    told = [note for note in optimize_pose_graph(_ring(400, 0.15)).notes if OPEN in note]
    assert len(told) == 1 and "wound otherwise" in told[0]
    assert not any(OPEN in note for note in optimize_pose_graph(_ring(400, 0.03)).notes)


def test_information_that_is_too_small_opens_nothing():
    simulated = simulate_pose_graph(poses=300, loops=200, seed=1)
    small = replace(simulated.graph, information=1e-6 * simulated.graph.information)
    notes = optimize_pose_graph(small).notes
    assert any("the information is too small" in note for note in notes) and not any(OPEN in note for note in notes)


@pytest.mark.parametrize(("dimension", "poses", "seed"), [(3, 800, 1), (2, 800, 1), (2, 800, 9), (2, 400, 5)])
def test_minima_that_fit_although_they_are_local_are_left(dimension, poses, seed):
    simulated = simulate_pose_graph(
        dimension=dimension, poses=poses, loops=3 * poses // 40, sigma_rotation=0.3, seed=seed
    )  # few loops, which leave hardly an error in rotation
    problem, _ = pose_graph_problem(simulated.graph)
    best = problem.solve(start=[simulated.truth]).cost
    chordal = problem.solve(start=[chordal_start(simulated.graph)]).cost
    result = optimize_pose_graph(simulated.graph)
    assert chordal > 1.05 * best
    assert result.start == "cauchy" and result.chi2 < 2.002 * best
    assert any("local minima that fit" in note for note in result.notes)


def test_they_are_not_looked_at_where_nothing_is_examined():
    notes = optimize_pose_graph(_ring(400, 0.15), PoseGraphConfig(examine=False)).notes
    assert not any(OPEN in note for note in notes)
