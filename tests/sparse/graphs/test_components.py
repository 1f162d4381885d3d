"""Components of graphs, against scipy's."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components as oracle

from boxplus.sparse.graphs.components import connected_components


@given(seed=st.integers(0, 10**6), count=st.integers(1, 40), edges=st.integers(0, 40))
def test_components_are_numbered_by_their_first_nodes(seed: int, count: int, edges: int) -> None:
    i, j = np.random.default_rng(seed).integers(0, count, (2, edges))
    found, label = connected_components(count, i, j)
    expected, labels = oracle(coo_array((np.ones(edges), (i, j)), shape=(count, count)), directed=False)
    assert found == expected
    np.testing.assert_array_equal(label, labels)
    _, first = np.unique(label, return_index=True)
    assert (np.diff(first) > 0).all()


def test_no_nodes_have_no_components() -> None:
    none = np.zeros(0, dtype=np.int64)
    found, label = connected_components(0, none, none)
    assert found == 0 and len(label) == 0
