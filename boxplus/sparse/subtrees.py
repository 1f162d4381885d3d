"""Subtrees of the elimination tree that threads factorise side by side.

The arithmetic of a front does not depend on when and where it is done, so the factor has the same bits for any split.
"""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.sparse.symbolic import Indices, front_time

WORTHWHILE = 2e6  # [ns] below it, threads cost more than they save
SPLITS = 64  # subtrees that are split at most
SHARE = 16  # neighbouring subtrees are worked on together up to this fraction of all work per thread


@kernel
def _subtree_times(parent: Indices, width: Indices, below: Indices) -> tuple[NDArray[np.float64], NDArray[np.float64], Indices]:
    """Expected time of each front, of its subtree, and the first front of the subtree (fronts are in postorder)."""
    fronts = len(parent)
    own, whole, first = np.zeros(fronts), np.zeros(fronts + 1), np.arange(fronts + 1)
    for g in range(fronts):
        own[g] = front_time(width[g], below[g])
        whole[g] += own[g]
        whole[parent[g]] += whole[g]
        first[parent[g]] = min(first[parent[g]], first[g])
    return own, whole, first


def _join(roots: list[int], first: Indices, whole: NDArray[np.float64], limit: float) -> list[tuple[float, int, int]]:
    """Time, first and last front of runs of neighbouring subtrees, together within the limit."""
    joined: list[tuple[float, int, int]] = []
    for root in sorted(roots):
        begin, time = int(first[root]), float(whole[root])
        if joined and joined[-1][2] + 1 == begin and joined[-1][0] + time <= limit:
            joined[-1] = (joined[-1][0] + time, joined[-1][1], root)
        else:
            joined.append((time, begin, root))
    return joined


def _makespan(times: list[float], threads: int) -> float:
    """Time until all is done when the longest begin first."""
    ends = [0.0] * threads
    for time in sorted(times, reverse=True):
        heapq.heappush(ends, heapq.heappop(ends) + time)
    return max(ends)


def split_tree(parent: Indices, width: Indices, below: Indices, eager: Indices, threads: int) -> tuple[Indices, Indices]:
    """The part of each front, and where the parts begin when the fronts are sorted by them.

    The last part is the rest: it waits for all others, the subtrees, of which the longest come first.
    """
    fronts = len(parent)
    own, whole, first = _subtree_times(parent, width, below)
    total = float(own.sum())
    best: tuple[float, list[tuple[float, int, int]]] = (total, [])
    if threads > 1 and total > WORTHWHILE:
        children: dict[int, list[int]] = {}
        for g, p in enumerate(parent.tolist()):
            children.setdefault(p, []).append(g)
        rest, limit = 0.0, total / (SHARE * threads)
        heap = [(-float(whole[g]), g) for g in children[fronts]]
        heapq.heapify(heap)
        for _ in range(SPLITS):
            subtrees = _join([g for _, g in heap], first, whole, limit)
            time = rest + _makespan([t for t, _, _ in subtrees], threads)
            if len(subtrees) > 1 and time < best[0]:
                best = (time, subtrees)
            if not heap or eager[heap[0][1]]:  # the children of an eager front must not work side by side
                break
            _, g = heapq.heappop(heap)
            rest += float(own[g])
            for child in children.get(g, []):
                heapq.heappush(heap, (-float(whole[child]), child))
    subtrees = sorted(best[1], key=lambda subtree: -subtree[0])
    part = np.full(fronts, len(subtrees))
    for k, (_, begin, last) in enumerate(subtrees):
        part[begin : last + 1] = k
    parts = np.zeros(len(subtrees) + 2, np.int64)
    np.cumsum(np.bincount(part, minlength=len(subtrees) + 1), out=parts[1:])
    return part, parts
