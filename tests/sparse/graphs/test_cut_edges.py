"""Edges that hold a graph together alone, against taking out one after the other."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from boxplus.sparse.graphs.components import connected_components
from boxplus.sparse.graphs.cut_edges import cut_edges


@given(seed=st.integers(0, 10**6), count=st.integers(1, 25), edges=st.integers(0, 40))
def test_cut_edges_are_those_without_which_a_component_falls_apart(seed: int, count: int, edges: int) -> None:
    random = np.random.default_rng(seed)
    i, j = random.integers(0, count, (2, edges))  # some parallel, some from a node to itself
    weights = random.integers(0, 9, count)
    whole, expected = connected_components(count, i, j)[0], {}
    for k in range(edges):
        rest = np.arange(edges) != k
        pieces, side = connected_components(count, i[rest], j[rest])
        if pieces > whole:
            expected[k] = min(weights[side == side[end]].sum() for end in (i[k], j[k]))
    found, lighter = cut_edges(i, j, weights)
    assert dict(zip(found, lighter, strict=True)) == expected


def test_a_chain_longer_than_any_stack_is_cut_everywhere() -> None:
    n = 200_000
    found, lighter = cut_edges(np.arange(n - 1), np.arange(1, n), np.ones(n, dtype=np.int64))
    np.testing.assert_array_equal(found, np.arange(n - 1))
    np.testing.assert_array_equal(lighter, np.minimum(np.arange(1, n), np.arange(n - 1, 0, -1)))
