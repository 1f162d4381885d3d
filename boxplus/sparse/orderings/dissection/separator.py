"""A small set of nodes that parts a graph into two halves.

Multilevel: a separator of a coarse picture of the graph, from several regions grown at random, is carried to finer and finer ones
and improved on each. Its nodes move into one half, which draws their neighbours in the other half into it (B. Hendrickson,
E. Rothberg, "Improving the run time and quality of nested dissection ordering", SIAM J. Sci. Comput. 20(2), 1998), in the order
of what that gains, and back to where it was lightest (C. M. Fiduccia, R. M. Mattheyses, "A linear-time heuristic for improving
network partitions", DAC 1982). All moves of a pass go to one half: the separator travels through the graph, where moves
to and fro would lock it in place (30 % more operations in the factorisation).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.sparse.orderings.dissection.coarsening import Graph, coarsen, draw

SEPARATOR = np.uint8(2)
"""Side of the nodes of the separator; 0 and 1 are the halves."""

_ONE = np.uint64(1)
_COARSEST = 60  # nodes of the graph in which the first separator is found
_STALLED = 0.95  # of the nodes are left after coarsening: the graph does not get smaller
_TRIALS = 4  # regions grown in the coarsest graph
_SHARE = 0.65  # of all weight in either half, at most
_PASSES = 8  # over the separator at each level, at most
_PATIENCE = 800  # moves without a better separator before a pass ends


def separate(graph: Graph, seed: int, tries: int) -> NDArray[np.uint8]:
    """(n,) which half each node is in, 0 or 1, or `SEPARATOR`: no edge joins the halves.

    Args:
        graph: with a node at least.
        seed: the same graph, seed and tries give the same separator.
        tries: how many separators are made, of which the best is kept.
    """
    most = max(int(_SHARE * graph.weight.sum()), 1)
    sides = [_multilevel(graph, most, seed * tries + k) for k in range(tries)]
    return min(sides, key=lambda side: _cost(graph.weight, side, most))


def _multilevel(graph: Graph, most: int, seed: int) -> NDArray[np.uint8]:
    """One separator: the graph made smaller step by step, a separator of the smallest, and the way back."""
    heaviest = max(3 * int(graph.weight.sum()) // (2 * _COARSEST), 1)
    levels: list[tuple[Graph, NDArray[np.uint32]]] = []
    coarsest = graph
    while len(coarsest.weight) > _COARSEST:
        coarser, into = coarsen(coarsest, heaviest, seed + len(levels))
        if len(coarser.weight) > _STALLED * len(coarsest.weight):
            break
        levels.append((coarsest, into))
        coarsest = coarser
    side = np.empty(len(coarsest.weight), np.uint8)
    _first(coarsest.start, coarsest.neighbours, coarsest.weight, seed, most, side)
    for finer, into in reversed(levels):
        side = side[into]
        refine(finer.start, finer.neighbours, finer.weight, most, side)
    return side


@kernel
def _first(
    start: NDArray[np.int64], neighbours: NDArray[np.int32], weight: NDArray[np.int64], seed: np.int64, most: np.int64,
    side: NDArray[np.uint8],
) -> None:  # fmt: skip
    """The best separator of those that regions grown from nodes drawn at random lead to."""
    count = np.uint64(len(weight))
    trial = np.empty(count, np.uint8)
    queue = np.empty(count, np.uint32)
    total = np.int64(0)
    for i in range(count):
        total += weight[i]
    best = np.inf
    state = np.uint64(2 * seed + 1)
    for _ in range(_TRIALS):
        state = draw(state)
        _grow(start, neighbours, weight, np.uint32((state >> np.uint64(11)) % count), total // 2, trial, queue)
        refine(start, neighbours, weight, most, trial)
        cost = _cost(weight, trial, most)
        if cost < best:
            best = cost
            for i in range(count):
                side[i] = trial[i]


@kernel
def _cost(weight: NDArray[np.int64], side: NDArray[np.uint8], most: np.int64) -> np.float64:
    """Weight of the separator; halves that are too heavy count more, and among equals the more even ones are better."""
    share = np.zeros(3, np.int64)
    for i in range(np.uint64(len(side))):
        share[np.uint64(side[i])] += weight[i]
    heavier = max(share[0], share[1])
    total = share[0] + share[1] + share[2]
    return np.float64(share[2] + max(heavier - most, 0) + heavier / (total + 1.0))


@kernel
def _grow(
    start: NDArray[np.int64], neighbours: NDArray[np.int32], weight: NDArray[np.int64], seed: np.uint32, wanted: np.int64,
    side: NDArray[np.uint8], queue: NDArray[np.uint32],
) -> None:  # fmt: skip
    """Side 0: what is nearest to `seed` up to a weight; the separator: the nodes of side 1 that touch it."""
    count = np.uint64(len(weight))
    side[:] = 1
    grown, head, tail, following = np.int64(0), np.uint64(0), np.uint64(0), np.uint64(0)
    queue[0] = seed
    side[np.uint64(seed)] = SEPARATOR  # reached, not yet taken
    tail = _ONE
    while grown < wanted:
        if head == tail:  # another component
            while following < count and side[following] != 1:
                following += _ONE
            if following == count:
                break
            side[following] = SEPARATOR
            queue[tail] = np.uint32(following)
            tail += _ONE
        i = np.uint64(queue[head])
        head += _ONE
        side[i] = 0
        grown += weight[i]
        for m in range(np.uint64(start[i]), np.uint64(start[i + _ONE])):
            j = np.uint64(neighbours[m])
            if side[j] == 1:
                side[j] = SEPARATOR
                queue[tail] = np.uint32(j)
                tail += _ONE


@kernel(inline=True)
def _swap(heap: NDArray[np.uint32], place: NDArray[np.int32], a: np.uint64, b: np.uint64) -> None:
    heap[a], heap[b] = heap[b], heap[a]
    place[np.uint64(heap[a])] = np.int32(a)
    place[np.uint64(heap[b])] = np.int32(b)


@kernel
def _sift(heap: NDArray[np.uint32], place: NDArray[np.int32], gain: NDArray[np.int64], size: np.uint64, k: np.uint64) -> None:
    """Restore the order of a heap, largest gain first and then the smaller node, after the gain of its entry k changed."""
    while k > 0:
        above = (k - _ONE) // np.uint64(2)
        a, b = np.uint64(heap[above]), np.uint64(heap[k])
        if gain[a] > gain[b] or (gain[a] == gain[b] and a < b):
            break
        _swap(heap, place, above, k)
        k = above
    while True:
        child = np.uint64(2) * k + _ONE
        if child >= size:
            break
        a = np.uint64(heap[child])
        if child + _ONE < size:
            b = np.uint64(heap[child + _ONE])
            if gain[b] > gain[a] or (gain[b] == gain[a] and b < a):
                child, a = child + _ONE, b
        b = np.uint64(heap[k])
        if gain[b] > gain[a] or (gain[b] == gain[a] and b < a):
            break
        _swap(heap, place, child, k)
        k = child


@kernel
def _push(
    heap: NDArray[np.uint32], place: NDArray[np.int32], gain: NDArray[np.int64], size: np.uint64, i: np.uint64
) -> np.uint64:
    heap[size] = np.uint32(i)
    place[i] = np.int32(size)
    _sift(heap, place, gain, size + _ONE, size)
    return size + _ONE


@kernel
def _take(
    heap: NDArray[np.uint32], place: NDArray[np.int32], gain: NDArray[np.int64], size: np.uint64, i: np.uint64
) -> np.uint64:
    """Take node i out of a heap that it is in."""
    k, last = np.uint64(place[i]), size - _ONE
    place[i] = -1
    if k != last:
        heap[k] = heap[last]
        place[np.uint64(heap[k])] = np.int32(k)
        _sift(heap, place, gain, last, k)
    return last


@kernel
def refine(
    start: NDArray[np.int64], neighbours: NDArray[np.int32], weight: NDArray[np.int64], most: np.int64, side: NDArray[np.uint8]
) -> None:
    """Make a separator lighter, in place, with neither half heavier than `most` where it was not before.

    Pass by pass the separator travels into one half and then into the other, and goes back to where it was lightest.

    Args:
        start, neighbours, weight: see `Graph`.
        side: (n,) 0, 1 or `SEPARATOR`.
    """
    count = np.uint64(len(weight))
    share = np.zeros(3, np.int64)
    for i in range(count):
        share[np.uint64(side[i])] += weight[i]
    gain = np.zeros(count, np.int64)
    heap, place = np.empty(count, np.uint32), np.full(count, -1, np.int32)
    moved, drawn = np.empty(count, np.uint32), np.empty(count, np.uint32)
    drawn_end = np.empty(count, np.uint32)
    to = np.uint64(0) if share[0] < share[1] else np.uint64(1)
    idle = 0
    for _ in range(_PASSES):
        other = _ONE - to
        size = np.uint64(0)
        for i in range(count):
            if side[i] == SEPARATOR:
                gain[i] = _gain(start, neighbours, weight, side, i, other)
                size = _push(heap, place, gain, size, i)
        moves, draws = np.uint64(0), np.uint64(0)
        best_moves, best_weight, best_even = np.uint64(0), share[2], abs(share[0] - share[1])
        while size > 0 and moves < best_moves + np.uint64(_PATIENCE):
            v = np.uint64(heap[0])
            if share[to] + weight[v] > most:
                break
            size = _take(heap, place, gain, size, v)
            side[v] = np.uint8(to)
            share[2] -= weight[v]
            share[to] += weight[v]
            for m in range(np.uint64(start[v]), np.uint64(start[v + _ONE])):
                u = np.uint64(neighbours[m])
                if side[u] != other:
                    continue
                side[u] = SEPARATOR
                share[other] -= weight[u]
                share[2] += weight[u]
                drawn[draws] = np.uint32(u)
                draws += _ONE
                gain[u] = _gain(start, neighbours, weight, side, u, other)
                for n in range(np.uint64(start[u]), np.uint64(start[u + _ONE])):
                    x = np.uint64(neighbours[n])
                    if side[x] == SEPARATOR and place[x] >= 0:
                        gain[x] += weight[u]
                        _sift(heap, place, gain, size, np.uint64(place[x]))
                size = _push(heap, place, gain, size, u)
            moved[moves], drawn_end[moves] = np.uint32(v), np.uint32(draws)
            moves += _ONE
            even = abs(share[0] - share[1])
            if share[2] < best_weight or (share[2] == best_weight and even < best_even):
                best_moves, best_weight, best_even = moves, share[2], even
        for k in range(size):
            place[np.uint64(heap[k])] = -1
        for k in range(moves, best_moves, -1):  # back to the best
            back = np.uint64(k - 1)
            begin = np.uint64(drawn_end[back - _ONE]) if back > 0 else np.uint64(0)
            for d in range(begin, np.uint64(drawn_end[back])):
                u = np.uint64(drawn[d])
                side[u] = np.uint8(other)
                share[2] -= weight[u]
                share[other] += weight[u]
            v = np.uint64(moved[back])
            side[v] = SEPARATOR
            share[to] -= weight[v]
            share[2] += weight[v]
        idle = 0 if best_moves > 0 else idle + 1
        if idle == 2:
            break
        to = other


@kernel
def _gain(
    start: NDArray[np.int64], neighbours: NDArray[np.int32], weight: NDArray[np.int64], side: NDArray[np.uint8], i: np.uint64,
    other: np.uint64,
) -> np.int64:  # fmt: skip
    """How much lighter the separator gets when node i leaves it and draws its neighbours in the half `other` into it."""
    gain = np.int64(weight[i])
    for m in range(np.uint64(start[i]), np.uint64(start[i + _ONE])):
        j = np.uint64(neighbours[m])
        if side[j] == other:
            gain -= weight[j]
    return gain
