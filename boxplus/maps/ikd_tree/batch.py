"""Batches of operations on an ikd-tree, one kernel call each; the log of a running rebuild is replayed by the same kernel."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.maps.ikd_tree.box import disjoint, in_box
from boxplus.maps.ikd_tree.pool import (
    INDEX_MASK,
    LABEL_DEAD,
    LABEL_LIVE,
    LEAF_BIT,
    NIL,
    ONE,
    ZERO,
    Pool,
    all_bits,
    has_room,
)
from boxplus.maps.ikd_tree.update import (
    DROP,
    IDLE,
    INSERT,
    INSERT_DOWNSAMPLED,
    MAX_DEPTH,
    REVIVE,
    Work,
    insert_point,
    update_box,
)


@kernel(borrow=True)
def keep_near(
    world: NDArray[np.float64],
    origin: NDArray[np.float64],
    extent: float,
    relative: NDArray[np.float32],
    is_near: NDArray[np.bool_],
) -> tuple[np.int64, np.int64]:
    """Write the points (N, 3) that are within `extent` of the origin on each axis to the first rows of `relative` (N, 3).

    Returns how many these are, and how many of the others are not finite; `is_near` (N,) receives which these are.
    """
    kept, not_finite = np.int64(0), np.int64(0)
    for row in range(len(world)):
        x, y, z = world[row, 0], world[row, 1], world[row, 2]
        not_finite += np.int64(not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)))
        x, y, z = x - origin[0], y - origin[1], z - origin[2]
        is_near[row] = abs(x) <= extent and abs(y) <= extent and abs(z) <= extent
        if is_near[row]:
            relative[kept, 0], relative[kept, 1], relative[kept, 2] = np.float32(x), np.float32(y), np.float32(z)
            kept += 1
    return kept, not_finite


@kernel(borrow=True)
def fill_operations(points: NDArray[np.float32], kind: np.int64, operations: NDArray[np.void]) -> None:
    """Make an operation of this kind of each point (N, 3)."""
    for row in range(len(points)):
        operations[row]["kind"] = np.uint32(kind)
        for axis in range(3):
            operations[row]["box"][axis] = points[row, axis]


@kernel(inline=True, borrow=True)
def round_up(value: np.float64) -> np.float32:
    """The smallest float32 that is not less than `value`."""
    rounded = np.float32(value)
    step = np.int32(np.float64(rounded) < value)
    bits = np.int32(rounded.view(np.int32))
    return np.float32(np.int32(bits + (step if bits >= 0 else -step)).view(np.float32))


@kernel(borrow=True)
def search_cell(
    pool: Pool, node: np.uint32, side: np.uint32, stack: NDArray[np.void], cell: NDArray[np.float32]
) -> tuple[bool, bool]:
    """Whether a cell, `cell` (6,) low and high corner, holds a live point below a slot, and whether it holds deleted ones.

    The search ends with the first live point: the second answer is complete where the first one is no.
    """
    inner = pool.inner
    has_dead = False
    ref = NIL if disjoint(inner[node]["box"], side, cell) else np.uint32(inner[node]["child"][side])
    label = np.uint8(inner[node]["label"][side])
    top = ZERO
    while True:
        if ref == NIL:
            pass
        elif label == LABEL_DEAD:
            has_dead = True
        elif ref < LEAF_BIT:
            record = inner[ref]  # left ≤ split ≤ right: one comparison a side, the boxes are not worth their loads here
            split, axis = record["split"], np.uint32(record["axis"])
            goes_left, goes_right = cell[axis] <= split, cell[axis + np.uint32(3)] > split
            labels = record["label"]
            if goes_left and goes_right:
                stack[top]["ref"] = record["child"][1]
                stack[top]["label"] = label if label else labels[1]
                top += ONE
            side = np.uint32(not goes_left)
            if goes_left or goes_right:
                ref = np.uint32(record["child"][side])
                label = label if label else np.uint8(labels[side])
                continue
        else:
            index = np.uint32(ref & INDEX_MASK)
            leaf = pool.leaf[index]
            bits = in_box(pool.leaf, index, cell)
            live = np.uint32(bits & (all_bits(np.uint32(leaf["count"])) if label == LABEL_LIVE else np.uint32(leaf["live"])))
            if live != ZERO:
                return True, has_dead
            has_dead = has_dead or bits != live
        if top == ZERO:
            return False, has_dead
        top -= ONE
        ref = np.uint32(stack[top]["ref"])
        label = np.uint8(stack[top]["label"])


@kernel(borrow=True)
def log_operation(work: Work, kind: np.int64, box: NDArray[np.float32]) -> None:
    """Note an operation for the running rebuild. Room in the log must be there."""
    job = work.job[0]
    if job["phase"] == IDLE:
        return
    entry = work.log[job["logged"]]
    entry["kind"] = np.uint32(kind)
    for i in range(6):
        entry["box"][i] = box[i]
    job["logged"] += ONE


@kernel(borrow=True)
def set_cell(
    x: np.float32, y: np.float32, z: np.float32, origin: NDArray[np.float64], size: float, cell: NDArray[np.float32]
) -> None:
    """The cell [i c, (i + 1) c) of a point: `cell` (6,) gets its low and high corner, relative to the origin.

    The bounds are rounded up to float32: `x ≥ b` and `x < b` have the same answer for a float32 `x` before and after. They
    are moved by a cell if the division was rounded across one.
    """
    for axis in range(3):
        value = x if axis == 0 else (y if axis == 1 else z)
        index = math.floor((origin[axis] + np.float64(value)) / size)
        low, high = round_up(index * size - origin[axis]), round_up((index + 1.0) * size - origin[axis])
        if value < low:
            index -= 1.0
            low, high = round_up(index * size - origin[axis]), low
        elif value >= high:
            index += 1.0
            low, high = high, round_up((index + 1.0) * size - origin[axis])
        cell[axis] = low
        cell[axis + 3] = high


@kernel(borrow=True)
def update_batch(
    pool: Pool,
    work: Work,
    operations: NDArray[np.void],
    begin: np.int64,
    end: np.int64,
    node: np.uint32,
    side: np.uint32,
    cell_size: float,
    origin: NDArray[np.float64],
) -> np.int64:
    """Apply the operations `begin` to `end` below a slot, in order: to the tree, or to a new subtree from the log.

    Returns the number of the next operation: less than `end` if room ran out or the tree became too deep. `changed` of the
    job is increased by the number of points deleted, revived and (of those given) stored; of the latter the kind becomes INSERT.
    """
    job = work.job[0]
    cell, box = work.scratch[:6], work.scratch[6:12]
    for row in range(begin, end):
        if job["phase"] != IDLE and job["logged"] + np.uint32(2) > np.uint32(len(work.log)):
            return np.int64(row)
        kind = np.int64(operations[row]["kind"])
        for i in range(6):
            box[i] = operations[row]["box"][i]
        if kind <= REVIVE:  # or DELETE
            changed = update_box(pool, work, node, side, box, kind)
            job["changed"] += changed
            job["live"] += changed if kind == REVIVE else -changed
            log_operation(work, kind, box)
            continue
        x, y, z = box[0], box[1], box[2]
        drop = kind == DROP
        if kind == INSERT_DOWNSAMPLED:
            set_cell(x, y, z, origin, cell_size, cell)
            taken, drop = search_cell(pool, node, side, work.cell_stack, cell)
            if taken:
                continue
            for i in range(6):
                box[i] = cell[i]
        if job["depth"] > np.uint32(MAX_DEPTH) or not has_room(pool, np.uint32(2), np.uint32(4)):
            return np.int64(row)
        if drop:
            job["live"] -= update_box(pool, work, node, side, box, DROP)
            log_operation(work, DROP, box)
        if kind != DROP:
            inside = insert_point(pool, work, node, side, x, y, z)
            operations[row]["kind"] = np.uint32(INSERT)  # what is stored can be told from what its cell did not take
            job["live"] += 1
            job["changed"] += 1
            if inside:
                box[0], box[1], box[2] = x, y, z
                log_operation(work, INSERT, box)
    return np.int64(end)
