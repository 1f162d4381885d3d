"""The rebuild of one large subtree: its buffers, and how much of it is done in one go."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.ikd_build import BUILDER, BUILT, build_step, start_build
from boxplus.maps.ikd_pool import (
    FILL,
    LEFT,
    ROOT,
    Pool,
    free_subtree,
    new_pool,
    pool_bytes,
    reserve,
    slot_counts,
    take_inner,
)
from boxplus.maps.ikd_rebuild import copy_step, graft, replay_step, start_job
from boxplus.maps.ikd_update import BUILDING, COPYING, IDLE, JOB, OPERATION, PATH_DEPTH, QUEUE_SIZE, REPLAYING, SLOT, Work

_NO_POINTS = np.empty((0, 4), np.float32)
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
        queue=np.empty((QUEUE_SIZE, 3), np.float32),
        path=np.empty(PATH_DEPTH, SLOT),
        small=np.empty((max(in_place, 64) + 1, 4), np.float32),
        small_builder=np.zeros(1, BUILDER),
        walk=np.empty(2 * PATH_DEPTH, SLOT),
        gather=np.empty(PATH_DEPTH, SLOT),
        cell_slots=np.empty(PATH_DEPTH, SLOT),
        scratch=np.zeros(16, np.float32),
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
        size = int(slot_counts(pool, np.uint32(node), np.uint32(side))[0])
        whole = node == ROOT
        if whole:
            leaves = size // FILL + size // (16 * FILL) + 64
            self._target = new_pool(leaves, leaves)
            self._slot = (ROOT, LEFT)
        else:
            reserve(pool, 1, 0)
            self._target = pool
            self._slot = (take_inner(pool), LEFT)
        self.work = self.work._replace(copy=np.empty((size, 4), np.float32))
        ancestors = np.uint32(0 if whole else self.work.job[0]["ancestors"])
        start_job(self.work, np.uint32(node), np.uint32(side), ancestors, keep_dead)

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
        nodes = min(budget, len(self.work.copy)) // (FILL // 2) + 64
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
        if job["phase"] == REPLAYING and left > 0:
            replay_step(target, self.work, self._resting, *self._slot, left)

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
            graft(pool, self.work, self._slot[0])
        self._rest()
        return target

    def cancel(self, pool: Pool) -> None:
        """Give the running rebuild up; the tree is as if it had never begun."""
        self.wait()
        if self._target is pool and self.running:
            free_subtree(pool, self._slot[0])
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
