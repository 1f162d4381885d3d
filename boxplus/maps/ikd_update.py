"""Single updates of an ikd-tree: insert a point, delete, revive or drop a box; small rebuilds in place.

All boxes are half open, `lo ≤ x < hi`, in float32 relative to the tree's origin. Every update descends with push-down of
the lazy labels, so a leaf it touches knows the state of its points; on the way back the counts are pulled up (SPEC 10.3).

While a rebuild is copying its subtree, an update first copies the leaf it is about to change (`save_leaf`): the copy is
the subtree as it was when the rebuild began, whenever its slices run.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.maps.ikd_box import contained, disjoint, in_box
from boxplus.maps.ikd_build import build_step, start_build
from boxplus.maps.ikd_pool import (
    BUCKET,
    FILL,
    INDEX_MASK,
    LABEL_DEAD,
    LABEL_LIVE,
    LABEL_NONE,
    LEAF_BIT,
    LEFT,
    NIL,
    ONE,
    RIGHT,
    ZERO,
    Pool,
    count_bits,
    free_subtree,
    has_room,
    live_bits,
    slot_counts,
    take_leaf,
)

MAX_DEPTH = 160  # deeper than this the whole tree is rebuilt at once; searches have room for more
PATH_DEPTH = 512
QUEUE_SIZE = 256

DELETE, REVIVE, DROP = 0, 1, 2  # what a box update does: mark, unmark, or remove for good

IDLE, COPYING, BUILDING, REPLAYING = 0, 1, 2, 3  # phases of a rebuild

JOB = np.dtype(
    [
        ("phase", np.uint32),
        ("node", np.uint32),  # the slot whose subtree is rebuilt
        ("side", np.uint32),
        ("stamp", np.uint32),  # number of this rebuild
        ("keep_dead", np.uint32),  # whether deleted points are carried over
        ("copied", np.uint32),  # rows in the copy
        ("top", np.uint32),  # slots still to copy
        ("logged", np.uint32),
        ("replayed", np.uint32),
        ("ancestors", np.uint32),  # how many inner nodes lie above the slot; they are in Work.ancestors
        ("queued", np.uint32),  # subtrees noted as out of balance
        ("in_place", np.uint32),  # subtrees up to this many points are rebuilt at once
        ("depth", np.uint32),  # deepest insert so far
        ("balance", np.float32),
        ("check", np.uint32),  # no balance check up to this size
        ("live", np.int64),  # live points of the tree
    ],
    align=True,
)
SLOT = np.dtype([("node", np.uint32), ("side", np.uint32), ("label", np.uint8)], align=True)
OPERATION = np.dtype([("box", np.float32, 6), ("kind", np.uint32)], align=True)
_ENTER, _LEAVE, _INSIDE = np.uint8(0), np.uint8(1), np.uint8(2)  # states of a slot in a box update
INSERT = 3  # kind of a logged operation, besides the box updates


class Work(NamedTuple):
    """Everything beside the nodes: the rebuild at hand, scratch, and the parameters of the tree."""

    job: NDArray[np.void]
    copy: NDArray[np.float32]  # (N, 4): x, y, z, deleted
    slots: NDArray[np.void]  # slots still to copy
    log: NDArray[np.void]  # operations since the rebuild began
    ancestors: NDArray[np.uint32]
    queue: NDArray[np.float32]  # (QUEUE_SIZE, 3): a point in each subtree out of balance
    path: NDArray[np.void]  # slots passed by the last insert
    small: NDArray[np.float32]  # copy of a subtree rebuilt in place
    small_builder: NDArray[np.void]
    walk: NDArray[np.void]  # scratch of the box updates
    gather: NDArray[np.void]  # scratch of the copy of a small subtree
    cell_slots: NDArray[np.void]  # scratch of the search of a cell
    scratch: NDArray[np.float32]  # (16,)


@kernel
def push_down(pool: Pool, node: np.uint32, side: np.uint32) -> None:
    """Hand the label of a slot down by one level."""
    record = pool.inner[node]
    label = record["label"][side]
    if label == LABEL_NONE:
        return
    ref = record["child"][side]
    record["label"][side] = LABEL_NONE
    if ref == NIL:
        return
    if ref & LEAF_BIT:
        index = ref & INDEX_MASK
        pool.leaf[index]["live"] = live_bits(pool.leaf, index, label)
    else:
        pool.inner[ref]["label"][0] = label
        pool.inner[ref]["label"][1] = label
        pool.count[ref]["dead"] = pool.count[ref]["size"] if label == LABEL_DEAD else ZERO


@kernel
def pull_up(pool: Pool, node: np.uint32, side: np.uint32) -> None:
    """Recompute the counts of the inner node in a slot, whose label has been pushed down."""
    ref = pool.inner[node]["child"][side]
    size_left, dead_left = slot_counts(pool, ref, LEFT)
    size_right, dead_right = slot_counts(pool, ref, RIGHT)
    size, dead = np.uint32(size_left + size_right), np.uint32(dead_left + dead_right)
    pool.count[ref]["size"] = size
    pool.count[ref]["dead"] = dead
    if size == dead:
        pool.inner[node]["label"][side] = LABEL_DEAD


@kernel
def save_leaf(pool: Pool, work: Work, index: np.uint32, live: np.uint32) -> None:
    """Append a leaf to the copy of the running rebuild, once."""
    job = work.job[0]
    leaf = pool.leaf[index]
    if leaf["stamp"] == job["stamp"]:
        return
    leaf["stamp"] = job["stamp"]
    row = np.uint32(job["copied"])
    copy = work.copy
    x, y, z = leaf["x"], leaf["y"], leaf["z"]
    for i in range(np.uint32(leaf["count"])):
        dead = (live >> np.uint32(i)) & ONE == ZERO
        if dead and not job["keep_dead"]:
            continue
        copy[row, 0] = x[i]
        copy[row, 1] = y[i]
        copy[row, 2] = z[i]
        copy[row, 3] = np.float32(dead)
        row += ONE
    job["copied"] = row


@kernel
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


@kernel
def rebuild_in_place(pool: Pool, work: Work, node: np.uint32, side: np.uint32) -> None:
    """Rebuild a small subtree at once."""
    build_small(pool, work, node, side, gather(pool, work, node, side))


@kernel
def build_small(pool: Pool, work: Work, node: np.uint32, side: np.uint32, points: np.uint32) -> None:
    """Replace what is in a slot by a tree of the first `points` rows of the scratch copy."""
    free_subtree(pool, pool.inner[node]["child"][side])
    pool.inner[node]["child"][side] = NIL
    start_build(work.small_builder, points, node, side)
    build_step(pool, work.small_builder, work.small, np.int64(1) << np.int64(62))


@kernel
def unbalanced(pool: Pool, work: Work, ref: np.uint32) -> bool:
    """Whether an inner node violates the balance criterion (SPEC 10.4)."""
    size = np.uint32(pool.count[ref]["size"])
    if size <= work.job[0]["check"]:
        return False
    left, _ = slot_counts(pool, ref, LEFT)
    return max(left, np.uint32(size - left)) > work.job[0]["balance"] * np.float32(size - ONE)


@kernel
def may_rebuild(pool: Pool, work: Work, node: np.uint32, side: np.uint32, inside: bool) -> bool:
    """Whether a small subtree may be replaced now: not while it is being copied, nor if the running rebuild hangs below it."""
    job = work.job[0]
    if job["phase"] == IDLE:
        return True
    if (inside and job["phase"] == COPYING) or (node == job["node"] and side == job["side"]):
        return False
    ref = pool.inner[node]["child"][side]
    for i in range(np.uint32(job["ancestors"])):
        if work.ancestors[i] == ref:
            return False
    return True


@kernel
def restore_balance(
    pool: Pool, work: Work, node: np.uint32, side: np.uint32, x: np.float32, y: np.float32, z: np.float32, inside: bool
) -> None:
    """Rebuild an unbalanced subtree if it is small, else note a point of it for a rebuild in slices."""
    ref = pool.inner[node]["child"][side]
    job = work.job[0]
    size = np.uint32(pool.count[ref]["size"])
    leaves = np.uint32(np.uint32(2) * size // np.uint32(FILL) + np.uint32(4))
    if size <= job["in_place"] and may_rebuild(pool, work, node, side, inside) and has_room(pool, leaves, leaves):
        rebuild_in_place(pool, work, node, side)
        return
    if pool.inner[ref]["queued"] == 0 and job["queued"] < np.uint32(QUEUE_SIZE):
        pool.inner[ref]["queued"] = np.uint8(1)
        row = job["queued"]
        work.queue[row, 0] = x
        work.queue[row, 1] = y
        work.queue[row, 2] = z
        job["queued"] = row + ONE


@kernel
def extend_box(pool: Pool, node: np.uint32, side: np.uint32, x: np.float32, y: np.float32, z: np.float32) -> None:
    """Let the box of a slot cover a point."""
    box = pool.inner[node]["box"]
    box[side, 0] = min(box[side, 0], x)
    box[side, 1] = min(box[side, 1], y)
    box[side, 2] = min(box[side, 2], z)
    box[side, 3] = max(box[side, 3], x)
    box[side, 4] = max(box[side, 4], y)
    box[side, 5] = max(box[side, 5], z)


@kernel
def add_to_leaf(
    pool: Pool, work: Work, node: np.uint32, side: np.uint32, x: np.float32, y: np.float32, z: np.float32, copying: bool
) -> None:
    """Store a live point in the leaf of a slot (none yet, or one that a full bucket turns into two)."""
    ref = pool.inner[node]["child"][side]
    if ref == NIL:
        index = take_leaf(pool)
        ref = np.uint32(index | LEAF_BIT)
        pool.leaf[index]["count"] = ZERO
        pool.leaf[index]["live"] = ZERO
        pool.leaf[index]["stamp"] = ZERO
        pool.inner[node]["child"][side] = ref
        pool.inner[node]["label"][side] = LABEL_NONE
    index = np.uint32(ref & INDEX_MASK)
    leaf = pool.leaf[index]
    if copying:
        save_leaf(pool, work, index, np.uint32(leaf["live"]))
    count = np.uint32(leaf["count"])
    if count < np.uint32(BUCKET):
        leaf["x"][count] = x
        leaf["y"][count] = y
        leaf["z"][count] = z
        leaf["live"] |= ONE << count
        leaf["count"] = count + ONE
        return
    points = gather(pool, work, node, side)
    work.small[points, 0] = x
    work.small[points, 1] = y
    work.small[points, 2] = z
    work.small[points, 3] = np.float32(0)
    build_small(pool, work, node, side, np.uint32(points + ONE))
    if copying:
        child = pool.inner[pool.inner[node]["child"][side]]["child"]
        pool.leaf[child[0] & INDEX_MASK]["stamp"] = work.job[0]["stamp"]
        pool.leaf[child[1] & INDEX_MASK]["stamp"] = work.job[0]["stamp"]


@kernel
def insert_point(pool: Pool, work: Work, node: np.uint32, side: np.uint32, x: np.float32, y: np.float32, z: np.float32) -> bool:
    """Insert a point below a slot and restore the balance of its path.

    Room for two leaves and an inner node must be there. Returns whether the point lies in the subtree being rebuilt.
    """
    job = work.job[0]
    running = job["phase"] != IDLE
    inside = False
    path = work.path
    depth = ZERO
    while True:
        extend_box(pool, node, side, x, y, z)
        inside = inside or (running and node == job["node"] and side == job["side"])
        push_down(pool, node, side)
        ref = np.uint32(pool.inner[node]["child"][side])
        if ref >= LEAF_BIT:
            break
        path[depth]["node"] = node
        path[depth]["side"] = side
        depth += ONE
        pool.count[ref]["size"] += ONE
        axis = pool.inner[ref]["axis"]
        value = x if axis == 0 else (y if axis == 1 else z)
        node = ref
        side = np.uint32(value >= pool.inner[ref]["split"])
    add_to_leaf(pool, work, node, side, x, y, z, inside and job["phase"] == COPYING)
    job["depth"] = max(np.uint32(job["depth"]), np.uint32(depth + ONE))
    below_job = False
    for i in range(depth):
        node, side = np.uint32(path[i]["node"]), np.uint32(path[i]["side"])
        below_job = below_job or (running and node == job["node"] and side == job["side"])
        if unbalanced(pool, work, pool.inner[node]["child"][side]):
            restore_balance(pool, work, node, side, x, y, z, below_job)
            break
    return inside


@kernel
def update_leaf(leaf: NDArray[np.void], index: np.uint32, box: NDArray[np.float32], kind: np.int64) -> np.int64:
    """Delete, revive or drop the points of a leaf in a box; returns how many became or ceased to be live."""
    bits = in_box(leaf, index, box)
    record = leaf[index]
    live = np.uint32(record["live"])
    if kind == DELETE:
        record["live"] = np.uint32(live & ~bits)
        return np.int64(count_bits(np.uint32(live & bits)))
    if kind == REVIVE:
        record["live"] = np.uint32(live | bits)
        return np.int64(count_bits(np.uint32(bits & ~live)))
    changed = np.int64(count_bits(np.uint32(live & bits)))
    kept = ZERO
    kept_live = ZERO
    for i in range(np.uint32(record["count"])):
        if (bits >> np.uint32(i)) & ONE == ZERO:
            record["x"][kept] = record["x"][i]
            record["y"][kept] = record["y"][i]
            record["z"][kept] = record["z"][i]
            kept_live |= ((live >> np.uint32(i)) & ONE) << kept
            kept += ONE
    record["count"] = kept
    record["live"] = kept_live
    return changed


@kernel
def update_box(pool: Pool, work: Work, node: np.uint32, side: np.uint32, box: NDArray[np.float32], kind: np.int64) -> np.int64:
    """Delete (label), revive (label) or drop all points of a half-open box below a slot.

    Returns how many points became or ceased to be live.
    """
    job = work.job[0]
    slots = work.walk
    changed = np.int64(0)
    slots[0]["node"] = node
    slots[0]["side"] = side
    slots[0]["label"] = _ENTER
    top = ONE
    while top > ZERO:
        top -= ONE
        node, side, state = np.uint32(slots[top]["node"]), np.uint32(slots[top]["side"]), np.uint8(slots[top]["label"])
        record = pool.inner[node]
        ref = np.uint32(record["child"][side])
        inside = state & _INSIDE != 0
        if state & _LEAVE:
            pull_up(pool, node, side)
            if kind == DROP and unbalanced(pool, work, ref):
                inner_box = pool.inner[ref]["box"]
                restore_balance(pool, work, node, side, inner_box[0, 0], inner_box[0, 1], inner_box[0, 2], inside)
            continue
        if ref == NIL or disjoint(record["box"], side, box):
            continue
        inside = inside or (job["phase"] != IDLE and node == job["node"] and side == job["side"])
        copying = inside and job["phase"] == COPYING
        if not copying and kind != DROP and contained(record["box"], side, box):
            size, dead = slot_counts(pool, node, side)
            record["label"][side] = LABEL_DEAD if kind == DELETE else LABEL_LIVE
            changed += np.int64(dead) if kind == REVIVE else np.int64(size - dead)
            continue
        push_down(pool, node, side)
        if ref & LEAF_BIT:
            index = np.uint32(ref & INDEX_MASK)
            if copying:
                save_leaf(pool, work, index, np.uint32(pool.leaf[index]["live"]))
            changed += update_leaf(pool.leaf, index, box, kind)
            continue
        mark = _INSIDE if inside else _ENTER
        slots[top]["label"] = np.uint8(mark | _LEAVE)  # node and side are still there
        top += ONE
        for child in range(2):
            slots[top]["node"] = ref
            slots[top]["side"] = np.uint32(child)
            slots[top]["label"] = mark
            top += ONE
    return changed
