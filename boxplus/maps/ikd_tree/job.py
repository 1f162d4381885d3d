"""The rebuild of one large subtree: its buffers, and how much of it is done in one go."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.ikd_tree.batch import update_batch
from boxplus.maps.ikd_tree.build import BUILDER, BUILT, build_step, start_build
from boxplus.maps.ikd_tree.leaf import BUCKET
from boxplus.maps.ikd_tree.pool import (
    FILL,
    LABEL_NONE,
    LEFT,
    NIL,
    ROOT,
    Pool,
    free_subtree,
    new_pool,
    pool_bytes,
    reserve,
    slot_counts,
    take_inner,
)
from boxplus.maps.ikd_tree.rebuild import copy_step
from boxplus.maps.ikd_tree.update import (
    BUILDING,
    COPYING,
    IDLE,
    JOB,
    OPERATION,
    PATH_DEPTH,
    PENDING,
    QUEUE_SIZE,
    REPLAYING,
    SLOT,
    Work,
)

_NO_POINTS = np.empty((0, 4), np.float32)
_NO_ORIGIN = np.zeros(3)  # the log has no downsampled inserts
_REPLAY_COST = 128  # point visits an operation of the log counts for
UNLIMITED = 1 << 60


def new_work(in_place: int, balance: float, check: int) -> Work:
    """Scratch and parameters of a tree, with no rebuild running."""
    job = np.zeros(1, JOB)
    job["in_place"], job["balance"], job["check"] = in_place, balance, check
    return Work(
        job=job,
        copy=_NO_POINTS,
        slots=np.empty(PATH_DEPTH, SLOT),
        log=np.empty(1, OPERATION),
        ancestors=np.empty(PATH_DEPTH, np.uint32),
        queue=np.empty(QUEUE_SIZE, np.uint64),
        path=np.empty(PATH_DEPTH, np.uint32),
        small=np.empty((max(in_place, 64) + 1, 4), np.float32),
        small_builder=np.zeros(1, BUILDER),
        walk=np.empty(2 * PATH_DEPTH, SLOT),
        gather=np.empty(PATH_DEPTH, SLOT),
        cell_stack=np.empty(PATH_DEPTH, PENDING),
        scratch=np.zeros(12, np.float32),
        order=np.empty(BUCKET, np.uint32),
    )


def build_pool(points: NDArray[np.float32]) -> Pool:
    """A new tree of (N, 4) float32 points: x, y, z relative to the origin, and 1 for a deleted one; reorders them."""
    leaves = len(points) // FILL + len(points) // (16 * FILL) + 64
    pool = new_pool(leaves, leaves)
    builder = np.zeros(1, BUILDER)
    start_build(builder, np.uint32(len(points)), ROOT, LEFT)
    while builder[0]["phase"] != BUILT:
        reserve(pool, 64, 64)
        build_step(pool, builder, points, np.int64(UNLIMITED))
    return pool


class Rebuilder:
    """Rebuilds one subtree at a time, a slice a call, on the caller's thread or on one of its own.

    A slice only reads the tree and writes nodes that no search can reach, so searches may go on meanwhile; updates must
    `wait` first. The result is put in place by `swap`, which the thread that updates the tree calls.
    """

    def __init__(self, work: Work, resting: Work, *, own_thread: bool) -> None:
        self.work = work
        self._resting = resting  # scratch of the updates replayed on the new subtree
        self._builder = np.zeros(1, BUILDER)
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="ikd-rebuild") if own_thread else None
        self._slice: Future[None] | None = None
        self._target: Pool | None = None
        self._slot = (ROOT, LEFT)  # where the new subtree hangs in the target

    @property
    def running(self) -> bool:
        """Whether a rebuild has begun and is not in place yet."""
        return bool(self.work.job[0]["phase"] != IDLE)

    @property
    def finished(self) -> bool:
        """Whether the new subtree is complete and up to date with the log."""
        job = self.work.job[0]
        return bool(job["phase"] == REPLAYING and job["replayed"] == job["logged"])

    def start(self, pool: Pool, node: int, side: int, *, keep_dead: bool) -> None:
        """Begin to rebuild the subtree of a slot. The whole tree is built into arrays of its own, which replace the old."""
        stored, dead = (int(count) for count in slot_counts(pool, np.uint32(node), np.uint32(side)))
        size = stored if keep_dead else stored - dead
        whole = node == ROOT
        if whole:
            leaves = size // FILL + size // (16 * FILL) + 64
            self._target = new_pool(leaves, leaves)
            self._slot = (ROOT, LEFT)
        else:
            reserve(pool, 1, 0)
            self._target = pool
            self._slot = (np.uint32(take_inner(pool)), LEFT)
        self.work = self.work._replace(copy=np.empty((size, 4), np.float32))
        ancestors = 0 if whole else self.work.job[0]["ancestors"]
        job, first = self.work.job[0], self.work.slots[0]
        job["phase"], job["node"], job["side"], job["ancestors"] = COPYING, node, side, ancestors
        job["stamp"] += 1
        job["keep_dead"] = keep_dead
        job["copied"] = job["logged"] = job["replayed"] = 0
        first["node"], first["side"], first["label"] = node, side, LABEL_NONE
        job["top"] = 1

    def make_log_room(self, operations: int) -> None:
        """Let the log of a running rebuild take so many more operations."""
        used = int(self.work.job[0]["logged"])
        short = used + operations - len(self.work.log)
        if short > 0:
            self.work.log.resize(len(self.work.log) + max(short, len(self.work.log) // 8), refcheck=False)

    def advance(self, pool: Pool, budget: int) -> None:
        """Do `budget` point visits of work, on the own thread if there is one."""
        target = self._target
        if not self.running or self.finished or target is None:
            return
        nodes = min(budget // 64, len(self.work.copy) // FILL) + 64  # a slice that needs more goes on in the next call
        reserve(target, nodes, nodes)
        if self._executor is None:
            self._run(pool, target, budget)
        else:
            self._slice = self._executor.submit(self._run, pool, target, budget)

    def wait(self) -> None:
        """Until no slice is running."""
        if self._slice is not None:
            self._slice.result()
            self._slice = None

    def _run(self, pool: Pool, target: Pool, budget: int) -> None:
        job = self.work.job[0]
        left = np.int64(budget)
        if job["phase"] == COPYING:
            left = copy_step(pool, self.work, left)
            if job["phase"] == BUILDING:
                start_build(self._builder, np.uint32(job["copied"]), *self._slot)
        if job["phase"] == BUILDING and left > 0:
            left = build_step(target, self._builder, self.work.copy, left)
            if self._builder[0]["phase"] == BUILT:
                job["phase"] = REPLAYING
                self.work = self.work._replace(copy=_NO_POINTS)
        if job["phase"] == REPLAYING and left > 0:
            begin = int(job["replayed"])
            end = min(int(job["logged"]), begin + int(left) // _REPLAY_COST + 1)
            job["replayed"] = update_batch(target, self._resting, self.work.log, begin, end, *self._slot, 0.0, _NO_ORIGIN)

    def complete(self, pool: Pool) -> None:
        """Do all the rest of the running rebuild now."""
        self.wait()
        while self.running and not self.finished:
            self.advance(pool, UNLIMITED)
            self.wait()

    def swap(self, pool: Pool) -> Pool:
        """Put the finished subtree in the place of the old one; returns the arrays that now hold the tree."""
        target = self._target
        if target is None:
            return pool
        if target is pool:
            self._graft(pool)
        self._take_over_notes()
        self._rest()
        return target

    def _graft(self, pool: Pool) -> None:
        """Hang the new subtree, held by a spare node, where the old one was. The counts above stay as they are."""
        job = self.work.job[0]
        slot, spare, side = pool.inner[job["node"]], pool.inner[self._slot[0]], int(job["side"])
        free_subtree(pool, np.uint32(slot["child"][side]))
        for field in ("child", "label", "box"):
            slot[field][side] = spare[field][LEFT]
        spare["child"] = NIL
        free_subtree(pool, self._slot[0])

    def _take_over_notes(self) -> None:
        """What fell out of balance in the new subtree during the replay is noted for the tree, below the slot's path."""
        job, new = self.work.job[0], self._resting.job[0]
        slot = 1 if self._slot[0] == ROOT else int(job["path"])
        for path in self._resting.queue[: new["queued"]].tolist():
            whole = int(f"{slot:b}" + f"{path:b}"[1:], 2)
            if whole < 1 << 62 and job["queued"] < QUEUE_SIZE:
                self.work.queue[job["queued"]] = whole
                job["queued"] += 1
        new["queued"] = 0

    def cancel(self, pool: Pool) -> None:
        """Give the running rebuild up; the tree is as if it had never begun."""
        self.wait()
        if self._target is pool and self.running:
            free_subtree(pool, self._slot[0])
        self._resting.job[0]["queued"] = 0
        self._rest()

    def _rest(self) -> None:
        self.work.job[0]["phase"] = IDLE
        self.work.job[0]["logged"] = self.work.job[0]["replayed"] = 0
        self._target = None
        self.work = self.work._replace(copy=_NO_POINTS, log=np.empty(1, OPERATION))

    def memory_bytes(self, pool: Pool) -> int:
        """Bytes of the copy, the log and, if it has arrays of its own, the new tree."""
        own = 0 if self._target is None or self._target is pool else pool_bytes(self._target)
        return own + self.work.copy.nbytes + self.work.log.nbytes

    def close(self) -> None:
        """End the own thread."""
        if self._executor is not None:
            self.wait()
            self._executor.shutdown()
            self._executor = None
