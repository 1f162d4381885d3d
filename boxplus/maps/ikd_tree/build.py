"""Building a balanced subtree from an array of points, in slices of bounded work.

The builder is a small machine whose state lives in a record: it can stop after any number of points and go on in the next
call. A subtree is finished depth first, so its records lie in memory in the order a search visits them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.maps.ikd_tree.leaf import BUCKET
from boxplus.maps.ikd_tree.pool import (
    FILL,
    LABEL_DEAD,
    LABEL_NONE,
    LEAF_BIT,
    ONE,
    ZERO,
    Pool,
    has_room,
    take_inner,
    take_leaf,
)

BUILD_DEPTH = 128
_SAMPLES = 63
_EXACT = 1024  # ranges up to this size are halved exactly, larger ones to within 1/32

NEXT, MEASURE, SELECT_LESS, SELECT_EQUAL, BUILT = 0, 1, 2, 3, 4

TASK = np.dtype([("begin", np.uint32), ("end", np.uint32), ("node", np.uint32), ("side", np.uint32)], align=True)
BUILDER = np.dtype(
    [
        ("phase", np.uint32),
        ("top", np.uint32),
        ("task", TASK, BUILD_DEPTH),  # ranges still to build
        ("begin", np.uint32),  # the range at hand and the slot it belongs to
        ("end", np.uint32),
        ("node", np.uint32),
        ("side", np.uint32),
        ("cursor", np.uint32),
        ("dead", np.uint32),
        ("box", np.float32, 6),
        ("axis", np.uint32),
        ("pivot", np.float32),
        ("low", np.uint32),  # the part of the range that still holds the median
        ("high", np.uint32),
        ("boundary", np.uint32),
        ("sample", np.float32, _SAMPLES),
    ],
    align=True,
)


@kernel(borrow=True)
def start_build(builder: NDArray[np.void], points: np.uint32, node: np.uint32, side: np.uint32) -> None:
    """Prepare to build the first `points` rows of a buffer into a slot."""
    state = builder[0]
    state["phase"] = np.uint32(NEXT)
    state["top"] = ZERO
    if points:
        push_task(builder, ZERO, points, node, side)


@kernel(inline=True, borrow=True)
def push_task(builder: NDArray[np.void], begin: np.uint32, end: np.uint32, node: np.uint32, side: np.uint32) -> None:
    """Remember a range to build."""
    top = builder[0]["top"]
    task = builder[0]["task"][top]
    task["begin"] = begin
    task["end"] = end
    task["node"] = node
    task["side"] = side
    builder[0]["top"] = top + ONE


@kernel(borrow=True)
def choose_pivot(builder: NDArray[np.void], points: NDArray[np.float32], target: np.uint32) -> None:
    """Pick the element of a sample of [low, high) whose rank is that of `target`, and start a partition around it."""
    state = builder[0]
    low, high, axis = np.uint32(state["low"]), np.uint32(state["high"]), np.uint32(state["axis"])
    sample = state["sample"]
    size = np.int64(high) - np.int64(low)
    count = np.int64(_SAMPLES) if size > _EXACT else (15 if size > 128 else 5)
    count = min(count, size)
    for i in range(count):
        value = points[np.uint32(np.int64(low) + (2 * i + 1) * size // (2 * count)), axis]
        j = i
        while j > 0 and sample[j - 1] > value:
            sample[j] = sample[j - 1]
            j -= 1
        sample[j] = value
    rank = (np.int64(target) - np.int64(low)) * count // size
    state["pivot"] = sample[min(max(rank, 0), count - 1)]
    state["cursor"] = low
    state["boundary"] = low
    state["phase"] = np.uint32(SELECT_LESS)


@kernel(borrow=True)
def make_leaf(pool: Pool, builder: NDArray[np.void], points: NDArray[np.float32]) -> None:
    """Turn the range at hand into a leaf."""
    state = builder[0]
    begin, end = np.uint32(state["begin"]), np.uint32(state["end"])
    index = take_leaf(pool)
    leaf = pool.leaf[index]
    x, y, z = leaf["x"], leaf["y"], leaf["z"]
    live = ZERO
    for i in range(end - begin):
        row = np.uint32(begin + i)
        x[i] = points[row, 0]
        y[i] = points[row, 1]
        z[i] = points[row, 2]
        if points[row, 3] == 0:
            live |= ONE << np.uint32(i)
    leaf["count"] = np.uint32(end - begin)
    leaf["live"] = live
    leaf["stamp"] = ZERO
    pool.inner[state["node"]]["child"][state["side"]] = index | LEAF_BIT


@kernel(borrow=True)
def split_range(pool: Pool, builder: NDArray[np.void], middle: np.uint32, split: np.float32) -> None:
    """Turn the range at hand into an inner node, and note its halves; the left one is built first."""
    state = builder[0]
    begin, end = np.uint32(state["begin"]), np.uint32(state["end"])
    index = take_inner(pool)
    pool.inner[index]["axis"] = np.uint8(state["axis"])
    pool.inner[index]["split"] = split
    pool.counts[index]["size"] = np.uint32(end - begin)
    pool.counts[index]["dead"] = np.uint32(state["dead"])
    pool.inner[state["node"]]["child"][state["side"]] = index
    push_task(builder, middle, end, index, ONE)
    push_task(builder, begin, middle, index, ZERO)
    state["phase"] = np.uint32(NEXT)


@kernel(borrow=True)
def measure(builder: NDArray[np.void], points: NDArray[np.float32], stop: np.uint32) -> None:
    """Extend the box of the range at hand by its points up to `stop`."""
    state = builder[0]
    box = state["box"]
    x0, y0, z0, x1, y1, z1 = box[0], box[1], box[2], box[3], box[4], box[5]
    dead = np.float32(0)
    for i in range(np.uint32(state["cursor"]), stop):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        x0 = x if x < x0 else x0
        y0 = y if y < y0 else y0
        z0 = z if z < z0 else z0
        x1 = x if x > x1 else x1
        y1 = y if y > y1 else y1
        z1 = z if z > z1 else z1
        dead += points[i, 3]
    box[0], box[1], box[2], box[3], box[4], box[5] = x0, y0, z0, x1, y1, z1
    state["dead"] += np.uint32(dead)
    state["cursor"] = stop


@kernel(borrow=True)
def partition(builder: NDArray[np.void], points: NDArray[np.float32], stop: np.uint32, inclusive: bool) -> None:
    """Move what is below the pivot (or equal, if `inclusive`) to the front; branch-free, one pass."""
    state = builder[0]
    axis, pivot, boundary = np.uint32(state["axis"]), np.float32(state["pivot"]), np.uint32(state["boundary"])
    for i in range(np.uint32(state["cursor"]), stop):
        x, y, z, w = points[i, 0], points[i, 1], points[i, 2], points[i, 3]
        value = points[i, axis]
        points[i, 0] = points[boundary, 0]
        points[i, 1] = points[boundary, 1]
        points[i, 2] = points[boundary, 2]
        points[i, 3] = points[boundary, 3]
        points[boundary, 0] = x
        points[boundary, 1] = y
        points[boundary, 2] = z
        points[boundary, 3] = w
        boundary += np.uint32(value < pivot or (inclusive and value == pivot))
    state["boundary"] = boundary
    state["cursor"] = stop


@kernel(borrow=True)
def build_step(pool: Pool, builder: NDArray[np.void], points: NDArray[np.float32], budget: np.int64) -> np.int64:
    """Go on building until done or `budget` point visits are spent; returns what is left of the budget.

    `points` is (N, 4) float32: x, y, z relative to the origin and 1 for a deleted point, else 0; it is reordered.
    The caller checks `phase` for BUILT; it also stops when there is no room for another node.
    """
    state = builder[0]
    while budget > 0:
        phase = state["phase"]
        if phase == NEXT:
            if state["top"] == ZERO:
                state["phase"] = np.uint32(BUILT)
                return budget
            if not has_room(pool, ONE, ONE):
                return np.int64(0)
            state["top"] -= ONE
            task = state["task"][state["top"]]
            state["begin"], state["end"] = task["begin"], task["end"]
            state["node"], state["side"] = task["node"], task["side"]
            state["cursor"] = task["begin"]
            state["dead"] = ZERO
            for axis in range(3):
                state["box"][axis] = np.inf
                state["box"][axis + 3] = -np.inf
            state["phase"] = np.uint32(MEASURE)
            continue
        begin, end = np.uint32(state["begin"]), np.uint32(state["end"])
        size = np.uint32(end - begin)
        cursor = np.uint32(state["cursor"])
        leaves = np.uint32((size + np.uint32(FILL - 1)) // np.uint32(FILL))
        target = np.uint32(np.int64(begin) + np.int64(size) * np.int64(leaves // np.uint32(2)) // np.int64(leaves))
        if phase == MEASURE:
            stop = np.uint32(min(np.int64(end), np.int64(cursor) + budget))
            budget -= np.int64(stop - cursor)
            measure(builder, points, stop)
            if stop < end:
                return np.int64(0)
            slot = pool.inner[state["node"]]
            box = state["box"]
            for i in range(6):
                slot["box"][state["side"], i] = box[i]
            slot["label"][state["side"]] = LABEL_DEAD if state["dead"] == size else LABEL_NONE
            if size <= np.uint32(BUCKET):
                make_leaf(pool, builder, points)
                state["phase"] = np.uint32(NEXT)
                continue
            dx, dy, dz = box[3] - box[0], box[4] - box[1], box[5] - box[2]
            state["axis"] = np.uint32(0 if dx >= dy and dx >= dz else (1 if dy >= dz else 2))
            state["low"] = begin
            state["high"] = end
            choose_pivot(builder, points, target)
            continue
        tolerance = size // np.uint32(32) if size > np.uint32(_EXACT) else ZERO
        high = np.uint32(state["high"])
        stop = np.uint32(min(np.int64(high), np.int64(cursor) + budget))
        budget -= np.int64(stop - cursor)
        partition(builder, points, stop, phase == SELECT_EQUAL)
        if stop < high:
            return np.int64(0)
        boundary = np.uint32(state["boundary"])
        if phase == SELECT_LESS and boundary > target + tolerance:
            state["high"] = boundary
            choose_pivot(builder, points, target)
        elif boundary + tolerance >= target:
            # Equal coordinates may go to either side: after an inclusive pass every cut up to the boundary is valid.
            split_range(pool, builder, min(boundary, target) if phase == SELECT_EQUAL else boundary, state["pivot"])
        elif boundary > state["low"] or phase == SELECT_EQUAL:
            state["low"] = boundary
            choose_pivot(builder, points, target)
        else:  # the pivot is the smallest element: set all its equals aside
            state["cursor"] = state["low"]
            state["phase"] = np.uint32(SELECT_EQUAL)
    return budget
