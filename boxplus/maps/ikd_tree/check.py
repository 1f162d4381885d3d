"""Invariants of an ikd-tree (docs/ikd_tree.md), checked node by node in Python: for tests and for doubt."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import BoxplusError
from boxplus.maps.ikd_tree.leaf import BUCKET
from boxplus.maps.ikd_tree.pool import (
    INDEX_MASK,
    LABEL_DEAD,
    LABEL_LIVE,
    LEAF_BIT,
    LEFT,
    NIL,
    ROOT,
    Pool,
)


class InvariantError(BoxplusError):
    """An ikd-tree is damaged; always a defect of boxplus."""


class Subtree(NamedTuple):
    """What a subtree holds."""

    height: int
    points: NDArray[np.float32]  # (N, 3), stored ones, relative to the origin
    live: NDArray[np.bool_]  # (N,)


_EMPTY = Subtree(0, np.empty((0, 3), np.float32), np.empty(0, np.bool_))


def check_tree(pool: Pool, live: int, *, balance: float | None, smallest: int) -> Subtree:
    """Check I1 size, I2 deleted points, I3 boxes, I4 splits, I5 deleted subtrees and I6 balance (above `smallest` points).

    Without a balance I6 is not asked for. Also that `live` is the number of live points, and that no record is used twice or
    both used and free.

    Raises:
        InvariantError: which invariant is violated, and where.
    """
    used: set[int] = set()
    tree = _check_slot(pool, int(ROOT), int(LEFT), 0, used, balance, smallest)
    _require(int(tree.live.sum()) == live, f"{int(tree.live.sum())} live points in the tree, {live} counted")
    free = _free_records(pool)
    _require(not (used & free), f"records both used and free: {sorted(used & free)[:5]}")
    return tree


def _check_slot(pool: Pool, node: int, side: int, above: int, used: set[int], balance: float | None, smallest: int) -> Subtree:
    """Check what hangs in a slot; `above` is the label that already holds over it."""
    record = pool.inner[node]
    ref = int(record["child"][side])
    if ref == NIL:
        return _EMPTY
    _require(ref not in used, f"record {ref:#x} is used twice")
    used.add(ref)
    label = above or int(record["label"][side])
    box = record["box"][side]
    if ref & int(LEAF_BIT):
        leaf = pool.leaf[ref & int(INDEX_MASK)]
        count = int(leaf["count"])
        _require(count <= BUCKET, f"I1: leaf {ref:#x} holds {count} points")
        points = np.stack([leaf["x"][:count], leaf["y"][:count], leaf["z"][:count]], axis=1)
        live = (int(leaf["live"]) >> np.arange(count)) & 1 == 1
        _require(int(leaf["live"]) >> count == 0, f"leaf {ref:#x} marks points it does not hold as live")
        tree = Subtree(1, points, np.full(count, label == LABEL_LIVE) if label else live)
    else:
        left, right = (_check_slot(pool, ref, child, label, used, balance, smallest) for child in (0, 1))
        tree = Subtree(
            1 + max(left.height, right.height),
            np.concatenate([left.points, right.points]),
            np.concatenate([left.live, right.live]),
        )
        size, dead = int(pool.counts[ref]["size"]), int(pool.counts[ref]["dead"])
        if label:
            dead = size if label == LABEL_DEAD else 0
        _require(size == len(tree.points), f"I1: node {ref} counts {size} points and holds {len(tree.points)}")
        _require(dead == np.sum(~tree.live), f"I2: node {ref} counts {dead} deleted points and holds {np.sum(~tree.live)}")
        axis, split = int(pool.inner[ref]["axis"]), pool.inner[ref]["split"]
        ordered = (left.points[:, axis] <= split).all() and (right.points[:, axis] >= split).all()
        _require(bool(ordered), f"I4: node {ref} has points on the wrong side of its split")
        if balance is not None and size > smallest:
            larger = max(len(left.points), len(right.points))
            allowed = np.float32(balance) * np.float32(size - 1)
            _require(bool(larger <= allowed), f"I6: node {ref} has {larger} of {size} points on one side")
    inside = (tree.points >= box[:3]).all() and (tree.points <= box[3:]).all()
    _require(bool(inside), f"I3: the box of {ref:#x} does not cover its points")
    _require(label != LABEL_DEAD or not tree.live.any(), f"I5: {ref:#x} is labelled deleted and holds live points")
    return tree


def _free_records(pool: Pool) -> set[int]:
    """References of all free records."""
    free: set[int] = set()
    head = pool.head[0]
    ref, count = int(head["inner_free"]), 0
    while ref != NIL:
        free.add(ref)
        ref, count = int(pool.inner[ref]["child"][0]), count + 1
    _require(count == head["inner_free_count"], f"{count} free inner nodes, {head['inner_free_count']} counted")
    ref, count = int(head["leaf_free"]), 0
    while ref != NIL:
        free.add(ref | int(LEAF_BIT))
        ref, count = int(pool.leaf[ref]["live"]), count + 1
    _require(count == head["leaf_free_count"], f"{count} free leaves, {head['leaf_free_count']} counted")
    pending, ref = [], int(head["subtree_free"])
    while ref != NIL:
        pending.append(ref)
        ref = int(pool.counts[ref]["size"])
    while pending:
        ref = pending.pop()
        _require(ref not in free, f"record {ref:#x} is free twice")
        free.add(ref)
        if not ref & int(LEAF_BIT):
            pending += [int(child) for child in pool.inner[ref]["child"] if child != NIL]
    return free


def _require(condition: bool, violation: str) -> None:
    if not condition:
        raise InvariantError(violation)
