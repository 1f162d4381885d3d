"""Nested dissection ordering: halve the graph by a separator, order both halves in the same way, and the separator last.

After A. George, "Nested dissection of a regular finite element mesh", SIAM J. Numer. Anal. 10(2), 1973. Pieces too small to be
halved are ordered by minimum degree, with the separators around them as variables that come later, so that degrees are those of
the whole graph (F. Pellegrini, J. Roman, P. Amestoy, "Hybridizing nested dissection and halo approximate minimum degree", 1999).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.sparse.orderings.clique_ordering import order_cliques
from boxplus.sparse.orderings.dissection.coarsening import Graph
from boxplus.sparse.orderings.dissection.separator import SEPARATOR, separate

_ONE = np.uint64(1)
_OUTSIDE = np.uint32(0xFFFFFFFF)
_LEAF = 60  # nodes of a piece that is not halved, at most
_LARGE = 300  # nodes of a piece that deserves several separators to choose from


def nested_dissection(
    start: NDArray[np.int64], neighbours: NDArray[np.int32], sizes: NDArray[np.int64], tries: int
) -> NDArray[np.int64]:
    """Order the nodes of an undirected graph by nested dissection.

    Args and result as `minimum_degree`, and

    Args:
        tries: separators of every large piece to choose from; time grows with them, the cost of the order falls.
    """
    count = len(sizes)
    order = np.empty(count, np.int64)
    number = np.full(count, _OUTSIDE, np.uint32)
    pieces = [(np.arange(count, dtype=np.uint32), 0)]  # nodes, and where their order begins
    while pieces:
        nodes, begin = pieces.pop()
        end = begin + len(nodes)
        if len(nodes) > _LEAF:
            side = separate(_piece(start, neighbours, sizes, nodes, number), begin, tries if len(nodes) > _LARGE else 1)
            halves = [nodes[side == half] for half in range(2)]
            if min(map(len, halves)):
                middle = begin + len(halves[0])
                pieces += [(halves[0], begin), (halves[1], middle)]
                order[middle + len(halves[1]) : end] = nodes[side == SEPARATOR]
                continue
        order[begin:end] = _leaf(start, neighbours, sizes, nodes, number)
    return order


def _piece(
    start: NDArray[np.int64], neighbours: NDArray[np.int32], sizes: NDArray[np.int64], nodes: NDArray[np.uint32],
    number: NDArray[np.uint32],
) -> Graph:  # fmt: skip
    """What the graph has between some of its nodes."""
    room = int((start[nodes.astype(np.int64) + 1] - start[nodes]).sum())
    piece_start, piece_neighbours = np.empty(len(nodes) + 1, np.int64), np.empty(room, np.int32)
    used = _cut_out(start, neighbours, nodes, number, piece_start, piece_neighbours)
    return Graph(piece_start, piece_neighbours[:used], np.ones(used, np.int32), sizes[nodes])


@kernel
def _cut_out(
    start: NDArray[np.int64], neighbours: NDArray[np.int32], nodes: NDArray[np.uint32], number: NDArray[np.uint32],
    piece_start: NDArray[np.int64], piece_neighbours: NDArray[np.int32],
) -> np.int64:  # fmt: skip
    """Edges between `nodes` with their new numbers; `number` is all outside before and after."""
    count = np.uint64(len(nodes))
    for k in range(count):
        number[np.uint64(nodes[k])] = np.uint32(k)
    used = np.uint64(0)
    for k in range(count):
        piece_start[k] = np.int64(used)
        i = np.uint64(nodes[k])
        for m in range(np.uint64(start[i]), np.uint64(start[i + _ONE])):
            j = number[np.uint64(neighbours[m])]
            if j != _OUTSIDE:
                piece_neighbours[used] = np.int32(j)
                used += _ONE
    piece_start[count] = np.int64(used)
    for k in range(count):
        number[np.uint64(nodes[k])] = _OUTSIDE
    return np.int64(used)


def _leaf(
    start: NDArray[np.int64], neighbours: NDArray[np.int32], sizes: NDArray[np.int64], nodes: NDArray[np.uint32],
    number: NDArray[np.uint32],
) -> NDArray[np.uint32]:  # fmt: skip
    """A piece in order of minimum degree; whatever it touches comes later."""
    room = int((start[nodes.astype(np.int64) + 1] - start[nodes]).sum())
    edges, halo = np.empty((room, 2), np.int64), np.empty(room, np.uint32)
    used, outside = _edges(start, neighbours, nodes, number, edges, halo)
    members = np.concatenate([nodes, halo[:outside]])
    is_last = np.arange(len(members)) >= len(nodes)
    order = order_cliques(2 * np.arange(used + 1), edges[:used].ravel(), sizes[members], is_last)[: len(nodes)]
    return np.asarray(nodes[order], np.uint32)


@kernel
def _edges(
    start: NDArray[np.int64], neighbours: NDArray[np.int32], nodes: NDArray[np.uint32], number: NDArray[np.uint32],
    edges: NDArray[np.int64], halo: NDArray[np.uint32],
) -> tuple[np.int64, np.int64]:  # fmt: skip
    """Edges within a piece and to what it touches, once each, and the nodes that it touches; `number` as in `_cut_out`."""
    count = np.uint64(len(nodes))
    for k in range(count):
        number[np.uint64(nodes[k])] = np.uint32(k)
    used, outside = np.uint64(0), np.uint64(0)
    for k in range(count):
        i = np.uint64(nodes[k])
        for m in range(np.uint64(start[i]), np.uint64(start[i + _ONE])):
            j = np.uint64(neighbours[m])
            if number[j] == _OUTSIDE:
                number[j] = np.uint32(count + outside)
                halo[outside] = np.uint32(j)
                outside += _ONE
            if number[j] > k:
                edges[used, 0], edges[used, 1] = np.int64(k), np.int64(number[j])
                used += _ONE
    for k in range(count):
        number[np.uint64(nodes[k])] = _OUTSIDE
    for k in range(outside):
        number[np.uint64(halo[k])] = _OUTSIDE
    return np.int64(used), np.int64(outside)
