"""Minimum degree ordering of a graph that is given by its cliques, with variables that have to come last.

An incremental factorisation orders a part of a graph again and again, and knows it as cliques: each residual joins its variables,
each subtree that is already eliminated joins what it hangs on. In the quotient graph of `minimum_degree` they are elements from
the start, so that no edge is ever written out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.sparse.orderings.minimum_degree import DEAD, ELEMENT, NODE, NONE, VARIABLE, eliminate, insert

Indices = NDArray[np.int64]

_ONE = np.uint32(1)


@kernel
def _set_up(nodes: NDArray[np.void], start: Indices, members: Indices, sizes: Indices, head: NDArray[np.uint32],
            lists: NDArray[np.uint32]) -> int:  # fmt: skip
    """Fill the quotient graph: variables with lists of elements, then the elements; returns the space used."""
    count, cliques = len(sizes), len(start) - 1
    used = np.uint64(0)
    for e in range(cliques):
        node = nodes[count + e]
        node["start"], node["state"] = np.uint32(used), ELEMENT
        for k in range(start[e], start[e + 1]):
            v = members[k]
            if nodes[v]["state"] == VARIABLE:
                lists[used] = np.uint32(v)
                used += _ONE
                node["degree"] += sizes[v]
                nodes[v]["length"] += _ONE
        node["length"] = node["variables"] = np.uint32(used - node["start"])
    for v in range(count):
        nodes[v]["start"] = np.uint32(used)
        used += np.uint64(nodes[v]["length"])
        nodes[v]["length"] = np.uint32(0)
    for e in range(cliques):
        node = nodes[count + e]
        for k in range(node["start"], node["start"] + node["length"]):
            v = lists[k]
            lists[nodes[v]["start"] + nodes[v]["length"]] = np.uint32(count + e)
            nodes[v]["length"] += _ONE
            nodes[v]["degree"] += node["degree"] - sizes[v]
    return np.int64(used)  # type: ignore[return-value]


@kernel
def order_cliques(start: Indices, members: Indices, sizes: Indices, is_last: NDArray[np.bool_]) -> Indices:
    """Order the variables of cliques by approximate minimum degree.

    Args:
        start: (cliques + 1,) clique e joins `members[start[e]:start[e + 1]]`, each variable once.
        sizes: (n,) scalar variables in each variable.
        is_last: (n,) which variables come after all others, in ascending order; their own edges do not matter.

    Returns:
        (n,) the k-th variable to eliminate.
    """
    count, cliques = len(sizes), len(start) - 1
    order = np.empty(count, np.int64)
    nodes = np.zeros(count + cliques, NODE)
    total, back = 0, count
    for v in range(count - 1, -1, -1):
        node = nodes[v]
        node["weight"], node["state"], node["member"], node["last_member"] = sizes[v], VARIABLE, NONE, np.uint32(v)
        total += sizes[v]
        if is_last[v]:
            node["state"] = DEAD
            back -= 1
            order[back] = v
            total -= sizes[v]
    head = np.full(total + 1, NONE, np.uint32)
    bucket = np.full(count + cliques, NONE, np.uint32)
    room = 3 * len(members) + 2 * (count + cliques)
    lists, spare = np.empty(room, np.uint32), np.empty(room, np.uint32)
    used = _set_up(nodes, start, members, sizes, head, lists)
    for v in range(count - 1, -1, -1):  # so that among variables of equal degree the first is taken
        if nodes[v]["state"] == VARIABLE:
            nodes[v]["degree"] = min(nodes[v]["degree"], total - sizes[v])
            insert(nodes, head, np.uint32(v))
    if total > 0:
        eliminate(nodes, lists, spare, np.uint64(used), head, bucket, np.int64(total), order)
    return order
