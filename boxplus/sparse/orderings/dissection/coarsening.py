"""Smaller pictures of a graph: neighbours that hang together by many edges become one node.

Heavy edge matching after G. Karypis, V. Kumar, "A fast and high quality multilevel scheme for partitioning irregular graphs",
SIAM J. Sci. Comput. 20(1), 1998, section 3.1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

_ONE = np.uint64(1)
_NONE = np.uint32(0xFFFFFFFF)
_DEGREES = np.uint64(64)  # numbers of neighbours that are told apart


class Graph(NamedTuple):
    """An undirected graph with weights; both directions of an edge are listed.

    Attributes:
        start: (n + 1,) node i has the neighbours `neighbours[start[i]:start[i + 1]]`; (m,) each.
        edge_weight: (m,) how many edges of the finest graph an edge stands for.
        weight: (n,) scalar variables of each node.
    """

    start: NDArray[np.int64]
    neighbours: NDArray[np.int32]
    edge_weight: NDArray[np.int32]
    weight: NDArray[np.int64]


def coarsen(graph: Graph, heaviest: int, seed: int) -> tuple[Graph, NDArray[np.uint32]]:
    """Merge pairs of neighbours; returns the coarser graph and the node of it that each node went into.

    Args:
        heaviest: no pair weighs more than this.
        seed: of the order in which nodes choose a partner.
    """
    count = len(graph.weight)
    into = np.empty(count, np.uint32)
    coarse = _match(*graph, _sequence(graph.start, seed), heaviest, into)
    start = np.empty(coarse + 1, np.int64)
    neighbours, edge_weight = np.empty(len(graph.neighbours), np.int32), np.empty(len(graph.neighbours), np.int32)
    weight = np.zeros(coarse, np.int64)
    used = _contract(*graph, into, start, neighbours, edge_weight, weight)
    return Graph(start, neighbours[:used], edge_weight[:used], weight), into


@kernel(inline=True)
def draw(state: np.uint64) -> np.uint64:
    """The next of a series of 64 random bits (xorshift64*, G. Marsaglia 2003, S. Vigna 2016); `state` is not zero."""
    state ^= state >> np.uint64(12)
    state ^= state << np.uint64(25)
    return state ^ (state >> np.uint64(27))


@kernel
def _sequence(start: NDArray[np.int64], seed: np.int64) -> NDArray[np.uint32]:
    """Nodes by their number of neighbours, those with little choice first, and at random among equals."""
    count = np.uint64(len(start) - 1)
    shuffled, sequence = np.empty(count, np.uint32), np.empty(count, np.uint32)
    state = np.uint64(2 * seed + 1)
    first = np.zeros(_DEGREES + _ONE, np.int64)
    for k in range(count):
        state = draw(state)
        j = (state >> np.uint64(11)) % (k + _ONE)
        shuffled[k] = shuffled[j]
        shuffled[j] = np.uint32(k)
        first[min(np.uint64(start[k + _ONE] - start[k]), _DEGREES - _ONE) + _ONE] += 1
    for k in range(_DEGREES):
        first[k + _ONE] += first[k]
    for k in range(count):
        i = np.uint64(shuffled[k])
        d = min(np.uint64(start[i + _ONE] - start[i]), _DEGREES - _ONE)
        sequence[np.uint64(first[d])] = np.uint32(i)
        first[d] += 1
    return sequence


@kernel
def _match(
    start: NDArray[np.int64], neighbours: NDArray[np.int32], edge_weight: NDArray[np.int32], weight: NDArray[np.int64],
    sequence: NDArray[np.uint32], heaviest: np.int64, into: NDArray[np.uint32],
) -> np.int64:  # fmt: skip
    """Number the pairs; a node takes the free neighbour with the heaviest edge, or a free neighbour of a neighbour."""
    into[:] = _NONE
    coarse = np.uint32(0)
    for k in range(np.uint64(len(sequence))):
        i = np.uint64(sequence[k])
        if into[i] != _NONE:
            continue
        partner, best, room = _NONE, np.int32(-1), heaviest - weight[i]
        for m in range(np.uint64(start[i]), np.uint64(start[i + _ONE])):
            j = np.uint64(neighbours[m])
            if into[j] == _NONE and edge_weight[m] > best and weight[j] <= room:
                partner, best = np.uint32(j), edge_weight[m]
        into[i] = coarse
        if partner != _NONE:
            into[np.uint64(partner)] = coarse
        coarse += np.uint32(1)
    return np.int64(coarse)


@kernel
def _contract(
    start: NDArray[np.int64], neighbours: NDArray[np.int32], edge_weight: NDArray[np.int32], weight: NDArray[np.int64],
    into: NDArray[np.uint32], coarse_start: NDArray[np.int64], coarse_neighbours: NDArray[np.int32],
    coarse_edge_weight: NDArray[np.int32], coarse_weight: NDArray[np.int64],
) -> np.int64:  # fmt: skip
    """Fill the coarser graph: sums of weights, parallel edges as one; returns the number of its edges."""
    count, coarse = np.uint64(len(into)), np.uint64(len(coarse_weight))
    first, second = np.empty(coarse, np.uint32), np.empty(coarse, np.uint32)
    place = np.empty(coarse, np.int64)  # of the edge to a node, valid from the begin of the present list on
    first[:], second[:], place[:] = _NONE, _NONE, -1
    for k in range(count):
        node = np.uint64(into[k])
        coarse_weight[node] += weight[k]
        if first[node] == _NONE:
            first[node] = np.uint32(k)
        else:
            second[node] = np.uint32(k)
    used = np.int64(0)
    for c in range(coarse):
        begin = used
        coarse_start[c] = begin
        for half in range(2):
            member = first[c] if half == 0 else second[c]
            if member == _NONE:
                continue
            i = np.uint64(member)
            for m in range(np.uint64(start[i]), np.uint64(start[i + _ONE])):
                d = np.uint64(into[np.uint64(neighbours[m])])
                if d == c:
                    continue
                if place[d] >= begin:
                    coarse_edge_weight[np.uint64(place[d])] += edge_weight[m]
                else:
                    place[d] = used
                    coarse_neighbours[np.uint64(used)] = np.int32(d)
                    coarse_edge_weight[np.uint64(used)] = edge_weight[m]
                    used += 1
    coarse_start[coarse] = used
    return used
