"""Minimum degree on cliques: a permutation that keeps what comes last, and hardly more fill than on the graph itself."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from boxplus.sparse.orderings.clique_ordering import order_cliques
from boxplus.sparse.orderings.minimum_degree import minimum_degree


def flat(cliques: list[list[int]]) -> tuple[np.ndarray, np.ndarray]:
    start = np.cumsum([0, *(len(clique) for clique in cliques)])
    return start, np.array([v for clique in cliques for v in clique], np.int64)


def fill(n: int, cliques: list[list[int]], order: np.ndarray) -> int:
    """Edges of the filled graph, by elimination on sets."""
    near: list[set[int]] = [set() for _ in range(n)]
    for clique in cliques:
        for v in clique:
            near[v] |= set(clique) - {v}
    total = 0
    for v in order:
        total += len(near[v])
        for a, b in itertools.permutations(near[v], 2):
            near[a].add(b)
        for a in near[v]:
            near[a].discard(int(v))
    return total


@st.composite
def graphs(draw: st.DrawFn) -> tuple[int, list[list[int]]]:
    n = draw(st.integers(1, 14))
    subset = st.lists(st.integers(0, n - 1), min_size=1, max_size=5, unique=True)
    return n, draw(st.lists(subset, max_size=20))


@given(graphs(), st.data())
def test_it_is_a_permutation_with_the_last_ones_last(graph: tuple[int, list[list[int]]], data: st.DataObject) -> None:
    n, cliques = graph
    is_last = np.array(data.draw(st.lists(st.booleans(), min_size=n, max_size=n)))
    order = order_cliques(*flat(cliques), np.full(n, 3), is_last)
    assert sorted(order) == list(range(n))
    assert list(order[n - is_last.sum() :]) == list(np.flatnonzero(is_last))


@given(st.integers(0, 50))
def test_a_tree_is_eliminated_without_fill(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 20
    edges = [[int(rng.integers(k)), k] for k in range(1, n)]
    order = order_cliques(*flat(edges), np.full(n, 2), np.zeros(n, np.bool_))
    assert fill(n, edges, order) == n - 1


def test_fill_is_that_of_minimum_degree_on_the_graph() -> None:
    side = 12
    number = np.arange(side * side).reshape(side, side)
    pairs = np.concatenate([np.stack([number[:-1], number[1:]], -1), np.stack([number[:, :-1].T, number[:, 1:].T], -1)])
    edges = pairs.reshape(-1, 2).tolist()
    n = side * side
    near = [sorted({b for a, b in edges if a == v} | {a for a, b in edges if b == v}) for v in range(n)]
    start = np.cumsum([0, *(len(one) for one in near)])
    graph = np.array([v for one in near for v in one], np.int32)
    sizes = np.ones(n, np.int64)
    direct = fill(n, edges, minimum_degree(start, graph, sizes))
    assert fill(n, edges, order_cliques(*flat(edges), sizes, np.zeros(n, np.bool_))) <= 1.1 * direct
