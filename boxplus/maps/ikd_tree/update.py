"""Single updates of an ikd-tree: insert a point; delete, revive or drop a box.

All boxes are half open, `lo ≤ x < hi`, in float32 relative to the tree's origin. Every update descends with push-down of
the lazy labels, so a leaf it touches knows the state of its points; on the way back the counts are pulled up (docs/ikd_tree.md).

While a rebuild is copying its subtree, an update first copies the leaf it is about to change (`save_leaf`): the copy is
the subtree as it was when the rebuild began, whenever its slices run.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.maps.ikd_tree.box import contained, disjoint, in_box
from boxplus.maps.ikd_tree.leaf import BUCKET, count_bits
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
    ZERO,
    Pool,
    free_subtree,
    live_bits,
    slot_counts,
    slot_size,
    take_inner,
    take_leaf,
)

MAX_DEPTH = 160  # deeper than this the whole tree is rebuilt at once; searches have room for more
PATH_DEPTH = 512
QUEUE_SIZE = 256

# Kinds of operations. A downsampled insert is logged as DROP and INSERT.
DELETE, REVIVE, DROP, INSERT, INSERT_DOWNSAMPLED = np.int64(0), np.int64(1), np.int64(2), np.int64(3), np.int64(4)

IDLE, COPYING, BUILDING, REPLAYING = np.uint32(0), np.uint32(1), np.uint32(2), np.uint32(3)  # phases of a rebuild

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
        ("path", np.uint64),  # the slot's path
        ("ancestors", np.uint32),  # how many inner nodes lie above the slot; they are in Work.ancestors
        ("queued", np.uint32),  # subtrees noted as out of balance
        ("in_place", np.uint32),  # subtrees up to this many points are rebuilt at once
        ("depth", np.uint32),  # deepest insert so far
        ("balance", np.float32),
        ("check", np.uint32),  # no balance check up to this size
        ("live", np.int64),  # live points of the tree
        ("changed", np.int64),  # points deleted, revived and stored by the last call
    ],
    align=True,
)
SLOT = np.dtype([("node", np.uint32), ("side", np.uint32), ("label", np.uint8), ("path", np.uint64)], align=True)
PENDING = np.dtype([("ref", np.uint32), ("label", np.uint8)], align=True)
OPERATION = np.dtype([("box", np.float32, 6), ("kind", np.uint32)], align=True)
LONG_PATH = np.uint64(1) << np.uint64(62)  # a path is the sides from the root, after a leading 1
_ENTER, _LEAVE, _INSIDE = np.uint8(0), np.uint8(1), np.uint8(2)  # states of a slot in a box update


class Work(NamedTuple):
    """Everything beside the nodes: the rebuild at hand, scratch, and the parameters of the tree."""

    job: NDArray[np.void]
    copy: NDArray[np.float32]  # (N, 4): x, y, z, deleted
    slots: NDArray[np.void]  # slots still to copy
    log: NDArray[np.void]  # operations since the rebuild began
    ancestors: NDArray[np.uint32]
    queue: NDArray[np.uint64]  # (QUEUE_SIZE,): paths of the subtrees noted as out of balance
    path: NDArray[np.uint32]  # (PATH_DEPTH,): inner nodes passed by the last descent
    small: NDArray[np.float32]  # copy of a subtree rebuilt in place
    small_builder: NDArray[np.void]
    walk: NDArray[np.void]  # scratch of the box updates
    gather: NDArray[np.void]  # scratch of the copy of a small subtree
    cell_stack: NDArray[np.void]  # scratch of the search of a cell
    scratch: NDArray[np.float32]  # (12,)
    order: NDArray[np.uint32]  # (BUCKET,)


@kernel(borrow=True)
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
        pool.counts[ref]["dead"] = pool.counts[ref]["size"] if label == LABEL_DEAD else ZERO


@kernel(borrow=True)
def pull_up(pool: Pool, node: np.uint32, side: np.uint32) -> None:
    """Recompute the counts of the inner node in a slot, whose label has been pushed down."""
    ref = pool.inner[node]["child"][side]
    size_left, dead_left = slot_counts(pool, ref, LEFT)
    size_right, dead_right = slot_counts(pool, ref, RIGHT)
    size, dead = np.uint32(size_left + size_right), np.uint32(dead_left + dead_right)
    pool.counts[ref]["size"] = size
    pool.counts[ref]["dead"] = dead
    if size == dead:
        pool.inner[node]["label"][side] = LABEL_DEAD


@kernel(borrow=True)
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


@kernel(borrow=True)
def unbalanced(pool: Pool, work: Work, ref: np.uint32) -> bool:
    """Whether an inner node violates the balance criterion (docs/ikd_tree.md)."""
    size = np.uint32(pool.counts[ref]["size"])
    if size <= work.job[0]["check"]:
        return False
    left = slot_size(pool, ref, LEFT)
    return bool(max(left, np.uint32(size - left)) > work.job[0]["balance"] * np.float32(size - ONE))


@kernel(borrow=True)
def extend_box(pool: Pool, node: np.uint32, side: np.uint32, x: np.float32, y: np.float32, z: np.float32) -> None:
    """Let the box of a slot cover a point."""
    box = pool.inner[node]["box"]
    box[side, 0] = x if x < box[side, 0] else box[side, 0]
    box[side, 1] = y if y < box[side, 1] else box[side, 1]
    box[side, 2] = z if z < box[side, 2] else box[side, 2]
    box[side, 3] = x if x > box[side, 3] else box[side, 3]
    box[side, 4] = y if y > box[side, 4] else box[side, 4]
    box[side, 5] = z if z > box[side, 5] else box[side, 5]


@kernel(borrow=True)
def note_unbalanced(pool: Pool, work: Work, ref: np.uint32, path: np.uint64) -> None:
    """Note a subtree out of balance, once; `settle` deals with it."""
    job = work.job[0]
    if pool.inner[ref]["queued"] == 0 and job["queued"] < np.uint32(QUEUE_SIZE) and path < LONG_PATH:
        pool.inner[ref]["queued"] = np.uint8(1)
        work.queue[job["queued"]] = path
        job["queued"] += ONE


@kernel(borrow=True)
def put_in_leaf(pool: Pool, index: np.uint32, x: np.float32, y: np.float32, z: np.float32, live: np.uint32) -> None:
    """Append a point to a leaf that has room for it; `live` is 0 or 1."""
    leaf = pool.leaf[index]
    count = np.uint32(leaf["count"])
    leaf["x"][count] = x
    leaf["y"][count] = y
    leaf["z"][count] = z
    leaf["live"] |= live << count
    leaf["count"] = count + ONE


@kernel(borrow=True)
def new_leaf(pool: Pool, stamp: np.uint32) -> np.uint32:
    """The index of an empty leaf."""
    index = take_leaf(pool)
    leaf = pool.leaf[index]
    leaf["count"] = ZERO
    leaf["live"] = ZERO
    leaf["stamp"] = stamp
    return np.uint32(index)


@kernel(borrow=True)
def split_leaf(pool: Pool, order: NDArray[np.uint32], node: np.uint32, side: np.uint32) -> np.uint32:
    """Replace a full leaf by an inner node over its lower and upper half along the longest axis; returns the inner node."""
    slot = pool.inner[node]
    box = slot["box"]
    old = np.uint32(slot["child"][side] & INDEX_MASK)
    leaf = pool.leaf[old]
    dx, dy, dz = box[side, 3] - box[side, 0], box[side, 4] - box[side, 1], box[side, 5] - box[side, 2]
    axis = 0 if dx >= dy and dx >= dz else (1 if dy >= dz else 2)
    values = leaf["x"] if axis == 0 else (leaf["y"] if axis == 1 else leaf["z"])
    for i in range(BUCKET):
        j = i
        while j > 0 and values[order[j - 1]] > values[i]:
            order[j] = order[j - 1]
            j -= 1
        order[j] = np.uint32(i)
    ref = take_inner(pool)
    inner = pool.inner[ref]
    inner["axis"] = np.uint8(axis)
    inner["split"] = values[order[BUCKET // 2]]
    live = np.uint32(leaf["live"])
    pool.counts[ref]["size"] = np.uint32(BUCKET)
    pool.counts[ref]["dead"] = np.uint32(np.uint32(BUCKET) - count_bits(live))
    for half in range(2):
        child = np.uint32(half)
        for axis in range(3):
            inner["box"][child, axis] = np.inf
            inner["box"][child, axis + 3] = -np.inf
        index = new_leaf(pool, np.uint32(leaf["stamp"]))
        inner["child"][child] = index | LEAF_BIT
        for j in range(half * (BUCKET // 2), (half + 1) * (BUCKET // 2)):
            i = order[j]
            x, y, z = leaf["x"][i], leaf["y"][i], leaf["z"][i]
            put_in_leaf(pool, index, x, y, z, (live >> i) & ONE)
            extend_box(pool, ref, child, x, y, z)
    free_subtree(pool, np.uint32(slot["child"][side]))
    slot["child"][side] = ref
    return np.uint32(ref)


@kernel(borrow=True)
def insert_point(pool: Pool, work: Work, node: np.uint32, side: np.uint32, x: np.float32, y: np.float32, z: np.float32) -> bool:
    """Insert a point below a slot; notes the topmost subtree of its path that is out of balance.

    Room for three leaves and an inner node must be there. Returns whether the point lies in the subtree being rebuilt.
    """
    job = work.job[0]
    running = job["phase"] != IDLE
    inside = False
    depth = ZERO
    path = np.uint64(1)
    above = ZERO
    noted = False
    while True:
        extend_box(pool, node, side, x, y, z)
        push_down(pool, node, side)
        ref = np.uint32(pool.inner[node]["child"][side])
        if ref == NIL:
            ref = np.uint32(new_leaf(pool, ZERO) | LEAF_BIT)
            pool.inner[node]["child"][side] = ref
        size = np.uint32(slot_size(pool, node, side) + ONE)
        if above > job["check"] and not noted and max(size, np.uint32(above - size)) > job["balance"] * np.float32(above - ONE):
            noted = True
            if not inside:
                note_unbalanced(pool, work, node, path >> np.uint64(1))
        above = size
        inside = inside or (running and node == job["node"] and side == job["side"])
        if ref & LEAF_BIT:
            index = np.uint32(ref & INDEX_MASK)
            if inside and job["phase"] == COPYING:
                save_leaf(pool, work, index, np.uint32(pool.leaf[index]["live"]))
            if pool.leaf[index]["count"] < np.uint32(BUCKET):
                put_in_leaf(pool, index, x, y, z, ONE)
                break
            ref = split_leaf(pool, work.order, node, side)
        pool.counts[ref]["size"] += ONE
        depth += ONE
        axis = pool.inner[ref]["axis"]
        value = x if axis == 0 else (y if axis == 1 else z)
        node = ref
        side = np.uint32(value >= pool.inner[ref]["split"])
        path = (path << np.uint64(1)) | np.uint64(side) if path < LONG_PATH else path
    job["depth"] = max(np.uint32(job["depth"]), np.uint32(depth + ONE))
    return inside


@kernel(borrow=True)
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


@kernel(borrow=True)
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
    slots[0]["path"] = np.uint64(1)
    top = ONE
    while top > ZERO:
        top -= ONE
        node, side, state = np.uint32(slots[top]["node"]), np.uint32(slots[top]["side"]), np.uint8(slots[top]["label"])
        record = pool.inner[node]
        ref = np.uint32(record["child"][side])
        inside = state & _INSIDE != 0
        if state & _LEAVE:
            pull_up(pool, node, side)
            if kind == DROP and not inside and unbalanced(pool, work, ref):
                note_unbalanced(pool, work, ref, np.uint64(slots[top]["path"]))
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
        path = np.uint64(slots[top]["path"])
        slots[top]["label"] = np.uint8(mark | _LEAVE)  # node and side are still there
        top += ONE
        for child in range(2):
            slots[top]["node"] = ref
            slots[top]["side"] = np.uint32(child)
            slots[top]["label"] = mark
            slots[top]["path"] = (path << np.uint64(1)) | np.uint64(child) if path < LONG_PATH else path
            top += ONE
    return changed
