"""Searches in an ikd-tree: k nearest neighbours, radius and box. They only read, so threads may search side by side.

A pending lazy label is carried down the traversal instead of being pushed into the tree: a slot labelled *deleted* is
skipped, below a slot labelled *live* the marks of the leaves do not count. Squared distances are plain float32 sums
`dx² + dy² + dz²` (no contraction), the distance to a box is formed the same way and therefore never exceeds the distance
to a point in it, not even by rounding: pruning is exact. Neighbours are ordered by (distance², x, y, z), so that equal
distances do not depend on the shape of the tree (SPEC 10.7).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.maps.ikd_pool import (
    BUCKET,
    INDEX_MASK,
    LABEL_DEAD,
    LABEL_LIVE,
    LEAF_BIT,
    LEFT,
    NIL,
    ONE,
    RIGHT,
    ROOT,
    ZERO,
    all_bits,
    lowest_bit,
)

STACK = np.dtype([("ref", np.uint32), ("sq", np.float32), ("live", np.uint32)], align=True)
STACK_DEPTH = 256  # the tree keeps its height below this
_LANES = np.uint32(8)  # the leaf scan runs over a multiple of this many points
_SCAN_MASK = np.uint32(2 * BUCKET - 8)
_ZERO_F = np.float32(0)


class IkdView(NamedTuple):
    """What a kernel needs to search a tree; valid until the next update. Coordinates are relative to the tree's origin."""

    inner: NDArray[np.void]
    leaf: NDArray[np.void]


@kernel(inline=True)
def box_sq(box: NDArray[np.float32], side: np.uint32, qx: np.float32, qy: np.float32, qz: np.float32) -> np.float32:
    """Squared distance from a point to the box of one child."""
    below, above = box[side, 0] - qx, qx - box[side, 3]
    dx = below if below > above else above
    dx = dx if dx > _ZERO_F else _ZERO_F
    below, above = box[side, 1] - qy, qy - box[side, 4]
    dy = below if below > above else above
    dy = dy if dy > _ZERO_F else _ZERO_F
    below, above = box[side, 2] - qz, qz - box[side, 5]
    dz = below if below > above else above
    dz = dz if dz > _ZERO_F else _ZERO_F
    return np.float32(dx * dx + dy * dy + dz * dz)


@kernel(inline=True)
def leaf_within(
    leaf: NDArray[np.void], index: np.uint32, qx: np.float32, qy: np.float32, qz: np.float32, max_sq: np.float32, live: np.uint32
) -> np.uint32:
    """Which live points of a leaf lie within `max_sq` (as bits); `live` overrides the deletion marks.

    The number of rounds is a multiple of eight known to be at most one bucket: LLVM turns that into straight vector code.
    """
    record = leaf[index]
    x, y, z = record["x"], record["y"], record["z"]
    count = np.uint32(record["count"])
    bits = ZERO
    for i in range((count + (_LANES - ONE)) & _SCAN_MASK):
        dx, dy, dz = x[i] - qx, y[i] - qy, z[i] - qz
        bits |= np.uint32(dx * dx + dy * dy + dz * dz <= max_sq) << np.uint32(i)
    return np.uint32(bits & (all_bits(count) if live else np.uint32(record["live"])))


@kernel(inline=True)
def point_sq(
    leaf: NDArray[np.void], index: np.uint32, i: np.uint32, qx: np.float32, qy: np.float32, qz: np.float32
) -> np.float32:
    """Squared distance to one point of a leaf, to the same bits as the vectorised scan."""
    record = leaf[index]
    dx, dy, dz = record["x"][i] - qx, record["y"][i] - qy, record["z"][i] - qz
    return np.float32(dx * dx + dy * dy + dz * dz)


@kernel
def precedes(leaf: NDArray[np.void], a: np.uint32, b: np.uint32) -> bool:
    """Whether point `a` comes before point `b` (leaf · BUCKET + i, or NIL) by (x, y, z); NIL comes last."""
    if b == NIL:
        return True
    width = np.uint32(BUCKET)
    p, q, i, j = leaf[a // width], leaf[b // width], a % width, b % width
    if p["x"][i] != q["x"][j]:
        return bool(p["x"][i] < q["x"][j])
    if p["y"][i] != q["y"][j]:
        return bool(p["y"][i] < q["y"][j])
    return bool(p["z"][i] < q["z"][j])


@kernel(inline=True)
def comes_before(leaf: NDArray[np.void], sq: np.float32, point: np.uint32, other_sq: np.float32, other: np.uint32) -> bool:
    """Whether a point is nearer than another, or as near and earlier by (x, y, z)."""
    return bool(sq < other_sq or (sq == other_sq and precedes(leaf, point, other)))


@kernel
def knn(
    view: IkdView,
    qx: np.float32,
    qy: np.float32,
    qz: np.float32,
    max_sq: np.float32,
    out_sq: NDArray[np.float32],
    stack: NDArray[np.void],
) -> np.int64:
    """The k nearest live points within `max_sq` (inclusive); returns how many there are.

    Args:
        view: the tree.
        qx, qy, qz: query, float32, relative to the tree's origin [m].
        max_sq: squared range [m²]; any upper bound on the last distance² is a warm start.
        out_sq: (k,) float32, overwritten with the squared distances, ascending; `max_sq` where there is none.
        stack: (at least STACK_DEPTH - 5 + k,) of STACK, scratch of the calling thread; the fields `ref` of its last k rows
            are overwritten with the points as leaf · BUCKET + place, NIL where there is none.
    """
    inner, leaf = view
    k = len(out_sq)
    last = np.uint32(k - 1)
    first = np.uint32(len(stack) - k)
    worst = max_sq
    found = 0
    for i in range(k):
        out_sq[i] = max_sq
        stack[first + np.uint32(i)]["ref"] = NIL
    width = np.uint32(BUCKET)
    top = ZERO
    live = ZERO
    ref, label = np.uint32(inner[ROOT]["child"][LEFT]), np.uint8(inner[ROOT]["label"][LEFT])
    if not math.isfinite(np.float64(qx) + np.float64(qy) + np.float64(qz)):
        return np.int64(0)
    # As long as the ball lies on one side of the split, one comparison a level will do.
    while ref < LEAF_BIT:
        axis = inner[ref]["axis"]
        offset = (qx if axis == 0 else (qy if axis == 1 else qz)) - inner[ref]["split"]
        if not offset * offset > worst:
            break
        side = np.uint32(offset > 0)
        label = label if label else np.uint8(inner[ref]["label"][side])
        ref = np.uint32(inner[ref]["child"][side])
    live = np.uint32(label == LABEL_LIVE)
    ref = NIL if label == LABEL_DEAD else ref
    while True:
        while ref < LEAF_BIT:
            node = inner[ref]
            box, child, label = node["box"], node["child"], node["label"]
            sq_left = box_sq(box, LEFT, qx, qy, qz)
            sq_right = box_sq(box, RIGHT, qx, qy, qz)
            left, right = child[0], child[1]
            live_left = live_right = live
            if label[0] | label[1] and not live:
                left = NIL if label[0] == LABEL_DEAD else left
                right = NIL if label[1] == LABEL_DEAD else right
                live_left = np.uint32(label[0] == LABEL_LIVE)
                live_right = np.uint32(label[1] == LABEL_LIVE)
            # Two branches rather than one exchange: near the last query the processor guesses the path and runs ahead.
            if sq_left <= sq_right:
                if sq_right <= worst and right != NIL:
                    stack[top]["ref"] = right
                    stack[top]["sq"] = sq_right
                    stack[top]["live"] = live_right
                    top += ONE
                ref = left if sq_left <= worst else NIL
                live = live_left
            else:
                if sq_left <= worst and left != NIL:
                    stack[top]["ref"] = left
                    stack[top]["sq"] = sq_left
                    stack[top]["live"] = live_left
                    top += ONE
                ref = right if sq_right <= worst else NIL
                live = live_right
        if ref != NIL:
            index = ref & INDEX_MASK
            bits = leaf_within(leaf, index, qx, qy, qz, worst, live)
            while bits != ZERO:
                i = lowest_bit(bits)
                bits &= bits - ONE
                sq = point_sq(leaf, index, i, qx, qy, qz)
                new = np.uint32(index * width + i)
                place = last
                if not comes_before(leaf, sq, new, worst, stack[first + last]["ref"]):
                    continue
                while place > ZERO and comes_before(leaf, sq, new, out_sq[place - ONE], stack[first + place - ONE]["ref"]):
                    out_sq[place] = out_sq[place - ONE]
                    stack[first + place]["ref"] = stack[first + place - ONE]["ref"]
                    place -= ONE
                out_sq[place] = sq
                stack[first + place]["ref"] = new
                worst = out_sq[last]
                found += 1
        while True:
            if top == ZERO:
                ref = NIL
                break
            top -= ONE
            if stack[top]["sq"] <= worst:
                ref = stack[top]["ref"]
                live = stack[top]["live"]
                break
        if ref == NIL:
            break
    return np.int64(min(found, k))


@kernel
def knn5(
    view: IkdView,
    qx: np.float32,
    qy: np.float32,
    qz: np.float32,
    max_sq: np.float32,
    out_xyz: NDArray[np.float32],
    out_sq: NDArray[np.float32],
    stack: NDArray[np.void],
) -> np.int64:
    """The five nearest live points within `max_sq` (inclusive); returns how many there are.

    Args:
        view: the tree.
        qx, qy, qz: query, float32, relative to the tree's origin [m].
        max_sq: squared range [m²]; any upper bound on the fifth distance² is a warm start.
        out_xyz: (5, 3) float32, overwritten with the neighbours, relative to the origin, nearest first.
        out_sq: (5,) float32, their squared distances; `max_sq` where there is none.
        stack: (STACK_DEPTH,) of STACK, scratch of the calling thread.
    """
    found = knn(view, qx, qy, qz, max_sq, out_sq, stack)
    first = len(stack) - len(out_sq)
    for i in range(found):
        point = np.uint32(stack[first + i]["ref"])
        record = view.leaf[point // np.uint32(BUCKET)]
        j = np.uint32(point % np.uint32(BUCKET))
        out_xyz[i, 0] = record["x"][j]
        out_xyz[i, 1] = record["y"][j]
        out_xyz[i, 2] = record["z"][j]
    return np.int64(found)
