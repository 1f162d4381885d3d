"""Rotations that mean something else in poses or in edges: named, above all where no loop closure would contradict them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus import PoseGraph, optimize_pose_graph
from boxplus.manifolds import se2, se3
from boxplus.simulation.pose_graphs import simulate_pose_graph
from boxplus.systems.pose_graph.doubts.readings import misreading
from boxplus.systems.pose_graph.problem import consecutive_edges, with_edges

CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0, 1.0, 1.0, 1.0])


def chain(dimension: int, seed: int) -> PoseGraph:
    """Odometry alone, with the poses that it leads to: edges fit each other whatever they mean."""
    graph = simulate_pose_graph(dimension=dimension, poses=150, loops=30, seed=seed).graph
    part, group = with_edges(graph, consecutive_edges(graph)), se3 if dimension == 3 else se2
    poses = graph.poses.copy()
    for k, Z in enumerate(part.measurements[np.argsort(part.edges.min(axis=1))]):
        poses[k + 1] = group.compose(poses[k : k + 1], Z[None])[0]
    return replace(part, poses=poses)


def in_degrees(x: np.ndarray) -> np.ndarray:
    return np.column_stack([np.degrees(x[:, 0]), x[:, 1:]])


def w_last(x: np.ndarray) -> np.ndarray:
    return np.column_stack([x[:, [3, 0, 1, 2]], x[:, 4:]])


def inverted(x: np.ndarray) -> np.ndarray:
    return x * (CONJUGATE if x.shape[1] == 7 else np.array([-1.0, 1.0, 1.0]))


@pytest.mark.parametrize("seed", [1, 3])
@pytest.mark.parametrize(
    ("dimension", "changed", "cause"),
    [
        (2, in_degrees, "angles of the edges are taken for degrees"),
        (3, w_last, "quaternions of the edges are taken for qw qx qy qz"),
        (2, inverted, "rotations of the edges are taken for inverted"),
        (3, inverted, "rotations of the edges are taken for inverted"),
    ],
)
def test_rotations_of_the_edges_are_held_against_the_poses(dimension, changed, cause, seed):
    graph = chain(dimension, seed)
    result = optimize_pose_graph(replace(graph, measurements=changed(graph.measurements)))
    assert result.solution.status == "converged" and f" if {cause}: correct the file" in (result.doubt or "")


@pytest.mark.parametrize("dimension", [2, 3])
def test_rotations_that_are_inverted_everywhere_are_named(dimension):
    graph = chain(dimension, 5)
    spoiled = replace(graph, poses=inverted(graph.poses), measurements=inverted(graph.measurements))
    assert "if rotations of the poses are taken for inverted" in (optimize_pose_graph(spoiled).doubt or "")


@pytest.mark.parametrize("dimension", [2, 3])
def test_edges_along_the_axes_of_the_world_are_named(dimension):
    graph = chain(dimension, 7)
    i, j = graph.edges.T
    measured = graph.measurements.copy()
    measured[:, -dimension:] = graph.poses[j, -dimension:] - graph.poses[i, -dimension:]
    told = optimize_pose_graph(replace(graph, measurements=measured)).doubt or ""
    assert "if translations of the edges are taken for those along the axes of the world" in told


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("noise", [0.0, 0.02, 0.3])
def test_sound_files_are_not_doubted(dimension, noise):
    """With noisy turns, with whole turns more and with quaternions of either sign."""
    rng = np.random.default_rng(9)
    for graph in (
        chain(dimension, 9),
        simulate_pose_graph(dimension=dimension, poses=200, loops=30, seed=9, sigma_rotation=0.05).graph,
    ):
        measured = graph.measurements.copy()
        if dimension == 2:
            measured[:, 0] += noise * rng.standard_normal(len(measured)) + 2.0 * np.pi * rng.integers(-2, 3, len(measured))
        else:
            measured[:, 1:4] += 0.5 * noise * rng.standard_normal((len(measured), 3))
            measured[:, :4] *= rng.choice([-1.0, 1.0], (len(measured), 1)) / np.linalg.norm(measured[:, :4], axis=1)[:, None]
        assert misreading(replace(graph, measurements=measured), consecutive_edges(graph)) is None
