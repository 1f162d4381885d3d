"""Whole operations on an ikd-tree, one kernel call each: batches of inserts and boxes, and the log of a running rebuild."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.maps.ikd_box import disjoint, in_box
from boxplus.maps.ikd_pool import (
    INDEX_MASK,
    LABEL_DEAD,
    LABEL_LIVE,
    LABEL_NONE,
    LEAF_BIT,
    LEFT,
    NIL,
    ONE,
    ROOT,
    ZERO,
    Pool,
    all_bits,
    has_room,
    lowest_bit,
)
from boxplus.maps.ikd_update import DROP, IDLE, INSERT, MAX_DEPTH, Work, insert_point, update_box


@kernel
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


@kernel
def cell_bounds(value: np.float32, origin: np.float64, cell: np.float64, box: NDArray[np.float32], axis: np.int64) -> None:
    """Bounds of the cell [i c, (i + 1) c) that holds a coordinate, rounded up to float32 relative to the origin.

    `x ≥ b` and `x < b` have the same answer for a float32 `x` before and after rounding `b` up. The bounds are then moved
    by a cell if the division was rounded across one.
    """
    index = math.floor((origin + np.float64(value)) / cell)
    low, high = round_up(index * cell - origin), round_up((index + 1.0) * cell - origin)
    if value < low:
        index -= 1.0
        low, high = round_up(index * cell - origin), low
    elif value >= high:
        index += 1.0
        low, high = high, round_up((index + 1.0) * cell - origin)
    box[axis] = low
    box[axis + 3] = high
    box[axis + 6] = np.float32((index + 0.5) * cell - origin)


@kernel
def round_up(value: np.float64) -> np.float32:
    """The smallest float32 that is not less than `value`."""
    rounded = np.float32(value)
    if np.float64(rounded) < value:
        rounded = np.nextafter(rounded, np.float32(np.inf))
    return rounded


@kernel
def search_cell(
    pool: Pool, slots: NDArray[np.void], cell: NDArray[np.float32], best: NDArray[np.float32]
) -> tuple[np.int64, bool]:
    """The live point of a cell nearest to its centre.

    Args:
        pool: the tree.
        slots: scratch.
        cell: (9,) low, high, centre.
        best: (4,) overwritten: x, y, z of the point and its squared distance to the centre (inf if there is none).

    Returns:
        How many live points the cell holds, and whether it may hold deleted ones.
    """
    best[3] = np.float32(np.inf)
    found = np.int64(0)
    has_dead = False
    slots[0]["node"] = ROOT
    slots[0]["side"] = LEFT
    slots[0]["label"] = LABEL_NONE
    top = 1
    while top > 0:
        top -= 1
        node, side, label = np.uint32(slots[top]["node"]), np.uint32(slots[top]["side"]), slots[top]["label"]
        record = pool.inner[node]
        if disjoint(record["box"], side, cell):
            continue
        ref = record["child"][side]
        if label == LABEL_NONE:
            label = record["label"][side]
        if ref == NIL:
            continue
        if label == LABEL_DEAD:
            has_dead = True
            continue
        if ref < LEAF_BIT:
            for child in range(2):
                slots[top]["node"] = ref
                slots[top]["side"] = np.uint32(child)
                slots[top]["label"] = label
                top += 1
            continue
        leaf = pool.leaf[ref & INDEX_MASK]
        bits = in_box(pool.leaf, np.uint32(ref & INDEX_MASK), cell)
        live = np.uint32(bits & (all_bits(np.uint32(leaf["count"])) if label == LABEL_LIVE else np.uint32(leaf["live"])))
        has_dead = has_dead or bits != live
        while live != ZERO:
            i = lowest_bit(live)
            live &= live - ONE
            found += 1
            x, y, z = leaf["x"][i], leaf["y"][i], leaf["z"][i]
            dx, dy, dz = x - cell[6], y - cell[7], z - cell[8]
            sq = dx * dx + dy * dy + dz * dz
            smaller = x < best[0] or (x == best[0] and (y < best[1] or (y == best[1] and z < best[2])))
            if sq < best[3] or (sq == best[3] and smaller):
                best[0], best[1], best[2], best[3] = x, y, z, sq
    return found, has_dead


@kernel
def insert_batch(
    pool: Pool,
    work: Work,
    points: NDArray[np.float32],
    begin: np.int64,
    cell: np.float64,
    origin: NDArray[np.float64],
) -> np.int64:
    """Insert points from row `begin` on, with downsampling if `cell` > 0 (SPEC 10.5).

    Returns the number of rows done: fewer than all if room ran out or the tree became too deep.
    """
    job = work.job[0]
    bounds, best = work.scratch[:9], work.scratch[9:13]
    for row in range(begin, len(points)):
        if job["phase"] != IDLE and job["logged"] + np.uint32(2) > np.uint32(len(work.log)):
            return row
        if job["depth"] > np.uint32(MAX_DEPTH):
            return row
        if not has_room(pool, np.uint32(2), np.uint32(3)):
            return row
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        if cell > 0:
            cell_bounds(x, origin[0], cell, bounds, 0)
            cell_bounds(y, origin[1], cell, bounds, 1)
            cell_bounds(z, origin[2], cell, bounds, 2)
            found, has_dead = search_cell(pool, work.cell_slots, bounds, best)
            if found > 0:
                dx, dy, dz = x - bounds[6], y - bounds[7], z - bounds[8]
                if best[3] <= dx * dx + dy * dy + dz * dz:
                    if found == 1:
                        continue
                    x, y, z = best[0], best[1], best[2]
            if found > 0 or has_dead:
                job["live"] -= update_box(pool, work, ROOT, LEFT, bounds, DROP)
                log_operation(work, DROP, bounds)
        inside = insert_point(pool, work, ROOT, LEFT, x, y, z)
        job["live"] += 1
        if inside:
            bounds[0], bounds[1], bounds[2] = x, y, z
            log_operation(work, INSERT, bounds)
    return np.int64(len(points))


@kernel
def box_batch(pool: Pool, work: Work, boxes: NDArray[np.float32], kind: np.int64) -> np.int64:
    """Delete or revive all points of each box (K, 6); returns how many points changed. The log must have room for all."""
    changed = np.int64(0)
    for row in range(len(boxes)):
        changed += update_box(pool, work, ROOT, LEFT, boxes[row], kind)
        log_operation(work, kind, boxes[row])
    return changed
