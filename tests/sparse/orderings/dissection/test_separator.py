"""Separators: no edge between the halves, room in both, and near what is known of grids."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from boxplus.sparse.orderings.dissection.coarsening import Graph, coarsen
from boxplus.sparse.orderings.dissection.separator import SEPARATOR, refine, separate


def graph_of(count: int, edges: NDArray[np.int64], weight: NDArray[np.int64]) -> Graph:
    """Both directions of every edge, once."""
    dense = np.zeros((count, count), bool)
    for i, j in edges.reshape(-1, 2):
        dense[i, j] = dense[j, i] = i != j
    i, j = np.nonzero(dense)
    start = np.concatenate([[0], np.cumsum(dense.sum(axis=1))]).astype(np.int64)
    return Graph(start, j.astype(np.int32), np.ones(len(i), np.int32), weight.astype(np.int64))


def grid(*shape: int) -> Graph:
    node = np.arange(int(np.prod(shape))).reshape(shape)
    edges = [
        np.stack([np.moveaxis(node, axis, 0)[1:].ravel(), np.moveaxis(node, axis, 0)[:-1].ravel()], axis=1)
        for axis in range(len(shape))
    ]
    return graph_of(node.size, np.concatenate(edges), np.ones(node.size))


def dense(graph: Graph) -> NDArray[np.int64]:
    matrix = np.zeros((len(graph.weight),) * 2, np.int64)
    matrix[np.repeat(np.arange(len(graph.weight)), np.diff(graph.start)), graph.neighbours] = graph.edge_weight
    return matrix


@st.composite
def graphs(draw: st.DrawFn, most: int = 150) -> Graph:
    count = draw(st.integers(1, most))
    random = np.random.default_rng(draw(st.integers(0, 2**31)))
    edges = random.integers(0, count, (int(draw(st.floats(0.0, 3.0)) * count), 2))
    return graph_of(count, edges, random.integers(1, 8, count))


@given(graphs(), st.integers(0, 1000))
def test_no_edge_joins_the_halves(graph: Graph, seed: int) -> None:
    side = separate(graph, seed, 2)
    ends = np.repeat(side, np.diff(graph.start))
    assert side.shape == graph.weight.shape and side.max() <= SEPARATOR
    assert not ((ends == 0) & (side[graph.neighbours] == 1)).any()
    assert np.array_equal(side, separate(graph, seed, 2))


@given(graphs(60), st.integers(0, 1000))
def test_refining_makes_no_separator_heavier_and_none_a_half_too_heavy(graph: Graph, seed: int) -> None:
    side = np.random.default_rng(seed).integers(0, 2, len(graph.weight)).astype(np.uint8)
    crossing = np.repeat(side, np.diff(graph.start)) < side[graph.neighbours]
    side[np.repeat(np.arange(len(side)), np.diff(graph.start))[crossing]] = SEPARATOR
    before = np.bincount(side, graph.weight, 3)
    most = int(0.65 * graph.weight.sum())
    refine(graph.start, graph.neighbours, graph.weight, most, side)
    after = np.bincount(side, graph.weight, 3)
    assert after[2] <= before[2]
    assert after[:2].max() <= max(before[:2].max(), most)
    ends = np.repeat(side, np.diff(graph.start))
    assert not ((ends == 0) & (side[graph.neighbours] == 1)).any()


@given(graphs(), st.integers(0, 1000))
def test_coarsening_sums_nodes_and_edges(graph: Graph, seed: int) -> None:
    heaviest = 9
    coarse, into = coarsen(graph, heaviest, seed)
    gather = np.zeros((len(coarse.weight), len(graph.weight)), np.int64)
    gather[into, np.arange(len(into))] = 1
    summed = gather @ dense(graph) @ gather.T
    np.fill_diagonal(summed, 0)
    assert np.array_equal(coarse.weight, gather @ graph.weight)
    assert np.array_equal(dense(coarse), summed)
    pairs = gather.sum(axis=1) == 2
    assert gather.sum(axis=1).max() <= 2 and (coarse.weight[pairs] <= heaviest).all()


@pytest.mark.parametrize("shape", [(30, 30), (60, 15), (10, 10, 10), (400,)])
def test_separators_of_grids_are_hardly_larger_than_the_shortest_way_across(shape: tuple[int, ...]) -> None:
    side = separate(grid(*shape), 0, 8)
    shares = np.bincount(side, minlength=3)
    across = np.prod(sorted(shape)[:-1])
    assert shares[2] <= 1.1 * across
    assert max(shares[:2]) <= 0.65 * np.prod(shape)
