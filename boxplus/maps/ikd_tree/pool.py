"""Where an ikd-tree keeps its nodes: packed records in growing arrays, and the lists of the free ones.

A reference to a node is an unsigned 32-bit number: the index of a record, with the top bit set for a leaf. Nodes do not
know their parents; a subtree is addressed by its *slot*, the pair (inner node, side) that refers to it. Inner node 0 is
the anchor: its left slot holds the whole tree, its right slot is never used.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.maps.ikd_tree.inner import INNER
from boxplus.maps.ikd_tree.leaf import LEAF, count_bits

FILL = 26  # points in a leaf after a rebuild: leaves room for inserts
NIL = np.uint32(0xFFFFFFFF)
LEAF_BIT = np.uint32(0x80000000)
INDEX_MASK = np.uint32(0x7FFFFFFF)

# Lazy labels of a slot: what all points below have become, whatever the records below still say.
LABEL_NONE = np.uint8(0)
LABEL_DEAD = np.uint8(1)
LABEL_LIVE = np.uint8(2)

ZERO = np.uint32(0)
ONE = np.uint32(1)
ROOT = np.uint32(0)
LEFT = np.uint32(0)
RIGHT = np.uint32(1)

COUNT = np.dtype(
    [("size", np.uint32), ("dead", np.uint32)], align=True
)  # stored points below an inner node, and how many are deleted
HEAD = np.dtype(
    [
        ("inner_used", np.uint32),
        ("leaf_used", np.uint32),
        ("inner_free", np.uint32),  # first of a linked list, through `child[0]`
        ("inner_free_count", np.uint32),
        ("leaf_free", np.uint32),  # first of a linked list, through `live`
        ("leaf_free_count", np.uint32),
        ("subtree_free", np.uint32),  # first of a list of whole discarded subtrees, through `size`
    ],
    align=True,
)


class Pool(NamedTuple):
    """The arrays that hold a tree."""

    inner: NDArray[np.void]
    counts: NDArray[np.void]
    leaf: NDArray[np.void]
    head: NDArray[np.void]


def new_pool(inner: int, leaves: int) -> Pool:
    """An empty tree with room for `inner` inner nodes (the anchor included) and `leaves` leaves."""
    pool = Pool(np.empty(max(inner, 1), INNER), np.empty(max(inner, 1), COUNT), np.empty(leaves, LEAF), np.zeros(1, HEAD))
    head = pool.head[0]
    head["inner_free"] = head["leaf_free"] = head["subtree_free"] = NIL
    pool.inner[0] = np.zeros((), INNER)
    pool.inner[0]["child"] = NIL
    pool.inner[0]["box"][:, :3], pool.inner[0]["box"][:, 3:] = np.inf, -np.inf
    pool.counts[0] = 0
    head["inner_used"] = 1
    return pool


def pool_bytes(pool: Pool) -> int:
    """Bytes of all arrays."""
    return sum(array.nbytes for array in pool)


def reserve(pool: Pool, inner: int, leaves: int) -> None:
    """Make room for so many more nodes. Grows by small steps, so that no single call moves or clears much memory."""
    head = pool.head[0]
    sweep(pool, np.uint32(inner), np.uint32(leaves))
    short = inner - (len(pool.inner) - int(head["inner_used"])) - int(head["inner_free_count"])
    if short > 0:
        size = len(pool.inner) + max(short, len(pool.inner) // 16)
        pool.inner.resize(size, refcheck=False)
        pool.counts.resize(size, refcheck=False)
    short = leaves - (len(pool.leaf) - int(head["leaf_used"])) - int(head["leaf_free_count"])
    if short > 0:
        pool.leaf.resize(len(pool.leaf) + max(short, len(pool.leaf) // 16), refcheck=False)


@kernel(borrow=True)
def free_subtree(pool: Pool, ref: np.uint32) -> None:
    """Discard a subtree in constant time; its nodes are taken apart when they are needed."""
    if ref == NIL:
        return
    head = pool.head[0]
    if ref & LEAF_BIT:
        index = ref & INDEX_MASK
        pool.leaf[index]["live"] = head["leaf_free"]
        head["leaf_free"] = index
        head["leaf_free_count"] += ONE
    else:
        pool.counts[ref]["size"] = head["subtree_free"]
        head["subtree_free"] = ref


@kernel(borrow=True)
def take_apart(pool: Pool) -> None:
    """Free the root of one discarded subtree; its children become discarded subtrees."""
    head = pool.head[0]
    node = head["subtree_free"]
    head["subtree_free"] = pool.counts[node]["size"]
    child = pool.inner[node]["child"]
    free_subtree(pool, child[0])
    free_subtree(pool, child[1])
    child[0] = head["inner_free"]
    head["inner_free"] = node
    head["inner_free_count"] += ONE


@kernel(borrow=True)
def sweep(pool: Pool, inner: np.uint32, leaves: np.uint32) -> None:
    """Take discarded subtrees apart until so many nodes of each kind are free, or none is left."""
    head = pool.head[0]
    while head["subtree_free"] != NIL and (head["inner_free_count"] < inner or head["leaf_free_count"] < leaves):
        take_apart(pool)


@kernel(borrow=True)
def has_room(pool: Pool, inner: np.uint32, leaves: np.uint32) -> bool:
    """Whether so many nodes can be taken without growing the arrays."""
    sweep(pool, inner, leaves)
    head = pool.head[0]
    return bool(
        len(pool.inner) - np.int64(head["inner_used"]) + np.int64(head["inner_free_count"]) >= inner
        and len(pool.leaf) - np.int64(head["leaf_used"]) + np.int64(head["leaf_free_count"]) >= leaves
    )


@kernel(borrow=True)
def take_inner(pool: Pool) -> np.uint32:
    """A free inner node without children. Room must have been reserved."""
    head = pool.head[0]
    if head["inner_free"] == NIL and head["subtree_free"] != NIL:
        take_apart(pool)
    node = head["inner_free"]
    if node != NIL:
        head["inner_free"] = pool.inner[node]["child"][0]
        head["inner_free_count"] -= ONE
    else:
        node = np.uint32(head["inner_used"])
        head["inner_used"] = node + ONE
    record = pool.inner[node]
    record["child"][0] = NIL
    record["child"][1] = NIL
    record["label"][0] = LABEL_NONE
    record["label"][1] = LABEL_NONE
    record["queued"] = np.uint8(0)
    return np.uint32(node)


@kernel(borrow=True)
def take_leaf(pool: Pool) -> np.uint32:
    """The index of a free leaf. Room must have been reserved."""
    head = pool.head[0]
    while head["leaf_free"] == NIL and head["subtree_free"] != NIL:
        take_apart(pool)
    index = head["leaf_free"]
    if index != NIL:
        head["leaf_free"] = pool.leaf[index]["live"]
        head["leaf_free_count"] -= ONE
    else:
        index = np.uint32(head["leaf_used"])
        head["leaf_used"] = index + ONE
    return np.uint32(index)


@kernel(inline=True, borrow=True)
def all_bits(count: np.uint32) -> np.uint32:
    """A mask with the lowest `count` bits set."""
    return np.uint32((np.uint64(1) << np.uint64(count)) - np.uint64(1))


@kernel(inline=True, borrow=True)
def live_bits(pool_leaf: NDArray[np.void], index: np.uint32, label: np.uint8) -> np.uint32:
    """Which points of a leaf are live, given the label that holds over it."""
    if label == LABEL_NONE:
        return np.uint32(pool_leaf[index]["live"])
    if label == LABEL_DEAD:
        return ZERO
    return np.uint32(all_bits(np.uint32(pool_leaf[index]["count"])))


@kernel(borrow=True)
def slot_counts(pool: Pool, node: np.uint32, side: np.uint32) -> tuple[np.uint32, np.uint32]:
    """Stored points below a slot, and how many of them are deleted."""
    ref = pool.inner[node]["child"][side]
    if ref == NIL:
        return ZERO, ZERO
    label = pool.inner[node]["label"][side]
    if ref & LEAF_BIT:
        leaf = pool.leaf[ref & INDEX_MASK]
        size = np.uint32(leaf["count"])
        dead = np.uint32(size - count_bits(np.uint32(leaf["live"])))
    else:
        size = np.uint32(pool.counts[ref]["size"])
        dead = np.uint32(pool.counts[ref]["dead"])
    if label == LABEL_DEAD:
        dead = size
    elif label == LABEL_LIVE:
        dead = ZERO
    return size, dead


@kernel(borrow=True)
def slot_size(pool: Pool, node: np.uint32, side: np.uint32) -> np.uint32:
    """Stored points below a slot."""
    ref = pool.inner[node]["child"][side]
    if ref == NIL:
        return ZERO
    return np.uint32(pool.leaf[ref & INDEX_MASK]["count"] if ref & LEAF_BIT else pool.counts[ref]["size"])
