"""Searches of an ikd-tree for many queries or many results: kNN of a batch, all points in a box or a ball, all points."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.maps.ikd_tree.box import disjoint, in_box
from boxplus.maps.ikd_tree.leaf import BUCKET, trailing_zeros
from boxplus.maps.ikd_tree.pool import (
    INDEX_MASK,
    LABEL_DEAD,
    LABEL_LIVE,
    LABEL_NONE,
    LEAF_BIT,
    LEFT,
    NIL,
    ONE,
    RIGHT,
    ROOT,
    ZERO,
)
from boxplus.maps.ikd_tree.search import IkdView, five_nearest, knn, point_sq


@kernel(borrow=True)
def nearest_batch(
    view: IkdView,
    queries: NDArray[np.float32],
    begin: np.int64,
    end: np.int64,
    max_sq: np.float32,
    origin: NDArray[np.float64],
    distances: NDArray[np.float64],
    points: NDArray[np.float64],
    counts: NDArray[np.int64],
    sq: NDArray[np.float32],
    stack: NDArray[np.void],
) -> None:
    """The k nearest neighbours of the queries `begin` to `end`, written to the rows of the outputs.

    Neighbouring queries have neighbouring answers: the last answer bounds the next one from above (exactly, since its
    points are in the tree), which spares most of the search in scans.
    """
    k = len(sq)
    width = np.uint32(BUCKET)
    leaf = view.leaf
    first = np.uint32(len(stack) - k)
    found = np.int64(0)
    for row in range(begin, end):
        x, y, z = queries[row, 0], queries[row, 1], queries[row, 2]
        bound = max_sq
        if found == k:
            farthest = np.float32(0)
            for i in range(k):
                point = np.uint32(stack[first + np.uint32(i)]["ref"])
                farthest = max(farthest, point_sq(leaf, np.uint32(point // width), np.uint32(point % width), x, y, z))
            bound = min(bound, farthest)
        found = five_nearest(view, x, y, z, bound, sq, stack) if k == 5 else knn(view, x, y, z, bound, sq, stack)
        counts[row] = found
        for i in range(found):
            point = np.uint32(stack[first + np.uint32(i)]["ref"])
            record, j = leaf[point // width], np.uint32(point % width)
            distances[row, i] = math.sqrt(np.float64(sq[i]))
            points[row, i, 0] = np.float64(record["x"][j]) + origin[0]
            points[row, i, 1] = np.float64(record["y"][j]) + origin[1]
            points[row, i, 2] = np.float64(record["z"][j]) + origin[2]
        for i in range(found, k):
            distances[row, i] = np.inf
            for axis in range(3):
                points[row, i, axis] = np.nan


@kernel(borrow=True)
def collect(
    view: IkdView,
    box: NDArray[np.float32],
    x: np.float32,
    y: np.float32,
    z: np.float32,
    max_sq: np.float32,
    out: NDArray[np.float32],
    stack: NDArray[np.void],
) -> np.int64:
    """All live points of a half-open box within `max_sq` of a point; returns how many, even if `out` (N, 3) is too short."""
    inner, leaf = view
    found = np.int64(0)
    stack[0]["ref"] = ROOT
    stack[0]["live"] = ZERO
    top = 1
    while top > 0:
        top -= 1
        node, above = np.uint32(stack[top]["ref"]), np.uint32(stack[top]["live"])
        for side in (LEFT, RIGHT):
            ref = np.uint32(inner[node]["child"][side])
            label = LABEL_LIVE if above else inner[node]["label"][side]
            if ref == NIL or label == LABEL_DEAD or disjoint(inner[node]["box"], side, box):
                continue
            if ref < LEAF_BIT:
                stack[top]["ref"] = ref
                stack[top]["live"] = np.uint32(label == LABEL_LIVE)
                top += 1
                continue
            index = np.uint32(ref & INDEX_MASK)
            bits = in_box(leaf, index, box)
            if label == LABEL_NONE:
                bits &= np.uint32(leaf[index]["live"])
            while bits != ZERO:
                i = trailing_zeros(bits)
                bits &= bits - ONE
                if point_sq(leaf, index, i, x, y, z) <= max_sq:
                    if found < len(out):
                        out[found, 0] = leaf[index]["x"][i]
                        out[found, 1] = leaf[index]["y"][i]
                        out[found, 2] = leaf[index]["z"][i]
                    found += 1
    return found
