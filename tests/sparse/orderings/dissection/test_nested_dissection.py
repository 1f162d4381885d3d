"""Nested dissection: permutations that cost what the theory of grids promises. Exact costs: see test_ordering.py."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given

from boxplus.sparse.orderings.dissection.coarsening import Graph
from boxplus.sparse.orderings.dissection.nested_dissection import nested_dissection
from boxplus.sparse.orderings.ordering import order
from tests.sparse.orderings.dissection.test_separator import graphs, grid


@given(graphs())
def test_an_order_names_each_node_once_and_is_always_the_same(graph: Graph) -> None:
    permutation = nested_dissection(graph.start, graph.neighbours, graph.weight, 1)
    assert sorted(permutation) == list(range(len(graph.weight)))
    assert np.array_equal(permutation, nested_dissection(graph.start, graph.neighbours, graph.weight, 1))


def lower(graph: Graph) -> tuple[np.ndarray, np.ndarray]:
    column: np.ndarray = np.repeat(np.arange(len(graph.weight)), np.diff(graph.start))
    is_below = graph.neighbours > column
    return np.concatenate([[0], np.cumsum(np.bincount(column[is_below], minlength=len(graph.weight)))]), graph.neighbours[
        is_below
    ]


def geometric(box: list[tuple[int, int]], node: np.ndarray) -> list[int]:
    """George's order of a grid: the middle plane across the longest side last, what lies on either side of it before."""
    lengths = [end - begin for begin, end in box]
    if 0 in lengths:
        return []
    longest = int(np.argmax(lengths))
    if lengths[longest] <= 2:
        return node[tuple(slice(*ends) for ends in box)].ravel().tolist()
    begin, end = box[longest]
    middle = (begin + end) // 2
    parts = [[*box[:longest], ends, *box[longest + 1 :]] for ends in ((begin, middle), (middle + 1, end), (middle, middle + 1))]
    return geometric(parts[0], node) + geometric(parts[1], node) + node[tuple(slice(*ends) for ends in parts[2])].ravel().tolist()


@pytest.mark.parametrize("shape", [(60, 60), (120, 20), (12, 12, 12), (15, 15, 15)])
def test_an_order_costs_no_more_than_one_that_knows_where_the_nodes_of_a_grid_are(shape: tuple[int, ...]) -> None:
    graph = grid(*shape)
    start, row = lower(graph)
    known = np.array(geometric([(0, side) for side in shape], np.arange(len(graph.weight)).reshape(shape)))
    position = np.argsort(known)
    ends = position[np.stack([np.repeat(np.arange(len(known)), np.diff(start)), row])]
    edges = np.sort(ends, axis=0)[:, np.lexsort(np.sort(ends, axis=0)[::-1])]
    renamed = np.concatenate([[0], np.cumsum(np.bincount(edges[0], minlength=len(known)))]), edges[1]
    ours = order(start, row, graph.weight, "nested_dissection")
    assert ours.flops <= order(*renamed, graph.weight, "natural").flops
