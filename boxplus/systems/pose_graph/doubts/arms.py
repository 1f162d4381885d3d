"""Parts of a graph that hang on single edges: whatever one of these is off by, nothing but what was refused could tell.

An edge is a bridge where no circle of edges passes it; all behind it is an arm. What was refused between an arm and the rest is
held against each other: false loop closures, each for itself, contradict each other; those that a slip of the bridge has made
false agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.systems.pose_graph.consensus import Crossings

_FEW = 10  # refused loop closures among which two agree by more than chance
_LOOKED_AT = 20  # bridges, those that most refused loop closures cross


@dataclass(frozen=True, slots=True)
class Arm:
    """What hangs on the rest by a single edge.

    Attributes:
        poses: (k,) of the smaller side.
        roots: two edges that it hangs on, the nearest to it and the farthest from it that the same loop closures cross.
        refused: (r,) edges that were refused between the arm and the rest, one at least.
        agreeing: how many of these agree with each other that the arm lies elsewhere.
    """

    poses: NDArray[np.int64]
    roots: tuple[int, int]
    refused: NDArray[np.int64]
    agreeing: int

    def name(self, graph: PoseGraph, rank: NDArray[np.int64]) -> str:
        """`the edge 7 → 8`, or from which to which pose it hangs on one."""
        first, second = graph.ids[graph.edges[self.roots[0]]]
        if self.roots[0] == self.roots[1]:
            return f"the edge {first} → {second}"
        ends = np.unique(graph.edges[list(self.roots)])
        first, last = (graph.ids[ends[k(rank[ends])]] for k in (np.argmin, np.argmax))
        return f"the odometry from pose {first} to pose {last}"

    @property
    def is_contested(self) -> bool:
        """Whether refused edges agree by more than chance."""
        return self.agreeing >= (2 if len(self.refused) <= _FEW else 3)


def find_arms(
    graph: PoseGraph,
    poses: NDArray[np.float64],
    kept: NDArray[np.bool_],
    is_loop: NDArray[np.bool_],
    rank: NDArray[np.int64],
) -> list[Arm]:
    """The arms that refused edges speak of, those first of which most agree.

    Args:
        poses: the result.
        kept: (m,) edges that it rests on.
        is_loop: (m,) edges that may be outliers.
        rank: (n,) place of every pose along the odometry.
    """
    n, rows, refused = len(graph.ids), np.flatnonzero(kept), np.flatnonzero(~kept)
    child, place, last = bridges_of(n, *graph.edges[rows].T)
    bridges = np.flatnonzero(child >= 0)
    if not len(bridges) or not len(refused):
        return []
    # The same loop closures cross bridges with the same sum, by exclusive or, of their random numbers on one side.
    number = np.random.default_rng(0).integers(1, 2**63, len(refused))
    at = np.zeros(n + 1, dtype=np.int64)
    for ends in graph.edges[refused].T:
        np.bitwise_xor.at(at, place[ends] + 1, number)
    before = np.bitwise_xor.accumulate(at)
    below = child[bridges]
    crossed = before[last[below] + 1] ^ before[place[below]]
    size = last[below] - place[below] + 1
    size = np.minimum(size, n - size)
    order = np.lexsort((size, crossed))
    starts = np.flatnonzero(np.diff(crossed[order], prepend=crossed[order[0]] - 1) != 0)
    found = []
    for one, most in zip(order[starts], order[np.append(starts[1:], len(order)) - 1], strict=True):
        if crossed[one] == 0:
            continue
        within = (place >= place[below[one]]) & (place <= last[below[one]])
        edges = refused[within[graph.edges[refused, 0]] != within[graph.edges[refused, 1]]]
        own = within if 2 * np.count_nonzero(within) <= n else ~within
        found.append(
            Arm(
                np.flatnonzero(own).astype(np.int64),
                (int(rows[bridges[one]]), int(rows[bridges[most]])),
                edges.astype(np.int64),
                0,
            )
        )
    found.sort(key=lambda arm: -len(arm.refused))
    for k, arm in enumerate(found[:_LOOKED_AT]):
        within = np.isin(graph.edges[arm.refused, 0], arm.poses)
        crossings = Crossings.of(graph, poses, arm.refused, within, rank, ~is_loop)
        votes = max(int(np.count_nonzero(crossings.agreeing(int(one))[1])) for one in crossings.tried)
        found[k] = Arm(arm.poses, arm.roots, arm.refused, votes)
    return sorted(found, key=lambda arm: -arm.agreeing)


def bridges_of(
    n: int, i: NDArray[np.int64], j: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Edges that no circle passes (Tarjan, A note on finding the bridges of a graph, 1974), among those between n nodes.

    Returns:
        (m,) the node below each bridge, −1 for other edges; (n,) places of the nodes, depth first; and (n,) the last place below
        each: what hangs on a bridge are the places from that of the node below it to the last one below that.
    """
    both = np.concatenate([i, j])
    order = np.argsort(both, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(both, minlength=n))])
    child, place, last = np.full(len(i), -1), np.full(n, -1), np.zeros(n, dtype=np.int64)
    _mark_bridges(start, order % max(len(i), 1), np.concatenate([j, i])[order], child, place, last)
    return child, place, last


@kernel
def _mark_bridges(
    start: NDArray[np.int64],
    edge: NDArray[np.int64],
    other: NDArray[np.int64],
    child: NDArray[np.int64],
    place: NDArray[np.int64],
    last: NDArray[np.int64],
) -> None:
    """Depth first, with the lowest place that can be come back to from below; start (n + 1,) of every node's edges."""
    n = len(start) - 1
    low, at = np.zeros(n, np.int64), start[:-1].copy()
    stack, came = np.zeros(n, np.int64), np.full(n, -1)
    count = 0
    for root in range(n):
        if place[root] >= 0:
            continue
        stack[0], depth = root, 1
        place[root] = low[root] = count
        count += 1
        while depth > 0:
            node = stack[depth - 1]
            if at[node] < start[node + 1]:
                k = at[node]
                at[node] += 1
                if edge[k] == came[node]:
                    continue
                to = other[k]
                if place[to] >= 0:
                    low[node] = min(low[node], place[to])
                    continue
                place[to] = low[to] = count
                count += 1
                came[to] = edge[k]
                stack[depth] = to
                depth += 1
                continue
            last[node] = count - 1
            depth -= 1
            if depth > 0:
                parent = stack[depth - 1]
                low[parent] = min(low[parent], low[node])
                if low[node] > place[parent]:
                    child[came[node]] = node
