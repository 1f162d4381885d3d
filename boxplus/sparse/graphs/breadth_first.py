"""Spanning trees of a graph whose branches are as short as can be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

Indices = NDArray[np.int64]


def breadth_first_trees(edges: Indices, is_known: NDArray[np.bool_]) -> tuple[Indices, Indices, Indices]:
    """Breadth-first trees from the first known node of every component, neighbours in the order of their numbers.

    Args:
        edges: (m, 2) nodes that are joined; of parallel edges the last one stands.
        is_known: (n,) nodes that need not be reached, one of which at least has to lie in every component.

    Returns:
        (child, parent, edge), each (k,): the nodes that are reached and not known, in the order they are reached in, from
        which node and by which edge.
    """
    child, parent, edge = (np.empty(len(is_known), np.int64) for _ in range(3))
    count = _grow(edges, is_known, child, parent, edge)
    return child[:count], parent[:count], edge[:count]


@kernel
def _grow(edges: Indices, is_known: NDArray[np.bool_], child: Indices, parent: Indices, edge: Indices) -> int:
    """Fill the trees of `breadth_first_trees` in; returns how many nodes are reached."""
    n, m = len(is_known), edges.shape[0]
    begin = np.zeros(n + 1, np.int64)
    for e in range(m):
        begin[edges[e, 0] + 1] += 1
        begin[edges[e, 1] + 1] += 1
    for node in range(n):
        begin[node + 1] += begin[node]
    # Sorted twice, first by the one end and then by the other: neighbours ascend, and parallel edges stay as they are.
    by_end, at = np.empty(2 * m, np.int64), begin[:n].copy()
    for e in range(m):
        for side in range(2):
            node = edges[e, side]
            by_end[at[node]] = 2 * e + side
            at[node] += 1
    incident, at = np.empty(2 * m, np.int64), begin[:n].copy()
    for k in range(2 * m):
        e, side = by_end[k] // 2, by_end[k] % 2
        node = edges[e, 1 - side]
        incident[at[node]] = by_end[k]
        at[node] += 1
    is_reached, queue = np.zeros(n, np.bool_), np.empty(n, np.int64)
    last, count = 0, 0
    for root in range(n):
        if not is_known[root] or is_reached[root]:
            continue
        queue[last], first = root, last
        is_reached[root] = True
        last += 1
        while first < last:
            node = queue[first]
            first += 1
            for k in range(begin[node], begin[node + 1]):
                e, side = incident[k] // 2, incident[k] % 2
                other = edges[e, side]
                if k + 1 < begin[node + 1] and edges[incident[k + 1] // 2, incident[k + 1] % 2] == other:
                    continue  # of parallel edges the last one stands
                if is_reached[other]:
                    continue
                is_reached[other] = True
                queue[last] = other
                last += 1
                if not is_known[other]:
                    child[count], parent[count], edge[count] = other, node, e
                    count += 1
    return count
