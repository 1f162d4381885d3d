"""Information that was given in another unit, or as covariances, and poses of a mirrored world: named, and pessimism is not."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.simulation.pose_graphs import simulate_pose_graph
from boxplus.systems.pose_graph.pose_graph import optimize_pose_graph

SEEDS = (1, 3, 5)


def graph_of(dimension: int, seed: int) -> PoseGraph:
    return simulate_pose_graph(dimension=dimension, poses=200, loops=100, seed=seed).graph


def scaled(graph: PoseGraph, rotation: float, translation: float) -> PoseGraph:
    """With standard deviations in units that are so many times smaller."""
    dim = graph.information.shape[1]
    scale = np.where(np.arange(dim) < (3 if dim == 6 else 1), 1.0 / rotation, 1.0 / translation)
    return replace(graph, information=graph.information * np.outer(scale, scale))


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("seed", SEEDS)
def test_information_in_another_unit_or_inverted_is_named(dimension: int, seed: int) -> None:
    graph = graph_of(dimension, seed)
    assert optimize_pose_graph(graph).doubt is None
    for wrong, told in (
        (scaled(graph, np.degrees(1.0), 1.0), "if the information of rotations is per square degree: give it per square radian"),
        (scaled(graph, 1.0, 1e3), "if the information of translations is per square millimetre: give it per square metre"),
        (replace(graph, information=np.linalg.inv(graph.information)), "if they are covariances: give their inverses"),
    ):
        assert told in (optimize_pose_graph(wrong).doubt or "")


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("seed", SEEDS)
def test_units_of_both_and_of_covariances_are_named(dimension: int, seed: int) -> None:
    graph = graph_of(dimension, seed)
    both, degrees = scaled(graph, np.degrees(1.0), 1e3), scaled(graph, np.degrees(1.0), 1.0)
    for wrong, told in (
        (
            both,
            "rotations is per square degree and that of translations per square millimetre: give it per square radian and square",
        ),
        (scaled(graph, 1e3, 1.0), "if the information of rotations is per square milliradian: give it per square radian"),
        (
            replace(graph, information=np.linalg.inv(both.information)),
            "if they are covariances, of rotations in square degrees, of translations in square millimetres: give their",
        ),
        (
            replace(graph, information=np.linalg.inv(degrees.information)),
            "if they are covariances, of rotations in square degrees:",
        ),
    ):
        assert told in (optimize_pose_graph(wrong).doubt or "")


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("seed", SEEDS)
def test_translations_that_err_by_less_than_was_said_are_told_of(dimension: int, seed: int) -> None:
    """All together errors are as promised, as rotations are."""
    graph = graph_of(dimension, seed)
    assert not [note for note in optimize_pose_graph(graph).notes if "promise" in note]
    (note,) = [note for note in optimize_pose_graph(scaled(graph, 1.0, 100.0)).notes if "promise" in note]
    told = re.search(
        r"information of translations is too small, their standard deviations are too large by a factor of (\S+),", note
    )
    assert 70.0 < float(told[1]) < 140.0


@pytest.mark.parametrize("dimension", [2, 3])
def test_translations_that_stand_in_for_imprecise_rotations_are_as_promised(dimension: int) -> None:
    """Positions of a few loops are all that holds such headings: hardly any redundancy of translations is left."""
    graph = simulate_pose_graph(
        dimension=dimension, poses=200, loops=40, seed=11, sigma_rotation=0.3, sigma_translation=0.01
    ).graph
    assert not [note for note in optimize_pose_graph(graph).notes if "promise" in note]


@pytest.mark.parametrize("loops", [20, 50])
@pytest.mark.parametrize("dimension", [2, 3])
def test_of_several_readings_the_best_is_named(dimension: int, loops: int) -> None:
    """Where rotations are imprecise, information and its inverse are alike but for units."""
    graph = simulate_pose_graph(
        dimension=dimension, poses=200, loops=loops, seed=12, sigma_rotation=0.1, sigma_translation=0.05
    ).graph
    degrees = scaled(graph, np.degrees(1.0), 1.0)
    for wrong, told in (
        (scaled(graph, 1.0, 1e3), "if the information of translations is per square millimetre: give it per square metre"),
        (replace(graph, information=np.linalg.inv(graph.information)), "if they are covariances: give their inverses"),
        (
            replace(graph, information=np.linalg.inv(degrees.information)),
            "if they are covariances, of rotations in square degrees:",
        ),
    ):
        assert told in (optimize_pose_graph(wrong).doubt or "")


def test_axes_without_any_error_say_nothing_of_the_others() -> None:
    """A graph of a plane in space, whose heights and tilts are exact: its headings are somewhat better than was said."""
    plane = simulate_pose_graph(dimension=2, poses=200, loops=100, seed=4).graph

    def lifted(poses: np.ndarray) -> np.ndarray:
        q = np.column_stack([np.cos(poses[:, 0] / 2.0), np.zeros((len(poses), 2)), np.sin(poses[:, 0] / 2.0)])
        return np.column_stack([q, poses[:, 1:], np.zeros(len(poses))])

    information = np.zeros((len(plane.edges), 6, 6))
    for own, there in enumerate((2, 3, 4)):
        information[:, there, there] = plane.information[:, own, own]
    information[:, [0, 1, 5], [0, 1, 5]] = 1e4
    information[:, 2, 2] /= 1.8**2
    graph = replace(
        plane,
        dimension=3,
        poses=lifted(plane.poses),
        measurements=lifted(plane.measurements),
        information=information,
    )
    result = optimize_pose_graph(graph)
    assert result.doubt is None and not [note for note in result.notes if "χ² of rotations" in note]


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(
    ("rotation", "translation"), [(3.0, 3.0), (10.0, 10.0), (3.0, 1.0), (1.0, 5.0), (10.0, 1.0), (1.0, 100.0)]
)
def test_information_that_is_too_small_is_no_other_unit(dimension: int, rotation: float, translation: float) -> None:
    for seed in SEEDS:
        assert optimize_pose_graph(scaled(graph_of(dimension, seed), rotation, translation)).doubt is None


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("axis", [0, 1])
def test_poses_of_a_mirrored_world_are_named(dimension: int, axis: int) -> None:
    """Edges of a mirrored world fit each other as well as the true ones: only the poses of the file know."""
    graph = graph_of(dimension, 1)
    poses = graph.poses.copy()
    if dimension == 2:
        poses[:, 1 + axis] *= -1.0
        poses[:, 0] *= -1.0
    else:
        poses[:, 4 + axis] *= -1.0
        poses[:, [k for k in (1, 2, 3) if k != 1 + axis]] *= -1.0
    told = optimize_pose_graph(replace(graph, poses=poses)).doubt or ""
    assert f"if the {'xy'[axis]} axis of the poses is taken for flipped" in told
