"""Rebuilding a large subtree of an ikd-tree in slices: copy, build, replay the operation log, swap (SPEC 10.6).

The copy is a snapshot of the subtree at the start of the rebuild (`save_leaf` sees to that), the tree stays in use, and
all later operations are logged. Every step does a bounded number of point visits, so a caller decides by counting, never
by a clock, when the work is done; on which thread does not matter.
"""

from __future__ import annotations

import numpy as np

from boxplus._jit import kernel
from boxplus.maps.ikd_pool import (
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
    slot_counts,
)
from boxplus.maps.ikd_update import (
    BUILDING,
    COPYING,
    IDLE,
    INSERT,
    Work,
    insert_point,
    may_rebuild,
    rebuild_in_place,
    save_leaf,
    unbalanced,
    update_box,
)

_REPLAY_COST = 64  # point visits an operation of the log counts for


@kernel
def start_job(work: Work, node: np.uint32, side: np.uint32, ancestors: np.uint32, keep_dead: bool) -> None:
    """Begin to rebuild the subtree of a slot. The copy must have room for all its points."""
    job = work.job[0]
    job["phase"] = np.uint32(COPYING)
    job["node"] = node
    job["side"] = side
    job["ancestors"] = ancestors
    job["stamp"] += ONE
    job["keep_dead"] = np.uint32(keep_dead)
    job["copied"] = ZERO
    job["logged"] = ZERO
    job["replayed"] = ZERO
    work.slots[0]["node"] = node
    work.slots[0]["side"] = side
    work.slots[0]["label"] = LABEL_NONE
    job["top"] = ONE


@kernel
def settle(pool: Pool, work: Work) -> bool:
    """Go through the subtrees noted as out of balance: rebuild small ones, and choose a large one for a rebuild in slices.

    Returns whether there is one; its slot is then in the job and the inner nodes above it in `ancestors`.
    """
    job = work.job[0]
    kept = ZERO
    chosen = False
    for row in range(np.uint32(job["queued"])):
        x, y, z = work.queue[row, 0], work.queue[row, 1], work.queue[row, 2]
        if chosen:
            keep = True
        else:
            node, side, depth = find_unbalanced(pool, work, x, y, z)
            keep = False
            if node != NIL:
                ref = np.uint32(pool.inner[node]["child"][side])
                size = np.uint32(pool.count[ref]["size"])
                if size <= job["in_place"]:
                    leaves = np.uint32(size // np.uint32(8) + np.uint32(4))
                    keep = not (may_rebuild(pool, work, node, side, True) and has_room(pool, leaves, leaves))
                    if not keep:
                        rebuild_in_place(pool, work, node, side)
                elif job["phase"] == IDLE:
                    chosen = True
                    total, _ = slot_counts(pool, ROOT, LEFT)
                    if np.uint64(2) * np.uint64(size) > np.uint64(total):
                        node, side, depth = ROOT, LEFT, ZERO
                    for i in range(depth):
                        work.ancestors[i] = work.path[i]["node"]
                    job["node"] = node
                    job["side"] = side
                    job["ancestors"] = depth
                else:
                    keep = True
        if keep:
            work.queue[kept, 0] = x
            work.queue[kept, 1] = y
            work.queue[kept, 2] = z
            kept += ONE
    job["queued"] = kept
    return chosen


@kernel
def find_unbalanced(
    pool: Pool, work: Work, x: np.float32, y: np.float32, z: np.float32
) -> tuple[np.uint32, np.uint32, np.uint32]:
    """The topmost unbalanced subtree on the path of a point: its slot (NIL if none) and depth; `path` gets the nodes above."""
    node, side, depth = ROOT, LEFT, ZERO
    while True:
        ref = np.uint32(pool.inner[node]["child"][side])
        if ref >= LEAF_BIT:
            return NIL, LEFT, ZERO
        if unbalanced(pool, work, ref):
            return node, side, depth
        work.path[depth]["node"] = ref
        depth += ONE
        axis = pool.inner[ref]["axis"]
        value = x if axis == 0 else (y if axis == 1 else z)
        node = ref
        side = np.uint32(value >= pool.inner[ref]["split"])


@kernel
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


@kernel
def replay_step(target: Pool, work: Work, resting: Work, node: np.uint32, side: np.uint32, budget: np.int64) -> np.int64:
    """Apply logged operations to the new subtree until none is left or the budget is spent; returns what is left of it.

    `resting` is `work` with a job at rest: nothing is copied or logged for the new subtree.
    """
    job = work.job[0]
    box = resting.scratch
    while budget > 0 and job["replayed"] < job["logged"]:
        if not has_room(target, np.uint32(2), np.uint32(3)):
            return np.int64(0)
        entry = work.log[job["replayed"]]
        for i in range(6):
            box[i] = entry["box"][i]
        if entry["kind"] == INSERT:
            insert_point(target, resting, node, side, box[0], box[1], box[2])
        else:
            update_box(target, resting, node, side, box, np.int64(entry["kind"]))
        job["replayed"] += ONE
        budget -= _REPLAY_COST
    return budget


@kernel
def graft(pool: Pool, work: Work, holder: np.uint32) -> None:
    """Put the new subtree, held in the left slot of `holder`, in the place of the old one. Counts above stay the same."""
    job = work.job[0]
    node, side = np.uint32(job["node"]), np.uint32(job["side"])
    record, source = pool.inner[node], pool.inner[holder]
    free_subtree(pool, record["child"][side])
    record["child"][side] = source["child"][LEFT]
    record["label"][side] = source["label"][LEFT]
    for i in range(6):
        record["box"][side, i] = source["box"][LEFT, i]
    source["child"][LEFT] = NIL
    free_subtree(pool, holder)
