"""Edges that all others contradict, odometry that is off as a whole, information that is wrong in parts, and loose arms."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus import PoseGraph, PoseGraphConfig, optimize_pose_graph
from boxplus.manifolds import se2, se3
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3
from boxplus.simulation.pose_graphs import simulate_pose_graph
from boxplus.sparse.graphs.components import connected_components
from boxplus.systems.pose_graph.doubts.arms import bridges_of
from boxplus.systems.pose_graph.doubts.reliability import Reliability
from boxplus.systems.pose_graph.problem import consecutive_edges, with_edges
from tests.systems.pose_graph.laps import laps

GNC = PoseGraphConfig(robust="gnc")


def slipped(graph: PoseGraph, edge: int, sigmas: float, seed: int) -> PoseGraph:
    """One measurement off by so many standard deviations, in a direction of chance."""
    manifold = SE3 if graph.dimension == 3 else SE2
    way = np.random.default_rng(seed).standard_normal(manifold.dof)
    way *= sigmas / np.sqrt(way @ graph.information[edge] @ way)
    measured = graph.measurements.copy()
    measured[edge] = manifold.boxplus(measured[edge : edge + 1], way[None])[0]
    return replace(graph, measurements=measured)


def row(count: int, loops: tuple[tuple[int, int], ...], seed: int, sigma: float = 0.01) -> PoseGraph:
    """A drive around a circle in the plane, with loop closures of one's choice."""
    rng = np.random.default_rng(seed)
    turn = np.arange(count) * 2.0 * np.pi / 20.0
    truth = np.stack([turn, 4.0 * np.sin(turn), 4.0 * (1.0 - np.cos(turn))], 1)
    edges = np.array([*((k, k + 1) for k in range(count - 1)), *loops])
    exact = se2.compose(se2.inverse(truth[edges[:, 0]]), truth[edges[:, 1]])
    measured = SE2.boxplus(exact, sigma * rng.standard_normal((len(edges), 3)))
    information = np.tile(np.eye(3) / sigma**2, (len(edges), 1, 1))
    return PoseGraph(2, np.arange(count), None, edges, measured, information, np.zeros(0, dtype=np.int64))


def stretch_of(told: str) -> tuple[int, int]:
    """The poses of the edge that is named, or of those that cannot be told from it."""
    found = re.search(r"from pose (\d+) to pose (\d+)", told) or re.search(r"contradict (\d+) → (\d+)", told)
    assert found is not None, told
    return int(found[1]), int(found[2])


@pytest.mark.parametrize("dimension", [2, 3])
def test_how_far_the_others_contradict_an_edge_is_what_the_cost_falls_by_without_it(dimension):
    graph = simulate_pose_graph(dimension=dimension, poses=60, loops=40, block=2, seed=2, sigma_rotation=0.002).graph
    result = optimize_pose_graph(graph)
    known = Reliability.of(graph, result.solution, result.poses)
    squared, directions = known.against.squared, known.against.directions
    full = PoseGraphConfig(start="file", examine=False)
    for edge in (0, 17, 41, 70, 90):
        rows = np.arange(len(graph.edges)) != edge
        without = optimize_pose_graph(with_edges(result.graph, rows), full)
        assert result.chi2 - without.chi2 == pytest.approx(squared[edge], rel=2e-2, abs=1e-3)
        if np.unique(graph.edges[rows]).size == len(graph.ids):
            assert directions[edge] == (6 if dimension == 3 else 3)


def test_edges_that_no_circle_passes_are_checked_by_nothing():
    graph = row(60, ((0, 20), (1, 21), (5, 24)), 1)
    result = optimize_pose_graph(graph)
    directions = Reliability.of(graph, result.solution, result.poses).against.directions
    assert (directions[24:59] == 0).all() and (directions[:24] == 3).all()
    assert result.checks.endswith("and not at all in 35, which no other checks")
    tree = optimize_pose_graph(row(30, (), 1))
    assert tree.checks == "no edge is checked by others" and tree.doubt is None and tree.notes == ()


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("robust", ["none", "gnc"])
def test_a_slip_that_the_steps_around_it_absorb_is_named(dimension, robust):
    config = PoseGraphConfig(robust=robust)
    for seed in (1, 3):
        graph = simulate_pose_graph(dimension=dimension, poses=200, seed=seed).graph
        sound = optimize_pose_graph(graph, config)
        assert sound.doubt is None and not any("contradict" in note for note in sound.notes)
        result = optimize_pose_graph(slipped(graph, 120, 30.0, seed), config)
        told = " ".join([result.doubt or "", *result.notes])
        first, last = stretch_of(told)
        assert first <= 120 < 121 <= last <= first + 40, told


def test_a_false_edge_among_many_is_named_without_a_robust_loss():
    graph = simulate_pose_graph(poses=300, seed=5).graph
    edges = graph.edges.copy()
    edges[350] = edges[350, ::-1]
    i, j = edges[350]
    result = optimize_pose_graph(replace(graph, edges=edges))
    assert f"all other edges contradict {i} → {j} by" in result.doubt


@pytest.mark.parametrize("dimension", [2, 3])
def test_odometry_whose_steps_are_too_long_is_named_with_its_scale(dimension):
    graph = simulate_pose_graph(dimension=dimension, poses=300, seed=3).graph
    measured = graph.measurements.copy()
    odometry = consecutive_edges(graph)
    measured[odometry, -dimension:] *= 1.05
    result = optimize_pose_graph(replace(graph, measurements=measured))
    assert "steps of the odometry are too long, in %, by 4." in result.doubt or "in %, by 5" in result.doubt
    corrected = measured.copy()
    corrected[odometry, -dimension:] /= 1.05
    assert "too long" not in (optimize_pose_graph(replace(graph, measurements=corrected)).doubt or "")


def test_odometry_that_turns_too_far_is_named_with_its_rate():
    graph = simulate_pose_graph(poses=300, seed=3).graph
    measured = graph.measurements.copy()
    measured[consecutive_edges(graph), 0] += np.radians(0.5)
    result = optimize_pose_graph(replace(graph, measurements=measured))
    told = " ".join([result.doubt or "", *result.notes])
    found = re.search(r"steps of the odometry turn too far, in degrees, by (\S+) ± (\S+),", told)
    assert found is not None and abs(float(found[1]) - 0.5) < 4.0 * float(found[2]) < 0.2


def test_information_that_is_wrong_in_parts_is_named():
    simulated = simulate_pose_graph(poses=300, seed=3)
    information = simulated.graph.information.copy()
    information[simulated.is_loop] *= 25.0
    information[~simulated.is_loop] /= 4.0
    result = optimize_pose_graph(replace(simulated.graph, information=information))
    assert "loop closures have" in (result.doubt or "") and "the weight between the two is wrong" in result.doubt


def test_what_hangs_on_odometry_that_slipped_is_told_by_the_loops_that_were_refused_for_it():
    loops = (*((k, k + 20) for k in range(12)), *((k, k + 20) for k in (36, 38)), *((k, k + 20) for k in range(45, 58)))
    for seed in (1, 2, 3):
        graph = row(80, loops, seed)
        sound = optimize_pose_graph(graph, GNC)
        assert sound.doubt is None and sound.notes == ()
        result = optimize_pose_graph(slipped(graph, 42, 100.0, seed), GNC)
        refused = graph.edges[~result.loops.is_kept]
        assert sorted(map(tuple, refused.tolist())) == [(36, 56), (38, 58)]
        assert "2 of 2 refused loop closures agree with each other that the" in result.doubt
        first, last = stretch_of(result.doubt)
        assert first <= 42 < 43 <= last
        assert not [note for note in result.notes if "confirmed" in note]


def test_edges_that_are_there_the_other_way_round_are_told():
    for dimension, group in ((2, se2), (3, se3)):
        graph = simulate_pose_graph(dimension=dimension, poses=200, seed=1).graph
        rows = np.array([3, 250])
        twice = replace(
            graph,
            edges=np.concatenate([graph.edges, graph.edges[rows, ::-1]]),
            measurements=np.concatenate([graph.measurements, group.inverse(graph.measurements[rows])]),
            information=np.concatenate([graph.information, graph.information[rows]]),
        )
        (note,) = [note for note in optimize_pose_graph(twice).notes if "there before" in note]
        assert note.startswith("2 of 401 edges are there before with the same measurement (2 of them the other way round)")


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 12), st.integers(0, 25), st.integers(0, 2**32 - 1))
def test_bridges_are_the_edges_that_hold_something_together(n, m, seed):
    rng = np.random.default_rng(seed)
    i, j = rng.integers(0, n, (2, m))
    i, j = i[i != j], j[i != j]
    child, place, last = bridges_of(n, i, j)
    pieces = connected_components(n, i, j)[0]
    for edge in range(len(i)):
        rest = np.arange(len(i)) != edge
        count, label = connected_components(n, i[rest], j[rest])
        assert (child[edge] >= 0) == (count > pieces)
        if child[edge] >= 0:
            below = (place >= place[child[edge]]) & (place <= last[child[edge]])
            assert np.array_equal(below, label == label[child[edge]])


@pytest.mark.parametrize("count", [21, 35, 60])
def test_a_single_loop_that_does_not_close_is_not_to_be_trusted_whatever_rounding_leaves(count):
    for seed in range(6):
        graph = row(count, ((0, count - 1),), seed)
        assert optimize_pose_graph(graph).doubt is None
        wrong = slipped(graph, len(graph.edges) - 1, 200.0, seed)
        assert "all other edges contradict" in (optimize_pose_graph(wrong).doubt or "")


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_a_length_that_loops_at_the_same_place_do_not_tell_is_not_told(seed):
    """Laps of which every pose comes back to that of the lap before: a scale moves no loop, but for the noise of the result."""
    result = optimize_pose_graph(laps(0.12, seed))
    assert result.doubt is None and not result.notes
