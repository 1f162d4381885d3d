"""Searches in an ikd-tree: k nearest neighbours, radius and box. They only read, so threads may search side by side.

A pending lazy label is carried down the traversal instead of being pushed into the tree: a slot labelled *deleted* is
skipped, below a slot labelled *live* the marks of the leaves do not count. Squared distances are plain float32 sums
`dx² + dy² + dz²` (no contraction), the distance to a box is formed the same way and therefore never exceeds the distance
to a point in it, not even by rounding: pruning is exact. Neighbours are ordered by (distance², x, y, z), so that equal
distances do not depend on the shape of the tree (docs/ikd_tree.md).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.maps.ikd_tree.inner import boxes_sq
from boxplus.maps.ikd_tree.leaf import BUCKET, count_bits, lanes_within, trailing_zeros
from boxplus.maps.ikd_tree.nearest_list import LANES, entry, list_of, take_in, ties
from boxplus.maps.ikd_tree.pool import (
    INDEX_MASK,
    LABEL_DEAD,
    LABEL_LIVE,
    LEAF_BIT,
    LEFT,
    NIL,
    ONE,
    ROOT,
    ZERO,
    all_bits,
)

STACK = np.dtype([("ref", np.uint32), ("sq", np.float32), ("live", np.uint32)], align=True)
STACK_DEPTH = 256  # the tree keeps its height below this
_POINT_BITS = np.uint64(32)


class IkdView(NamedTuple):
    """What a kernel needs to search a tree; valid until the next update. Coordinates are relative to the tree's origin."""

    inner: NDArray[np.void]
    leaf: NDArray[np.void]


@kernel(inline=True, borrow=True)
def leaf_within(
    leaf: NDArray[np.void], index: np.uint32, qx: np.float32, qy: np.float32, qz: np.float32, max_sq: np.float32, live: np.uint32
) -> np.uint32:
    """Which live points of a leaf lie within `max_sq` (as bits); `live` overrides the deletion marks."""
    record = leaf[index]
    bits = lanes_within(leaf, np.uint32(index), qx, qy, qz, max_sq)
    return np.uint32(bits & (all_bits(np.uint32(record["count"])) if live else np.uint32(record["live"])))


@kernel(inline=True, borrow=True)
def point_sq(
    leaf: NDArray[np.void], index: np.uint32, i: np.uint32, qx: np.float32, qy: np.float32, qz: np.float32
) -> np.float32:
    """Squared distance to one point of a leaf, to the same bits as the vectorised scan."""
    record = leaf[index]
    dx, dy, dz = record["x"][i] - qx, record["y"][i] - qy, record["z"][i] - qz
    return np.float32(dx * dx + dy * dy + dz * dz)


@kernel(borrow=True)
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


@kernel(inline=True, borrow=True)
def comes_before(leaf: NDArray[np.void], sq: np.float32, point: np.uint32, other_sq: np.float32, other: np.uint32) -> bool:
    """Whether a point is nearer than another, or as near and earlier by (x, y, z)."""
    return bool(sq < other_sq or (sq == other_sq and precedes(leaf, point, other)))


@kernel(inline=True, borrow=True)
def enter(
    inner: NDArray[np.void], qx: np.float32, qy: np.float32, qz: np.float32, max_sq: np.float32
) -> tuple[np.uint32, np.uint32]:
    """Descend from the root as long as the ball lies on one side of the split, where one comparison a level will do.

    Returns the reference and whether all below is live; NIL if nothing is there, or the query is not finite.
    """
    ref, label = np.uint32(inner[ROOT]["child"][LEFT]), np.uint8(inner[ROOT]["label"][LEFT])
    while ref < LEAF_BIT:
        axis = inner[ref]["axis"]
        offset = (qx if axis == 0 else (qy if axis == 1 else qz)) - inner[ref]["split"]
        if not offset * offset > max_sq:
            break
        side = np.uint32(offset > 0)
        label = label if label else np.uint8(inner[ref]["label"][side])
        ref = np.uint32(inner[ref]["child"][side])
    finite = math.isfinite(np.float64(qx) + np.float64(qy) + np.float64(qz))
    return np.uint32(NIL if label == LABEL_DEAD or not finite else ref), np.uint32(label == LABEL_LIVE)


@kernel(inline=True, borrow=True)
def next_leaf(
    inner: NDArray[np.void],
    ref: np.uint32,
    live: np.uint32,
    top: np.uint32,
    worst: np.float32,
    qx: np.float32,
    qy: np.float32,
    qz: np.float32,
    stack: NDArray[np.void],
) -> tuple[np.uint32, np.uint32, np.uint32]:
    """Go on from a reference, or from the stack if it is NIL, to the next leaf within `worst`, the nearer child first.

    Returns the leaf (NIL if there is none), whether all in it is live, and the new `top`.
    """
    while True:
        while ref < LEAF_BIT:
            node = inner[ref]
            child, label = node["child"], node["label"]
            sq_left, sq_right = boxes_sq(inner, ref, qx, qy, qz)
            left, right = np.uint32(child[0]), np.uint32(child[1])
            live_left = live_right = live
            if label[0] | label[1] and not live:
                left = NIL if label[0] == LABEL_DEAD else left
                right = NIL if label[1] == LABEL_DEAD else right
                live_left = np.uint32(label[0] == LABEL_LIVE)
                live_right = np.uint32(label[1] == LABEL_LIVE)
            swap = sq_right < sq_left
            near, far = (right, left) if swap else (left, right)
            sq_near, sq_far = (sq_right, sq_left) if swap else (sq_left, sq_right)
            live, live_far = (live_right, live_left) if swap else (live_left, live_right)
            stack[top]["ref"] = far
            stack[top]["sq"] = sq_far
            stack[top]["live"] = live_far
            top += np.uint32((sq_far <= worst) & (far != NIL))
            ref = near if sq_near <= worst else NIL
        if ref != NIL:
            return ref, live, top
        while True:
            if top == ZERO:
                return NIL, live, top
            top -= ONE
            if stack[top]["sq"] <= worst:
                break
        ref, live = np.uint32(stack[top]["ref"]), np.uint32(stack[top]["live"])


@kernel(inline=True, borrow=True)
def pack(sq: np.float32, point: np.uint32) -> np.uint64:
    """A squared distance and a point as one number, which is ordered like them."""
    return np.uint64(np.uint64(np.float32(sq).view(np.uint32)) << _POINT_BITS | np.uint64(point))


@kernel(inline=True, borrow=True)
def packed_sq(packed: np.uint64) -> np.float32:
    """The squared distance of a packed point."""
    return np.float32(np.uint32(packed >> _POINT_BITS).view(np.float32))


@kernel(inline=True, borrow=True)
def tied(a: np.uint64, b: np.uint64) -> bool:
    """Whether two packed points, the first not after the second, are equally far."""
    return bool((a >> _POINT_BITS == b >> _POINT_BITS) & (np.uint32(b) != NIL))


@kernel(inline=True, borrow=True)
def few_nearest(
    view: IkdView,
    qx: np.float32,
    qy: np.float32,
    qz: np.float32,
    max_sq: np.float32,
    out_sq: NDArray[np.float32],
    stack: NDArray[np.void],
) -> np.int64:
    """`knn` for fewer than LANES neighbours, without branches; -1 where some are equally far, which this does not settle."""
    inner, leaf = view
    k, width = len(out_sq), np.uint32(BUCKET)
    worst, nearest = max_sq, list_of(pack(max_sq, NIL))
    ref, live = enter(inner, qx, qy, qz, max_sq)
    top = ZERO
    while True:
        ref, live, top = next_leaf(inner, ref, live, top, worst, qx, qy, qz, stack)
        if ref == NIL:
            break
        index = ref & INDEX_MASK
        bits = leaf_within(leaf, index, qx, qy, qz, worst, live)
        while bits != ZERO:
            i = trailing_zeros(bits)
            bits &= bits - ONE
            take_in(nearest, pack(point_sq(leaf, index, i, qx, qy, qz), np.uint32(index * width + i)))
        worst = packed_sq(entry(nearest, np.uint32(k - 1)))
        ref = NIL
    if ties(nearest) & all_bits(np.uint32(k)):
        return np.int64(-1)
    first = np.uint32(len(stack) - k)
    found = np.int64(0)
    for place in range(k):
        packed = entry(nearest, np.uint32(place))
        out_sq[place] = packed_sq(packed)
        stack[first + np.uint32(place)]["ref"] = np.uint32(packed)
        found += np.int64(np.uint32(packed) != NIL)
    return found


@kernel(borrow=True)
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
    if k < LANES:
        few = few_nearest(view, qx, qy, qz, max_sq, out_sq, stack)
        if few >= 0:
            return np.int64(few)
    last = np.uint32(k - 1)
    first = np.uint32(len(stack) - k)
    worst = max_sq
    found = 0
    for row in range(k):
        out_sq[row] = max_sq
        stack[first + np.uint32(row)]["ref"] = NIL
    width = np.uint32(BUCKET)
    ref, live = enter(inner, qx, qy, qz, max_sq)
    top = ZERO
    while True:
        ref, live, top = next_leaf(inner, ref, live, top, worst, qx, qy, qz, stack)
        if ref == NIL:
            return np.int64(min(found, k))
        index = ref & INDEX_MASK
        bits = leaf_within(leaf, index, qx, qy, qz, worst, live)
        while bits != ZERO:
            i = trailing_zeros(bits)
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
        ref = NIL


@kernel(borrow=True)
def has_within(
    view: IkdView, qx: np.float32, qy: np.float32, qz: np.float32, max_sq: np.float32, count: np.int64, stack: NDArray[np.void]
) -> bool:
    """Whether at least `count` (1 or more) live points lie within `max_sq` (inclusive) of a query: ends when so many are found.

    Args:
        view: the tree.
        qx, qy, qz: query, float32, relative to the tree's origin [m].
        max_sq: squared range [m²].
        count: how many points are enough.
        stack: (STACK_DEPTH,) of STACK, scratch of the calling thread.
    """
    inner, leaf = view
    found = np.int64(0)
    ref, live = enter(inner, qx, qy, qz, max_sq)
    top = ZERO
    while True:
        ref, live, top = next_leaf(inner, ref, live, top, max_sq, qx, qy, qz, stack)
        if ref == NIL:
            return False
        found += np.int64(count_bits(leaf_within(leaf, ref & INDEX_MASK, qx, qy, qz, max_sq, live)))
        if found >= count:
            return True
        ref = NIL


@kernel(inline=True, borrow=True)
def copy_found(view: IkdView, stack: NDArray[np.void], k: int, found: int, out_xyz: NDArray[np.float32]) -> None:
    """Copy the `found` points of a search for k, which it left in the last rows of `stack`, to `out_xyz` (k, 3)."""
    first = len(stack) - k
    for i in range(found):
        point = np.uint32(stack[first + i]["ref"])
        record = view.leaf[point // np.uint32(BUCKET)]
        j = np.uint32(point % np.uint32(BUCKET))
        out_xyz[i, 0] = record["x"][j]
        out_xyz[i, 1] = record["y"][j]
        out_xyz[i, 2] = record["z"][j]


@kernel(borrow=True)
def five_nearest(
    view: IkdView,
    qx: np.float32,
    qy: np.float32,
    qz: np.float32,
    max_sq: np.float32,
    out_sq: NDArray[np.float32],
    stack: NDArray[np.void],
) -> np.int64:
    """`knn` for k = 5, the search of an odometry, with the neighbours in registers and sorted without a branch.

    A sixth neighbour is kept to recognise equal distances, which this order does not settle: then `knn` does.
    """
    inner, leaf = view
    width = np.uint32(BUCKET)
    a = b = c = d = e = f = pack(max_sq, NIL)
    worst = max_sq
    ref, live = enter(inner, qx, qy, qz, max_sq)
    top = ZERO
    while True:
        ref, live, top = next_leaf(inner, ref, live, top, worst, qx, qy, qz, stack)
        if ref == NIL:
            break
        index = ref & INDEX_MASK
        bits = leaf_within(leaf, index, qx, qy, qz, worst, live)
        while bits != ZERO:
            i = trailing_zeros(bits)
            bits &= bits - ONE
            new = pack(point_sq(leaf, index, i, qx, qy, qz), np.uint32(index * width + i))
            f = min(f, max(e, new))
            e = min(e, max(d, new))
            d = min(d, max(c, new))
            c = min(c, max(b, new))
            b = min(b, max(a, new))
            a = min(a, new)
        worst = packed_sq(e)
        ref = NIL
    if tied(a, b) | tied(b, c) | tied(c, d) | tied(d, e) | tied(e, f):
        return np.int64(knn(view, qx, qy, qz, max_sq, out_sq, stack))
    first = np.uint32(len(stack) - 5)
    found = np.int64(0)
    for place, packed in enumerate((a, b, c, d, e)):
        out_sq[place] = packed_sq(packed)
        stack[first + np.uint32(place)]["ref"] = np.uint32(packed)
        found += np.int64(np.uint32(packed) != NIL)
    return found


@kernel(borrow=True)
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
    found = five_nearest(view, qx, qy, qz, max_sq, out_sq, stack)
    copy_found(view, stack, 5, found, out_xyz)
    return np.int64(found)
