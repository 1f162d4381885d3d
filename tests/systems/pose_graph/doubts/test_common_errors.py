"""What all loop closures are off by in common: named with its size and weighed, and nothing of the kind in sound graphs."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from boxplus import PoseGraph, PoseGraphConfig, optimize_pose_graph
from boxplus.manifolds import se2, se3
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3
from boxplus.simulation.pose_graphs import SimulatedPoseGraph, simulate_pose_graph
from boxplus.systems.pose_graph.problem import consecutive_edges
from tests.systems.pose_graph.laps import laps

ANY = "loop closures end beside|loop closures are of"


def walk(dimension: int, seed: int) -> SimulatedPoseGraph:
    return simulate_pose_graph(dimension=dimension, poses=300, loops=200, seed=seed)


def moved(made: SimulatedPoseGraph, kind: str, size: float) -> PoseGraph:
    """All loop closures off by the same."""
    graph = made.graph
    manifold, group = (SE3, se3) if graph.dimension == 3 else (SE2, se2)
    loops = ~consecutive_edges(graph)
    measured, (i, j) = graph.measurements.copy(), graph.edges[loops].T
    one = np.zeros((len(made.truth), manifold.dof))
    if kind == "lag":
        one[:-1] = manifold.boxminus(made.truth[1:], made.truth[:-1])
    else:  # a turn about the last axis, or a shift along the first
        one[:, {"turn": 0 if graph.dimension == 2 else 2}.get(kind, manifold.dof - graph.dimension)] = 1.0
    if kind in ("lag", "frame"):
        start = manifold.boxplus(made.truth[i], size * one[i])
        end = manifold.boxplus(made.truth[j], size * one[j])
        exact = group.compose(group.inverse(made.truth[i]), made.truth[j])
        noise = manifold.boxminus(measured[loops], exact)
        measured[loops] = manifold.boxplus(group.compose(group.inverse(start), end), noise)
    else:
        measured[loops] = manifold.boxplus(measured[loops], size * one[j])
    return replace(graph, measurements=measured)


NAMES = {
    "shift": ("loop closures end beside along x, in m, by", 1.0),
    "turn": ("loop closures end beside(?:, in heading| about z), in degrees, by", np.degrees(1.0)),
    "frame": ("loop closures are of another body frame than the odometry, shifted along x, in m, by", 1.0),
    "lag": ("loop closures are of later poses than those they join, in steps of the odometry, by", 1.0),
}


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(("kind", "size"), [("shift", 0.1), ("turn", 0.02), ("frame", 0.2), ("frame", -0.3), ("lag", 0.3)])
def test_what_loop_closures_share_is_named_with_its_size(dimension, kind, size):
    graph = moved(walk(dimension, 3), kind, size)
    result = optimize_pose_graph(graph)
    name, unit = NAMES[kind]
    found = re.search(rf"{name} (-?[\d.]+) ± ([\d.]+)", f"{result.doubt} {result.notes}")
    assert found is not None, (result.doubt, result.notes)
    told, deviation = float(found[1]), float(found[2])
    # Shapes are those of small errors, by poses that the error has bent.
    assert told == pytest.approx(unit * size, abs=4.0 * deviation + 0.15 * unit * abs(size))


@pytest.mark.parametrize("dimension", [2, 3])
def test_one_that_bends_the_result_is_not_to_be_trusted(dimension):
    result = optimize_pose_graph(moved(walk(dimension, 5), "turn", 0.05))
    assert result.solution.status == "converged" and re.search(NAMES["turn"][0], result.doubt or "")


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("seed", [1, 3, 5, 7])
def test_sound_loop_closures_share_nothing(dimension, seed):
    for config in (PoseGraphConfig(), PoseGraphConfig(robust="gnc")):
        result = optimize_pose_graph(walk(dimension, seed).graph, config)
        assert not re.search(ANY, f"{result.doubt} {result.notes}")


@pytest.mark.parametrize("seed", [8, 9, 10, 11])
def test_noise_that_turns_poses_is_no_common_error(seed):
    """Most of a shift along these laps is a longer way: what the poses leave of it by their own turns is as large as it."""
    result = optimize_pose_graph(laps(0.2, seed))
    assert not re.search(ANY, f"{result.doubt} {result.notes}")


def test_a_longer_way_is_told_of_the_odometry_first():
    """Of loop closures that end beside, some explain nearly as well what steps that are too long do."""
    made = walk(2, 3)
    measured = made.graph.measurements.copy()
    measured[consecutive_edges(made.graph), 1:] *= 1.05
    told = optimize_pose_graph(replace(made.graph, measurements=measured)).doubt
    assert told is not None and "steps of the odometry are too long, in %, by" in told


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_pose_on_a_weak_edge_hides_nothing_of_it(dimension):
    """Nothing turns with it but itself; with all poses averaged, it turned them all."""
    graph = moved(walk(dimension, 3), "turn", 0.02)
    last, d = int(graph.ids.max()), graph.measurements.shape[1] - (1 if dimension == 3 else 0)
    hanging = replace(
        graph,
        ids=np.append(graph.ids, last + 1),
        poses=None if graph.poses is None else np.concatenate([graph.poses, graph.poses[-1:]]),
        edges=np.vstack([graph.edges, [[len(graph.ids) - 1, len(graph.ids)]]]),
        measurements=np.concatenate([graph.measurements, graph.measurements[:1]]),
        information=np.concatenate([graph.information, 1e-6 * np.eye(d)[None]]),
    )
    told = optimize_pose_graph(hanging)
    assert re.search(NAMES["turn"][0], f"{told.doubt} {' '.join(told.notes)}")
