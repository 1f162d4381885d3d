"""The symbolic part of an update against elimination on sets."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from boxplus.optimization.incremental.structure import eliminate_symbolically
from tests.sparse.orderings.test_clique_ordering import flat, graphs


@given(graphs(), st.integers(1, 3), st.data())
def test_cliques_hold_what_elimination_joins(graph: tuple[int, list[list[int]]], size: int, data: st.DataObject) -> None:
    n, cliques = graph
    is_last = np.array(data.draw(st.lists(st.booleans(), min_size=n, max_size=n)))
    order, first, parent, row_start, rows, owner = eliminate_symbolically(*flat(cliques), np.full(n, size), is_last)
    assert sorted(order) == list(range(n))
    position = np.empty(n, np.int64)
    position[order] = np.arange(n)
    near: list[set[int]] = [set() for _ in range(n)]  # in positions
    for clique in cliques:
        for a, b in itertools.permutations(position[clique].tolist(), 2):
            near[a].add(b)
    groups = len(parent)
    assert first[0] == 0
    assert first[groups] == n
    for g in range(groups):
        own, below = set(range(first[g], first[g + 1])), rows[row_start[g] : row_start[g + 1]].tolist()
        assert below == sorted(below)
        for p in range(first[g], first[g + 1]):
            later = {q for q in near[p] if q > p}
            assert later <= own | set(below)
            for a, b in itertools.permutations(later, 2):
                near[a].add(b)
        # Children hang on the group that eliminates the first of what lies below them, and hold nothing that it does not.
        assert (parent[g] == groups) == (not below)
        if below:
            up = parent[g]
            assert g < up
            assert first[up] <= below[0] < first[up + 1]
            assert set(below) <= set(range(first[up], first[up + 1])) | set(rows[row_start[up] : row_start[up + 1]].tolist())
    for clique, g in zip(cliques, owner, strict=True):
        assert first[g] <= min(position[clique]) < first[g + 1]
