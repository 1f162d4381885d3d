"""Which edges of a graph hold it together alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel


def cut_edges(
    i: NDArray[np.int64], j: NDArray[np.int64], weights: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Edges (i[k], j[k]) without which their component falls apart, and the weight of the lighter of the two parts.

    One depth-first search over nodes and edges: an edge is cut where nothing below it reaches above it (Tarjan, A note on finding
    the bridges of a graph, 1974). Edges that are parallel are no cut of each other.

    Args:
        i, j: (m,) nodes that every edge joins.
        weights: (n,) of the nodes.

    Returns:
        Numbers (b,) of the edges in rising order, and the lighter parts (b,).
    """
    nodes = np.concatenate([i, j]).astype(np.int64)
    order = np.argsort(nodes, kind="stable")
    first = np.searchsorted(nodes[order], np.arange(len(weights) + 1)).astype(np.int64)
    lighter = np.full(len(i), -1, dtype=np.int64)
    _search(first, (order % max(len(i), 1)).astype(np.int64), nodes, np.ascontiguousarray(weights, np.int64), lighter)
    found = np.flatnonzero(lighter >= 0)
    return found.astype(np.int64), lighter[found]


@kernel
def _search(
    first: NDArray[np.int64],
    edge_at: NDArray[np.int64],
    ends: NDArray[np.int64],
    weights: NDArray[np.int64],
    lighter: NDArray[np.int64],
) -> None:
    """`lighter` becomes the weight of the lighter part for every cut edge, and stays for the others.

    Args:
        first: (n + 1,) where the edges of every node begin in `edge_at` (2 m,).
        ends: (2 m,) the first nodes of all edges, then the second ones.
    """
    n, m = len(weights), len(lighter)
    entered, reaches, heavy = np.full(n, -1, np.int64), np.zeros(n, np.int64), weights.copy()
    came_by, following, path = np.full(n, -1, np.int64), first[:n].copy(), np.empty(n, np.int64)
    below, clock = np.zeros(m, np.int64), 0
    for root in range(n):
        if entered[root] >= 0:
            continue
        depth, path[0] = 1, root
        entered[root] = reaches[root] = clock
        clock += 1
        begin = clock
        while depth > 0:
            node = path[depth - 1]
            if following[node] < first[node + 1]:
                edge = edge_at[following[node]]
                following[node] += 1
                if edge == came_by[node]:
                    continue
                other = ends[edge] + ends[m + edge] - node
                if entered[other] >= 0:
                    reaches[node] = min(reaches[node], entered[other])
                    continue
                came_by[other] = edge
                entered[other] = reaches[other] = clock
                clock += 1
                path[depth] = other
                depth += 1
                continue
            depth -= 1
            if depth == 0:
                continue
            above = path[depth - 1]
            reaches[above] = min(reaches[above], reaches[node])
            heavy[above] += heavy[node]
            if reaches[node] > entered[above]:
                below[came_by[node]] = heavy[node]
                lighter[came_by[node]] = 0
        if clock == begin:
            continue
        # What is on the other side is known when the whole component is.
        for node in range(root, n):
            edge = came_by[node]
            if entered[node] >= begin and edge >= 0 and lighter[edge] == 0:
                lighter[edge] = min(below[edge], heavy[root] - below[edge])
