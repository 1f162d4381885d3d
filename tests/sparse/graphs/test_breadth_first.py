"""Spanning trees whose branches are as short as can be, against the distances that SciPy finds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, shortest_path

from boxplus.sparse.graphs.breadth_first import breadth_first_trees


@pytest.mark.parametrize("seed", range(20))
def test_every_node_is_reached_by_as_few_edges_as_can_be(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 40))
    edges = rng.integers(0, count, (int(rng.integers(1, 80)), 2))
    edges = np.concatenate([edges[edges[:, 0] != edges[:, 1]], [[0, 1]]])
    links = coo_array((np.ones(len(edges)), tuple(edges.T)), shape=(count, count)).tocsr()
    label = connected_components(links, directed=False)[1]
    is_known = rng.random(count) < 0.1
    is_known[np.unique(label, return_index=True)[1]] = True
    roots = np.array([np.flatnonzero(is_known & (label == one))[0] for one in range(label.max() + 1)])
    child, parent, edge = breadth_first_trees(edges, is_known)
    np.testing.assert_array_equal(np.sort(child), np.flatnonzero(~is_known))
    np.testing.assert_array_equal(np.sort(edges[edge], axis=1), np.sort(np.stack([child, parent], 1), axis=1))
    away = shortest_path(links, directed=False, unweighted=True)[roots[label], np.arange(count)]
    np.testing.assert_array_equal(away[child], away[parent] + 1)
    place = np.full(count, -1)
    place[child] = np.arange(len(child))
    assert (place[parent] < np.arange(len(child))).all()  # parents come before their children


def test_of_parallel_edges_the_last_one_stands() -> None:
    edges = np.array([[0, 1], [1, 2], [1, 0], [2, 1]])
    child, parent, edge = breadth_first_trees(edges, np.array([True, False, False]))
    np.testing.assert_array_equal(np.stack([child, parent, edge]), [[1, 2], [0, 1], [2, 3]])
