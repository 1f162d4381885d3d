"""Approximate minimum degree ordering on a quotient graph.

Written from P. R. Amestoy, T. A. Davis, I. S. Duff, "An approximate minimum degree ordering algorithm", SIAM J. Matrix
Anal. Appl. 17(4), 1996 (below: ADD). An eliminated node becomes an *element*, the clique of its neighbours, kept as a
list instead of as edges. Nodes that have become indistinguishable are merged into one *supervariable*. A node weighs as
many scalar variables as its block has, so the degrees are those of the scalar matrix.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

NONE = np.uint32(0xFFFFFFFF)
_ZERO = np.uint32(0)
_ONE = np.uint32(1)

VARIABLE = np.uint32(0)  # a principal variable not yet eliminated
ELEMENT = np.uint32(1)
DEAD = np.uint32(2)  # an absorbed element, a merged or an eliminated variable

# A variable's list holds its variables first and its elements behind them, an element's list its variables.
NODE = np.dtype(
    [
        ("start", np.uint32),
        ("length", np.uint32),
        ("variables", np.uint32),  # how many entries of the list are variables
        ("state", np.uint32),
        ("next", np.uint32),  # list of equal degree, later chain of equal hash
        ("previous", np.uint32),  # list of equal degree, later the hash
        ("member", np.uint32),  # next node ordered together with this one
        ("last_member", np.uint32),
        ("weight", np.int64),
        ("degree", np.int64),  # of a variable: bound of its external degree; of an element: weight of its list
        ("work", np.int64),  # time stamp; in the scans of ADD section 4: stamp + weight of L_e \ L_p
    ],
    align=True,
)


@kernel(inline=True)
def insert(nodes: NDArray[np.void], head: NDArray[np.uint32], i: np.uint32) -> None:
    """Put variable `i` at the front of the list of its degree."""
    degree = np.uint64(nodes[i]["degree"])
    following = head[degree]
    nodes[i]["next"] = following
    nodes[i]["previous"] = NONE
    if following != NONE:
        nodes[following]["previous"] = i
    head[degree] = i


@kernel(inline=True)
def _remove(nodes: NDArray[np.void], head: NDArray[np.uint32], i: np.uint32) -> None:
    """Take variable `i` out of the list of its degree."""
    following, before = nodes[i]["next"], nodes[i]["previous"]
    if following != NONE:
        nodes[following]["previous"] = before
    if before != NONE:
        nodes[before]["next"] = following
    else:
        head[np.uint64(nodes[i]["degree"])] = following


@kernel(inline=True)
def _append_members(nodes: NDArray[np.void], i: np.uint32, j: np.uint32) -> None:
    """Order `j` and all that is ordered with it directly after `i`."""
    nodes[nodes[i]["last_member"]]["member"] = j
    nodes[i]["last_member"] = nodes[j]["last_member"]


@kernel
def _compact(nodes: NDArray[np.void], lists: NDArray[np.uint32], spare: NDArray[np.uint32]) -> np.uint64:
    """Copy the lists of all live nodes to `spare` without gaps; returns the space used."""
    used = np.uint64(0)
    for i in range(np.uint64(len(nodes))):
        if nodes[i]["state"] != DEAD:
            begin = nodes[i]["start"]
            nodes[i]["start"] = np.uint32(used)
            for k in range(begin, begin + nodes[i]["length"]):
                spare[used] = lists[k]
                used += _ONE
    return used


@kernel
def _form_element(
    nodes: NDArray[np.void], lists: NDArray[np.uint32], head: NDArray[np.uint32], p: np.uint32, begin: np.uint64, stamp: np.int64
) -> np.int64:
    """Turn pivot `p` into an element: L_p = (A_p ∪ ⋃ L_e) \\ {p} is written at `begin`, its elements are absorbed.

    The members of L_p leave the degree lists and carry `stamp`. Returns the weight of L_p.
    """
    nodes[p]["work"] = stamp
    first = nodes[p]["start"]
    split = first + nodes[p]["variables"]
    end = first + nodes[p]["length"]
    out = begin
    weight = np.int64(0)
    for k in range(first, split):
        i = lists[k]
        if nodes[i]["state"] == VARIABLE and nodes[i]["work"] != stamp:
            nodes[i]["work"] = stamp
            _remove(nodes, head, i)
            weight += nodes[i]["weight"]
            lists[out] = i
            out += _ONE
    for k in range(split, end):
        e = lists[k]
        if nodes[e]["state"] != ELEMENT:
            continue
        nodes[e]["state"] = DEAD
        for m in range(nodes[e]["start"], nodes[e]["start"] + nodes[e]["length"]):
            i = lists[m]
            if nodes[i]["state"] == VARIABLE and nodes[i]["work"] != stamp:
                nodes[i]["work"] = stamp
                _remove(nodes, head, i)
                weight += nodes[i]["weight"]
                lists[out] = i
                out += _ONE
    nodes[p]["state"] = ELEMENT
    nodes[p]["start"] = np.uint32(begin)
    nodes[p]["length"] = np.uint32(out - begin)
    return weight


@kernel
def _scan_elements(nodes: NDArray[np.void], lists: NDArray[np.uint32], p: np.uint32, stamp: np.int64) -> None:
    """Leave stamp + weight(L_e \\ L_p) in the `work` of every element e that touches L_p (ADD, algorithm 2)."""
    for k in range(nodes[p]["start"], nodes[p]["start"] + nodes[p]["length"]):
        i = lists[k]
        weight = nodes[i]["weight"]
        first = nodes[i]["start"]
        for m in range(first + nodes[i]["variables"], first + nodes[i]["length"]):
            e = lists[m]
            if nodes[e]["state"] == ELEMENT:
                if nodes[e]["work"] < stamp:
                    nodes[e]["work"] = stamp + nodes[e]["degree"]
                nodes[e]["work"] -= weight


@kernel
def _update_lists(
    nodes: NDArray[np.void], lists: NDArray[np.uint32], bucket: NDArray[np.uint32], p: np.uint32, stamp: np.int64
) -> np.int64:
    """Prune the lists of the members of L_p, put p into them, and bound their degrees by what lies outside L_p.

    Members with no neighbour outside L_p are eliminated together with p (mass elimination), elements inside L_p are
    absorbed by p. The others are hashed by their lists into `bucket`. Returns the weight eliminated with p.
    """
    eliminated = np.int64(0)
    buckets = np.uint64(len(bucket))
    for k in range(nodes[p]["start"], nodes[p]["start"] + nodes[p]["length"]):
        i = lists[k]
        first = nodes[i]["start"]
        split = first + nodes[i]["variables"]
        end = first + nodes[i]["length"]
        out = np.uint64(first)
        outside = np.int64(0)
        key = np.uint64(p)
        for m in range(first, split):
            j = lists[m]
            if nodes[j]["state"] == VARIABLE and nodes[j]["work"] != stamp:
                outside += nodes[j]["weight"]
                key += j
                lists[out] = j
                out += _ONE
        nodes[i]["variables"] = np.uint32(out - first)
        for m in range(split, end):
            e = lists[m]
            if nodes[e]["state"] == ELEMENT:
                beyond = nodes[e]["work"] - stamp
                if beyond == 0:
                    nodes[e]["state"] = DEAD
                else:
                    outside += beyond
                    key += e
                    lists[out] = e
                    out += _ONE
        if outside == 0:
            nodes[i]["state"] = DEAD
            eliminated += nodes[i]["weight"]
            _append_members(nodes, p, i)
            continue
        # p itself or an absorbed element has left the list, so there is room for p.
        lists[out] = p
        nodes[i]["length"] = np.uint32(out + _ONE - first)
        nodes[i]["degree"] = min(nodes[i]["degree"], outside)
        slot = key % buckets
        nodes[i]["previous"] = np.uint32(slot)
        nodes[i]["next"] = bucket[slot]
        bucket[slot] = i
    return eliminated


@kernel
def _merge_equal(
    nodes: NDArray[np.void], lists: NDArray[np.uint32], bucket: NDArray[np.uint32], p: np.uint32, stamp: np.int64
) -> np.int64:
    """Merge the members of L_p whose lists are equal (ADD, section 2.3). Returns the next unused stamp."""
    for k in range(nodes[p]["start"], nodes[p]["start"] + nodes[p]["length"]):
        i = lists[k]
        if nodes[i]["state"] != VARIABLE:
            continue
        slot = nodes[i]["previous"]
        i = bucket[slot]
        bucket[slot] = NONE
        while i != NONE:
            before = i
            j = nodes[i]["next"]
            if j != NONE:
                stamp += 1
                for m in range(nodes[i]["start"], nodes[i]["start"] + nodes[i]["length"]):
                    nodes[lists[m]]["work"] = stamp
            while j != NONE:
                equal = nodes[j]["length"] == nodes[i]["length"] and nodes[j]["variables"] == nodes[i]["variables"]
                at = np.uint64(nodes[j]["start"])
                end = at + nodes[j]["length"]
                while equal and at < end:
                    equal = nodes[lists[at]]["work"] == stamp
                    at += _ONE
                following = nodes[j]["next"]
                if equal:
                    nodes[i]["weight"] += nodes[j]["weight"]
                    nodes[j]["state"] = DEAD
                    _append_members(nodes, i, j)
                    nodes[before]["next"] = following
                else:
                    before = j
                j = following
            i = nodes[i]["next"]
    return stamp + 1


@kernel
def _reinsert(
    nodes: NDArray[np.void], lists: NDArray[np.uint32], head: NDArray[np.uint32], p: np.uint32, weight: np.int64, left: np.int64
) -> np.int64:
    """Give the members of L_p that are left their degrees (ADD, equation 4); returns the smallest."""
    begin = np.uint64(nodes[p]["start"])
    out = begin
    smallest = left
    for k in range(begin, begin + nodes[p]["length"]):
        i = lists[k]
        if nodes[i]["state"] == VARIABLE:
            lists[out] = i
            out += _ONE
            own = nodes[i]["weight"]
            degree = min(nodes[i]["degree"] + weight - own, left - own)
            nodes[i]["degree"] = degree
            smallest = min(smallest, degree)
            insert(nodes, head, i)
    nodes[p]["length"] = np.uint32(out - begin)
    nodes[p]["degree"] = weight
    if out == begin:
        nodes[p]["state"] = DEAD
    return smallest


@kernel
def eliminate(
    nodes: NDArray[np.void],
    lists: NDArray[np.uint32],
    spare: NDArray[np.uint32],
    used: np.uint64,
    head: NDArray[np.uint32],
    bucket: NDArray[np.uint32],
    left: np.int64,
    order: NDArray[np.int64],
) -> None:
    """Eliminate all variables that are in the degree lists; `left` is their weight and that of the postponed ones."""
    total = left
    stamp = np.int64(1)
    minimum = np.uint64(0)
    placed = np.uint64(0)
    degrees = np.uint64(len(head))
    capacity = np.uint64(len(lists))
    while True:
        while minimum < degrees and head[minimum] == NONE:
            minimum += _ONE
        if minimum >= degrees:
            break
        p = head[minimum]
        _remove(nodes, head, p)
        # A new list is never longer than the number of nodes, and compacted lists never outgrow the original graph.
        if used + np.uint64(len(nodes)) > capacity:
            used = _compact(nodes, lists, spare)
            lists, spare = spare, lists
        weight = _form_element(nodes, lists, head, p, used, stamp)
        used += nodes[p]["length"]
        _scan_elements(nodes, lists, p, stamp)
        eliminated = _update_lists(nodes, lists, bucket, p, stamp)
        left -= nodes[p]["weight"] + eliminated
        weight -= eliminated
        stamp = _merge_equal(nodes, lists, bucket, p, stamp + total)
        minimum = np.uint64(min(np.int64(minimum), _reinsert(nodes, lists, head, p, weight, left)))
        i = p
        while i != NONE:
            order[placed] = i
            placed += _ONE
            i = nodes[i]["member"]


@kernel
def _set_up(
    nodes: NDArray[np.void],
    start: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    sizes: NDArray[np.int64],
    dense: np.int64,
    head: NDArray[np.uint32],
    lists: NDArray[np.uint32],
    order: NDArray[np.int64],
) -> np.uint64:
    """Fill the quotient graph; nodes with more than `dense` neighbours are postponed to the end of `order`."""
    count = np.uint64(len(nodes))
    back = count
    for k in range(count):
        node = nodes[k]
        node["weight"] = sizes[k]
        node["member"] = NONE
        node["last_member"] = np.uint32(k)
        node["state"] = VARIABLE
        node["work"] = 0
        if start[k + _ONE] - start[k] > dense:
            node["state"] = DEAD
            back -= _ONE
            order[back] = np.int64(k)
    used = np.uint64(0)
    for step in range(count):
        i = count - _ONE - np.uint64(step)  # so that among nodes of equal degree the first is taken
        if nodes[i]["state"] == DEAD:
            continue
        nodes[i]["start"] = np.uint32(used)
        degree = np.int64(0)
        for m in range(np.uint64(start[i]), np.uint64(start[i + _ONE])):
            j = np.uint64(neighbours[m])
            if nodes[j]["state"] == VARIABLE:
                lists[used] = np.uint32(j)
                used += _ONE
                degree += sizes[j]
        nodes[i]["length"] = nodes[i]["variables"] = np.uint32(used - nodes[i]["start"])
        nodes[i]["degree"] = degree
        insert(nodes, head, np.uint32(i))
    return used


def minimum_degree(start: NDArray[np.int64], neighbours: NDArray[np.int32], sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Order the nodes of an undirected graph by approximate minimum degree.

    Args:
        start: (n + 1,) int64, node i has the neighbours `neighbours[start[i]:start[i + 1]]`.
        neighbours: (m,) int32, both directions of every edge, no loops, no repetitions.
        sizes: (n,) int64, scalar variables in each node, positive.

    Returns:
        (n,) int64: the k-th node to eliminate. Up to √n nodes with more than `max(16, 10 √n)` neighbours come last: the
        lists of such hubs would be walked at every step, for an order that is hardly better.
    """
    count = len(sizes)
    order = np.empty(count, np.int64)
    if count == 0:
        return order
    nodes = np.zeros(count, NODE)
    total = int(sizes.sum())
    head = np.full(total + 1, NONE, np.uint32)
    bucket = np.full(count, NONE, np.uint32)
    lists = np.empty(len(neighbours) + len(neighbours) // 2 + 2 * count, np.uint32)
    dense = int(max(16.0, 10.0 * np.sqrt(count)))
    if np.count_nonzero(np.diff(start) > dense) > np.sqrt(count):
        dense = count
    used = _set_up(nodes, start, neighbours, sizes, dense, head, lists, order)
    eliminate(nodes, lists, np.empty_like(lists), np.uint64(used), head, bucket, np.int64(total), order)
    return order
