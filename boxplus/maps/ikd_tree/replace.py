"""Putting a point of an ikd-tree in the place of another one, or dropping a single one, without a search of its surroundings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.maps.ikd_tree.leaf import BUCKET
from boxplus.maps.ikd_tree.pool import LABEL_DEAD, LABEL_NONE, LEAF_BIT, ONE, ZERO, Pool, live_bits, slot_size
from boxplus.maps.ikd_tree.update import (
    COPYING,
    DROP,
    IDLE,
    INSERT,
    LONG_PATH,
    Work,
    extend_box,
    note_unbalanced,
    push_down,
    save_leaf,
)


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
def replace_point(
    pool: Pool,
    work: Work,
    node: np.uint32,
    side: np.uint32,
    x: np.float32,
    y: np.float32,
    z: np.float32,
    cell: NDArray[np.float32],
    point: np.uint32,
) -> bool:
    """Put a point in the place of the only one of its cell, if it belongs in the same leaf; returns whether it does.

    No count and no balance changes. The boxes passed are extended in either case: if not here, the point goes there next.
    """
    job = work.job[0]
    label = LABEL_NONE
    inside = False
    while True:
        extend_box(pool, node, side, x, y, z)
        record = pool.inner[node]
        label = label if label else np.uint8(record["label"][side])
        inside = inside or (job["phase"] != IDLE and node == job["node"] and side == job["side"])
        ref = np.uint32(record["child"][side])
        if ref >= LEAF_BIT:
            break
        axis = pool.inner[ref]["axis"]
        value = x if axis == 0 else (y if axis == 1 else z)
        node = ref
        side = np.uint32(value >= pool.inner[ref]["split"])
    index, i = np.uint32(point // np.uint32(BUCKET)), np.uint32(point % np.uint32(BUCKET))
    if ref != index | LEAF_BIT:
        return False
    if inside:
        if job["phase"] == COPYING:
            save_leaf(pool, work, index, live_bits(pool.leaf, index, label))
        log_operation(work, DROP, cell)
        cell[0], cell[1], cell[2] = x, y, z
        log_operation(work, INSERT, cell)
    leaf = pool.leaf[index]
    leaf["x"][i] = x
    leaf["y"][i] = y
    leaf["z"][i] = z
    return True


@kernel(borrow=True)
def remove_point(pool: Pool, work: Work, node: np.uint32, side: np.uint32, point: np.uint32) -> bool:
    """Drop a live stored point (leaf · BUCKET + place) below a slot; returns False if its leaf is not where the splits lead.

    That is so if it equals a split and lies left of it. Nothing is changed then.
    """
    inner, counts, job = pool.inner, pool.counts, work.job[0]
    index, i = np.uint32(point // np.uint32(BUCKET)), np.uint32(point % np.uint32(BUCKET))
    leaf = pool.leaf[index]
    x, y, z = leaf["x"][i], leaf["y"][i], leaf["z"][i]
    top, beside = node, side
    ref = np.uint32(inner[top]["child"][beside])
    while ref < LEAF_BIT:
        axis = inner[ref]["axis"]
        value = x if axis == 0 else (y if axis == 1 else z)
        beside = np.uint32(value >= inner[ref]["split"])
        ref = np.uint32(inner[ref]["child"][beside])
    if ref != index | LEAF_BIT:
        return False
    inside = noted = False
    path = np.uint64(1)
    above = ZERO
    while True:
        push_down(pool, node, side)
        ref = np.uint32(inner[node]["child"][side])
        size = np.uint32(slot_size(pool, node, side) - ONE)
        if above > job["check"] and not noted and max(size, np.uint32(above - size)) > job["balance"] * np.float32(above - ONE):
            noted = True
            if not inside:
                note_unbalanced(pool, work, node, path >> np.uint64(1))
        above = size
        inside = inside or (job["phase"] != IDLE and node == job["node"] and side == job["side"])
        if ref >= LEAF_BIT:
            break
        counts[ref]["size"] = size
        if size == counts[ref]["dead"]:
            inner[node]["label"][side] = LABEL_DEAD
        axis = inner[ref]["axis"]
        value = x if axis == 0 else (y if axis == 1 else z)
        node = ref
        side = np.uint32(value >= inner[ref]["split"])
        path = (path << np.uint64(1)) | np.uint64(side) if path < LONG_PATH else path
    if inside and job["phase"] == COPYING:
        save_leaf(pool, work, index, np.uint32(leaf["live"]))
    last = np.uint32(leaf["count"] - ONE)
    leaf["x"][i], leaf["y"][i], leaf["z"][i] = leaf["x"][last], leaf["y"][last], leaf["z"][last]
    moved = np.uint32((leaf["live"] >> last) & ONE)
    leaf["live"] = np.uint32((leaf["live"] & ~(ONE << i) & ~(ONE << last)) | (moved << i if i != last else ZERO))
    leaf["count"] = last
    return True
