"""Which nodes of a graph hang together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel


def connected_components(count: int, i: NDArray[np.int64], j: NDArray[np.int64]) -> tuple[int, NDArray[np.int64]]:
    """How many components the edges (i[k], j[k]) between `count` nodes leave, and the one (count,) of every node.

    Components are numbered by their first nodes.
    """
    label = np.arange(count, dtype=np.int64)
    found = _unite(np.ascontiguousarray(i, np.int64), np.ascontiguousarray(j, np.int64), label)
    return int(found), label


@kernel
def _unite(i: NDArray[np.int64], j: NDArray[np.int64], parent: NDArray[np.int64]) -> int:
    """Union-find with halved paths (Tarjan and van Leeuwen 1984), the smaller number on top; `parent` becomes the label."""
    for k in range(np.uint64(len(i))):
        a, b = i[k], j[k]
        while parent[a] != a:
            parent[a] = parent[parent[a]]
            a = parent[a]
        while parent[b] != b:
            parent[b] = parent[parent[b]]
            b = parent[b]
        if a < b:
            parent[b] = a
        else:
            parent[a] = b
    found = 0
    for node in range(len(parent)):  # parents come before their children
        if parent[node] == node:
            parent[node] = found
            found += 1
        else:
            parent[node] = parent[parent[node]]
    return found
