"""Rebuilding subtrees of an ikd-tree: small ones at once, the copy of large ones in slices (docs/ikd_tree.md).

The copy of a large subtree is a snapshot of the moment its rebuild began (`save_leaf` sees to that), while the tree stays
in use and all later operations are logged.
"""

from __future__ import annotations

import numpy as np

from boxplus._jit import kernel
from boxplus.maps.ikd_tree.build import build_step, start_build
from boxplus.maps.ikd_tree.pool import (
    FILL,
    INDEX_MASK,
    LABEL_NONE,
    LEAF_BIT,
    LEFT,
    NIL,
    ONE,
    RIGHT,
    ROOT,
    ZERO,
    Pool,
    free_subtree,
    has_room,
    live_bits,
    slot_size,
)
from boxplus.maps.ikd_tree.update import BUILDING, IDLE, Work, save_leaf, unbalanced


@kernel(borrow=True)
def gather(pool: Pool, work: Work, node: np.uint32, side: np.uint32) -> np.uint32:
    """Copy all points below a slot to the rows of `small`; returns how many there are."""
    row = ZERO
    out, slots = work.small, work.gather
    slots[0]["node"] = node
    slots[0]["side"] = side
    slots[0]["label"] = LABEL_NONE
    top = ONE
    while top > ZERO:
        top -= ONE
        node, side, label = np.uint32(slots[top]["node"]), np.uint32(slots[top]["side"]), np.uint8(slots[top]["label"])
        ref = np.uint32(pool.inner[node]["child"][side])
        if ref == NIL:
            continue
        if label == LABEL_NONE:
            label = np.uint8(pool.inner[node]["label"][side])
        if ref < LEAF_BIT:
            for child in range(2):
                slots[top]["node"] = ref
                slots[top]["side"] = np.uint32(1 - child)
                slots[top]["label"] = label
                top += ONE
            continue
        index = np.uint32(ref & INDEX_MASK)
        leaf = pool.leaf[index]
        live = live_bits(pool.leaf, index, label)
        for i in range(np.uint32(leaf["count"])):
            out[row, 0] = leaf["x"][i]
            out[row, 1] = leaf["y"][i]
            out[row, 2] = leaf["z"][i]
            out[row, 3] = np.float32((live >> np.uint32(i)) & ONE == ZERO)
            row += ONE
    return row


@kernel(borrow=True)
def rebuild_in_place(pool: Pool, work: Work, node: np.uint32, side: np.uint32) -> None:
    """Rebuild a small subtree at once. Room for its nodes must be there."""
    points = gather(pool, work, node, side)
    free_subtree(pool, pool.inner[node]["child"][side])
    pool.inner[node]["child"][side] = NIL
    start_build(work.small_builder, points, node, side)
    build_step(pool, work.small_builder, work.small, np.int64(1) << np.int64(62))


@kernel(borrow=True)
def may_rebuild(pool: Pool, work: Work, node: np.uint32, side: np.uint32, inside: bool) -> bool:
    """Whether a small subtree may be replaced now: neither inside the one being rebuilt nor above it."""
    job = work.job[0]
    if job["phase"] == IDLE:
        return True
    if inside:
        return False
    ref = pool.inner[node]["child"][side]
    above = False
    for i in range(np.uint32(job["ancestors"])):
        above = above or work.ancestors[i] == ref
    return not above


@kernel(borrow=True)
def find_unbalanced(pool: Pool, work: Work, path: np.uint64) -> tuple[np.uint32, np.uint32, np.uint32, bool]:
    """The topmost subtree on a path that is or was out of balance: its slot (node NIL if there is none), its depth, and whether
    it lies in the subtree being rebuilt. `Work.path` gets the inner nodes above it.

    One that was noted counts even if it has come into balance again: what fell out of balance below it meanwhile was not noted.
    """
    job = work.job[0]
    node, side, depth = ROOT, LEFT, ZERO
    inside = False
    bit = np.uint64(1)
    while (path >> np.uint64(1)) >= bit:
        bit <<= np.uint64(1)
    while True:
        ref = np.uint32(pool.inner[node]["child"][side])
        inside = inside or (job["phase"] != IDLE and node == job["node"] and side == job["side"])
        if ref >= LEAF_BIT:
            return NIL, LEFT, ZERO, inside
        if pool.inner[ref]["queued"] or unbalanced(pool, work, ref):
            return node, side, depth, inside
        if bit == np.uint64(1):
            return NIL, LEFT, ZERO, inside
        bit >>= np.uint64(1)
        work.path[depth] = ref
        depth += ONE
        node = ref
        side = np.uint32((path & bit) != np.uint64(0))


@kernel(borrow=True)
def trim_path(path: np.uint64, depth: np.uint32) -> np.uint64:
    """The first `depth` steps of a path."""
    while path >> np.uint64(1) >= np.uint64(1) << np.uint64(depth):
        path >>= np.uint64(1)
    return path


@kernel(borrow=True)
def settle(pool: Pool, work: Work) -> bool:
    """Go through the subtrees noted as out of balance: rebuild small ones, and choose a large one for a rebuild in slices.

    Returns whether there is one; its slot is then in the job and the inner nodes above it in `ancestors`.
    """
    job = work.job[0]
    kept = ZERO
    chosen = False
    for row in range(np.uint32(job["queued"])):
        path = work.queue[row]
        keep = chosen
        if not chosen:
            node, side, depth, inside = find_unbalanced(pool, work, path)
            if node != NIL:
                size = np.uint32(pool.counts[pool.inner[node]["child"][side]]["size"])
                leaves = np.uint32(np.uint32(2) * size // np.uint32(FILL) + np.uint32(4))
                if size <= job["in_place"]:
                    keep = not (may_rebuild(pool, work, node, side, inside) and has_room(pool, leaves, leaves))
                    if not keep:
                        rebuild_in_place(pool, work, node, side)
                elif job["phase"] == IDLE:
                    chosen = True
                    total = slot_size(pool, ROOT, LEFT)
                    if np.uint64(2) * np.uint64(size) > np.uint64(total):  # most of the tree: then all of it
                        node, side, depth = ROOT, LEFT, ZERO
                    for i in range(depth):
                        work.ancestors[i] = work.path[i]
                    job["node"] = node
                    job["side"] = side
                    job["ancestors"] = depth
                    job["path"] = trim_path(path, depth)
                else:
                    keep = True
        if keep:
            work.queue[kept] = path
            kept += ONE
    job["queued"] = kept
    return chosen


@kernel(borrow=True)
def copy_step(pool: Pool, work: Work, budget: np.int64) -> np.int64:
    """Go on copying until done or the budget is spent; returns what is left of it."""
    job = work.job[0]
    slots = work.slots
    while budget > 0 and job["top"] > ZERO:
        top = np.uint32(job["top"] - ONE)
        node, side, label = np.uint32(slots[top]["node"]), np.uint32(slots[top]["side"]), slots[top]["label"]
        job["top"] = top
        ref = np.uint32(pool.inner[node]["child"][side])
        if ref == NIL:
            continue
        if label == LABEL_NONE:
            label = pool.inner[node]["label"][side]
        if ref & LEAF_BIT:
            index = np.uint32(ref & INDEX_MASK)
            save_leaf(pool, work, index, live_bits(pool.leaf, index, label))
            budget -= np.int64(pool.leaf[index]["count"])
        else:
            for i in range(2):
                slots[top]["node"] = ref
                slots[top]["side"] = np.uint32(RIGHT if i == 0 else LEFT)
                slots[top]["label"] = label
                top += ONE
            job["top"] = top
            budget -= 2
    if job["top"] == ZERO:
        job["phase"] = np.uint32(BUILDING)
    return budget
