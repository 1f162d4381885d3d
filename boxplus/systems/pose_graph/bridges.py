"""Pieces of odometry, several robots or a lost track: how they lie to each other, as most loop closures between them say.

Graduated non-convexity wants to hear odometry first, and odometry that falls into pieces says nothing of how these lie. Loop
closures between two pieces are all there is, and least squares over true and false ones starts anywhere. So every piece is
judged on its own first. Of the loop closures between two pieces the one that most others agree with becomes their bridge, which
counts as odometry from there on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.optimization.minimizers.minimize import Callback
from boxplus.optimization.solver_options import SolverOptions
from boxplus.systems.pose_graph.consensus import Crossings
from boxplus.systems.pose_graph.loops import judge_loops
from boxplus.systems.pose_graph.named import named
from boxplus.systems.pose_graph.problem import odometry_order, with_edges
from boxplus.systems.pose_graph.start import components, spanning_tree_start

_MOST_PIECES = 100
_CONTESTED = 0.5  # share of the votes for the bridge that speak for another placement, from which on that is told


@dataclass(frozen=True, slots=True)
class Bridge:
    """The loop closure that two pieces are joined by.

    Attributes:
        edge: its number in the graph.
        votes: pairs of poses with a loop closure between the two pieces that agrees with it, its own included.
        others: the most pairs that agree with each other of those that do not.
        count: pairs with loop closures between the two pieces. A pair that is there twice has no second witness.
    """

    edge: int
    votes: int
    others: int
    count: int

    @property
    def is_contested(self) -> bool:
        """Whether another placement has nearly as much to say for itself, or none but the bridge says anything for this one."""
        return self.others >= _CONTESTED * self.votes or self.votes < 2

    def sentence(self, graph: PoseGraph) -> str:
        """What is contested."""
        i, j = graph.ids[graph.edges[self.edge]]
        if self.count < 2:
            return (
                f"odometry falls into pieces, and that of pose {i} and that of pose {j} are joined by the loop closure {i} → {j} "
                "alone: whether it is right, and with it how they lie to each other, nothing can tell"
            )
        return (
            f"odometry falls into pieces, and of {self.count} loop closures between that of pose {i} and that of pose {j} "
            f"{self.votes} agree on how they lie to each other, and {self.others} on another way: which are right is not clear"
        )


def bridge_pieces(
    graph: PoseGraph, is_loop: NDArray[np.bool_], options: SolverOptions, callback: Callback | None
) -> list[Bridge]:
    """The bridges that join what odometry leaves apart and loop closures tie together; none where there is nothing to join.

    Args:
        is_loop: (m,) edges that may be outliers; the others are odometry.
    """
    odometry = with_edges(graph, ~is_loop)
    label = components(odometry)
    pieces = int(label.max(initial=-1)) + 1
    if pieces == len(np.unique(components(graph))) or not 1 < pieces <= min(_MOST_PIECES, len(graph.ids) // 3):
        return []
    i, j = graph.edges.T
    between = is_loop & (label[i] != label[j])
    poses = spanning_tree_start(odometry)
    if (is_loop & ~between).any():
        poses = judge_loops(
            with_edges(graph, ~between), is_loop[~between], poses, options, named(callback, "joining pieces of odometry")
        ).solution.values[0]
    rank = odometry_order(graph)
    first, second = np.minimum(label[i], label[j]), np.maximum(label[i], label[j])
    pair = first * pieces + second
    found = []
    for key in np.unique(pair[between]):
        edges = np.flatnonzero(between & (pair == key))
        crossings = Crossings.of(graph, poses, edges, label[i[edges]] != first[edges], rank, ~is_loop)
        found.append((int(key) // pieces, int(key) % pieces, _most_agreed(crossings, edges)))
    return _spanning(pieces, found)


def _most_agreed(crossings: Crossings, edges: NDArray[np.int64]) -> Bridge:
    tried = crossings.tried
    agree = np.stack([crossings.agreeing(int(one))[0] for one in tried])
    pair = np.unique(np.stack([crossings.a, crossings.b]), axis=1, return_inverse=True)[1].ravel()
    votes = _pairs(agree, pair)
    best = int(np.argmax(votes))
    # Of the others, only those that the chosen ones do not agree with speak for another placement.
    others = _pairs(agree & ~agree[best], pair)[~agree[best][tried]]
    return Bridge(int(edges[tried[best]]), int(votes[best]), int(others.max(initial=0)), int(pair.max()) + 1)


def _pairs(agree: NDArray[np.bool_], pair: NDArray[np.int64]) -> NDArray[np.int64]:
    """(t,) of how many different pairs of poses, `pair` (k,), the loop closures marked in every row of `agree` (t, k) are."""
    return np.array([np.count_nonzero(np.bincount(pair[row])) for row in agree], dtype=np.int64)


def _spanning(pieces: int, found: list[tuple[int, int, Bridge]]) -> list[Bridge]:
    """The bridges with most votes that join all there is to join, without a circle (Kruskal)."""
    piece = np.arange(pieces)
    chosen = []
    for a, b, bridge in sorted(found, key=lambda entry: -entry[2].votes):
        if piece[a] != piece[b]:
            piece[piece == piece[b]] = piece[a]
            chosen.append(bridge)
    return chosen
