"""A dynamic k-d tree: exact nearest neighbours in a set of points that changes all the time."""

from __future__ import annotations

from types import TracebackType
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import run_chunks
from boxplus._thread_guard import ThreadGuard, changes, reads
from boxplus.errors import InputError
from boxplus.maps.ikd_tree.answers import InsertReport, Neighbors
from boxplus.maps.ikd_tree.batch import fill_operations, keep_near, update_batch
from boxplus.maps.ikd_tree.check import check_tree
from boxplus.maps.ikd_tree.collect import collect, nearest_batch
from boxplus.maps.ikd_tree.input import as_corner, as_points, is_length, round_down, round_up
from boxplus.maps.ikd_tree.job import Rebuilder, build_pool, new_work
from boxplus.maps.ikd_tree.leaf import BUCKET
from boxplus.maps.ikd_tree.pool import LEFT, ROOT, new_pool, pool_bytes, reserve, slot_counts
from boxplus.maps.ikd_tree.rebuild import settle
from boxplus.maps.ikd_tree.search import STACK, STACK_DEPTH, IkdView
from boxplus.maps.ikd_tree.update import DELETE, INSERT, INSERT_DOWNSAMPLED, MAX_DEPTH, OPERATION, REVIVE

MAX_EXTENT = 100_000.0  # [m] from the origin, per axis: float32 resolves 8 mm there
DELETE_TOLERANCE = 1e-6  # [m] per axis
IN_PLACE = 3000  # points; larger subtrees are rebuilt in slices
_CHECK = 6 * BUCKET  # smaller subtrees are not checked for balance: a few leaves cannot always be halved
_BATCH = 2048  # points inserted in one kernel call
_BUDGET = 20_000  # point visits of a rebuild a call ...
_BUDGET_PER_POINT = 800  # ... and for every point the call added or removed: large enough that a rebuild is over soon
_ROOM = 128  # nodes made ready for a kernel call; it stops and asks again when they are used up
_QUERY_CHUNK = 2048


class IkdTree:
    """Points in a balanced k-d tree that takes inserts, deletions and searches at any time.

    Coordinates are kept in float32 relative to `origin` (float64, whole metres, chosen from the first points); all
    searches are exact for these stored coordinates. What a search returns depends only on the operations that came
    before, never on the shape of the tree, the kind of rebuild or the number of threads. Searches may run on several
    threads at once; an update together with anything else is refused (InputError).

    Deleted points can be revived by `reinsert_box` until those since the last clean-up are more than `delete_ratio` of all:
    then all are forgotten and their memory is reclaimed. Points removed by downsampling are gone at once.

    Args:
        points: (N, 3) first points [m], as for `build`.
        cell_size: side of the cells of a downsampled insert [m].
        rebuild: how large subtrees are rebuilt: `incremental` (a bounded share of the work in each call), `background`
            (the same shares on a thread of its own) or `inplace` (at once).
        balance_ratio: a subtree is rebuilt when one side has more than this share of its points, in (0.5, 1).
        delete_ratio: deleted points are forgotten when they are more than this share of all, in (0, 1).
        threads: threads of `nearest`.

    Raises:
        InputError: a parameter is out of range.

    Example:
        >>> tree = bp.IkdTree([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
        >>> tree.nearest([[1.0, 2.0, 2.5]], k=1).points.tolist()
        [[[1.0, 2.0, 3.0]]]
    """

    def __init__(
        self,
        points: ArrayLike | None = None,
        *,
        cell_size: float | None = None,
        rebuild: Literal["incremental", "background", "inplace"] = "incremental",
        balance_ratio: float = 0.6,
        delete_ratio: float = 0.5,
        threads: int = 1,
    ) -> None:
        if rebuild not in ("incremental", "background", "inplace"):
            raise InputError("rebuild as incremental, background or inplace", repr(rebuild), "choose one of the three")
        if not 0.5 < balance_ratio < 1.0:
            raise InputError("balance_ratio in (0.5, 1)", str(balance_ratio), "take 0.6")
        if not 0.0 < delete_ratio < 1.0:
            raise InputError("delete_ratio in (0, 1)", str(delete_ratio), "take 0.5")
        if cell_size is not None and not is_length(cell_size):
            raise InputError("cell_size above 0 m", repr(cell_size), "give the side of a downsampling cell in metres")
        if threads < 1:
            raise InputError("threads of at least 1", str(threads), "take 1")
        self._guard = ThreadGuard("IkdTree")
        self.cell_size = cell_size
        self.threads = threads
        self.origin: NDArray[np.float64] = np.zeros(3)
        self._rebuild = rebuild
        self._delete_ratio = delete_ratio
        self._placed = False  # whether the origin has been chosen
        self._revivable = 0  # points deleted since the last clean-up
        self._pool = new_pool(1, 0)
        self._rebuilder = Rebuilder(
            new_work(IN_PLACE, balance_ratio, _CHECK),
            new_work(IN_PLACE, balance_ratio, _CHECK),
            own_thread=rebuild == "background",
        )
        if points is not None:
            self.build(points)

    @changes
    def build(self, points: ArrayLike, *, origin: ArrayLike | None = None) -> InsertReport:
        """Replace all contents by `points`, (N, 3) [m], in a balanced tree; no downsampling. `origin` (3,) [m]: of another tree.

        Points that are not finite or too far from the origin are rejected and counted.

        Raises:
            InputError: wrong shape.
        """
        world = as_points(points, "points")
        self._rebuilder.cancel(self._pool)
        self._placed = origin is not None
        if origin is not None:
            self.origin = as_corner(origin, "origin")
        relative, not_finite, stored = self._to_relative(world)
        self._pool = build_pool(np.pad(relative, ((0, 0), (0, 1))))
        self._job["live"], self._job["queued"], self._job["depth"] = len(relative), 0, 0
        self._revivable = 0
        return InsertReport(len(relative), 0, not_finite, len(world) - len(relative) - not_finite, stored)

    @changes
    def insert(self, points: ArrayLike, *, downsample: bool = False) -> InsertReport:
        """Add points, (N, 3) [m], one after the other.

        With `downsample`, a cell of side `cell_size` (aligned to the world's zero) that has a live point takes no other one.
        Points that are not finite or too far from the origin are rejected and counted.

        Raises:
            InputError: wrong shape, or `downsample` without a `cell_size`.
        """
        if downsample and self.cell_size is None:
            raise InputError("a cell_size for a downsampled insert", "none", "give IkdTree a cell_size, or insert all points")
        world = as_points(points, "points")
        relative, not_finite, stored = self._to_relative(world)
        operations = np.empty(len(relative), OPERATION)
        fill_operations(relative, INSERT_DOWNSAMPLED if downsample else INSERT, operations)
        inserted = self._update(operations)
        stored[stored] = operations["kind"] == INSERT
        too_far = len(world) - len(relative) - not_finite
        return InsertReport(inserted, len(relative) - inserted, not_finite, too_far, stored)

    @changes
    def delete_points(self, points: ArrayLike) -> int:
        """Delete the live points within 1e-6 m on each axis of any of `points`, (N, 3) [m]; returns how many there were.

        Raises:
            InputError: wrong shape.
        """
        relative, _, _ = self._to_relative(as_points(points, "points"))
        centers = relative.astype(np.float64)
        low, high = round_up(centers - DELETE_TOLERANCE), round_up(np.nextafter(centers + DELETE_TOLERANCE, np.inf))
        return self._delete(np.concatenate([low, high], axis=1))

    @changes
    def delete_box(self, lo: ArrayLike, hi: ArrayLike) -> int:
        """Delete the points with `lo ≤ p < hi` on every axis, (3,) each [m]; returns how many live ones there were.

        Raises:
            InputError: wrong shape or NaN.
        """
        return self._delete(self._relative_box(lo, hi))

    @changes
    def reinsert_box(self, lo: ArrayLike, hi: ArrayLike) -> int:
        """Revive the deleted points with `lo ≤ p < hi` on every axis, (3,) each [m]; returns how many there were.

        Points that were removed by downsampling or forgotten after too many deletions (see the class) do not return.

        Raises:
            InputError: wrong shape or NaN.
        """
        box = self._relative_box(lo, hi)
        if not self._job["keep_dead"]:
            self._complete()  # a clean-up is running: what it forgets must be gone before anything is revived
        revived = self._update_boxes(box, REVIVE)
        self._revivable -= revived
        return revived

    @reads
    def nearest(self, queries: ArrayLike, k: int, *, max_distance: float = np.inf) -> Neighbors:
        """The k nearest live points of each query within `max_distance` (inclusive).

        Args:
            queries: (M, 3) [m]; rounded to float32 relative to the origin. A query that is not finite finds nothing.
            k: how many neighbours.
            max_distance: range [m].

        Returns:
            distances (M, k), points (M, k, 3) and counts (M,); equal distances are ordered by x, y, z.

        Raises:
            InputError: wrong shape, k below 1, or a negative range.
        """
        world = as_points(queries, "queries")
        if k < 1:
            raise InputError("k of at least 1", str(k), "ask for one neighbour or more")
        if not max_distance >= 0:
            raise InputError("max_distance of at least 0 m", str(max_distance), "give a range in metres, or leave it out")
        relative = (world - self.origin).astype(np.float32)
        size = len(relative)
        result = Neighbors(np.empty((size, k)), np.empty((size, k, 3)), np.empty(size, np.int64))
        max_sq = round_down(float(max_distance) ** 2)
        view = self.view()

        def work(_: int, begin: int, end: int) -> None:
            sq, stack = np.empty(k, np.float32), np.empty(STACK_DEPTH + k, STACK)
            nearest_batch(view, relative, begin, end, max_sq, self.origin, *result, sq, stack)

        run_chunks(work, size, _QUERY_CHUNK, self.threads)
        return result

    @reads
    def radius_search(self, center: ArrayLike, radius: float) -> NDArray[np.float64]:
        """The live points within `radius` [m] of `center` (3,) [m], inclusive: (K, 3), ordered by x, y, z.

        Raises:
            InputError: wrong shape, NaN or a negative radius.
        """
        if not radius >= 0:
            raise InputError("radius of at least 0 m", str(radius), "give a radius in metres")
        x, y, z = (as_corner(center, "center") - self.origin).astype(np.float32)
        margin = radius * (1.0 + 1e-6) + 1e-3
        middle = np.array([x, y, z], np.float64)
        box = np.concatenate([middle - margin, middle + margin]).astype(np.float32)
        return self._collect(box, x, y, z, round_down(radius**2))

    @reads
    def box_search(self, lo: ArrayLike, hi: ArrayLike) -> NDArray[np.float64]:
        """The live points with `lo ≤ p < hi` on every axis, (3,) each [m]: (K, 3), ordered by x, y, z.

        Raises:
            InputError: wrong shape or NaN.
        """
        zero = np.float32(0)
        return self._collect(self._relative_box(lo, hi)[0], zero, zero, zero, np.float32(np.inf))

    def points(self) -> NDArray[np.float64]:
        """All live points, (N, 3) [m], ordered by x, y, z."""
        return self.box_search(np.full(3, -np.inf), np.full(3, np.inf))

    def __len__(self) -> int:
        return int(self._job["live"])

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest corner of the live points, (3,) each [m]; nan for an empty tree."""
        points = self.points()
        if not len(points):
            return np.full(3, np.nan), np.full(3, np.nan)
        return points.min(axis=0), points.max(axis=0)

    def view(self) -> IkdView:
        """The arrays a kernel needs to search this tree; valid until the next update. Coordinates are relative to `origin`."""
        return IkdView(self._pool.inner, self._pool.leaf)

    @property
    def memory_bytes(self) -> int:
        """Bytes of the tree and of a running rebuild."""
        return pool_bytes(self._pool) + self._rebuilder.memory_bytes(self._pool)

    def check_invariants(self) -> int:
        """Check every node in Python (slow; for tests) and return the height of the tree.

        The balance (I6) is not asked for while a rebuild is running or noted.

        Raises:
            InvariantError: an invariant of docs/ikd_tree.md is violated.
        """
        self._rebuilder.wait()
        pending = self._rebuilder.running or self._job["queued"] > 0
        balance = None if pending else float(self._job["balance"])
        return check_tree(self._pool, len(self), balance=balance, smallest=int(self._job["check"])).height

    def close(self) -> None:
        """End the background thread; the tree can still be used, and then rebuilds in the calling thread."""
        self._rebuilder.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    @property
    def _job(self) -> np.void:
        job: np.void = self._rebuilder.work.job[0]
        return job

    def _delete(self, boxes: NDArray[np.float32]) -> int:
        deleted = self._update_boxes(boxes, DELETE)
        self._revivable += deleted
        if self._revivable > self._delete_ratio * (len(self) + self._revivable):
            self._forget()
        return deleted

    def _update_boxes(self, boxes: NDArray[np.float32], kind: np.int64) -> int:
        operations = np.empty(len(boxes), OPERATION)
        operations["box"] = boxes
        operations["kind"] = kind
        return self._update(operations)

    def _update(self, operations: NDArray[np.void]) -> int:
        """Apply operations and do the share of a rebuild that goes with them; returns how many points they changed."""
        changed = 0
        for begin in range(0, len(operations), _BATCH):
            row, end = begin, min(begin + _BATCH, len(operations))
            self._job["changed"] = 0
            self._begin_update(2 * (end - begin) + 2)
            while row < end:
                reserve(self._pool, _ROOM, _ROOM)
                work = self._rebuilder.work
                size = self.cell_size or 0.0
                row = update_batch(self._pool, work, operations, row, end, ROOT, LEFT, size, self.origin)
                if self._job["depth"] > MAX_DEPTH:
                    self._rebuild_all()
            changed += int(self._job["changed"])
            self._end_update(int(self._job["changed"]))
        return changed

    def _begin_update(self, operations: int) -> None:
        """Wait for a slice on the other thread, put a finished rebuild in place, and make room to log the operations."""
        self._rebuilder.wait()
        if self._rebuilder.running:
            if self._rebuilder.finished:
                self._pool = self._rebuilder.swap(self._pool)
            else:
                self._rebuilder.make_log_room(operations)

    def _end_update(self, points: int) -> None:
        """Give the running rebuild its share of work, and begin one where the balance is lost."""
        rebuilder = self._rebuilder
        reserve(self._pool, _ROOM, _ROOM)
        while settle(self._pool, rebuilder.work):
            rebuilder.start(self._pool, int(self._job["node"]), int(self._job["side"]), keep_dead=True)
            if self._rebuild == "inplace":
                self._complete()
        rebuilder.advance(self._pool, _BUDGET + _BUDGET_PER_POINT * points)

    def _forget(self) -> None:
        """Rebuild the whole tree without its deleted points."""
        self._rebuilder.cancel(self._pool)
        self._revivable = 0
        self._rebuilder.start(self._pool, int(ROOT), int(LEFT), keep_dead=False)
        if self._rebuild == "inplace" or slot_counts(self._pool, ROOT, LEFT)[0] <= IN_PLACE:
            self._complete()

    def _rebuild_all(self) -> None:
        """Finish the running rebuild and rebuild the whole tree, now: its height has become too large."""
        self._complete()
        self._rebuilder.start(self._pool, int(ROOT), int(LEFT), keep_dead=True)
        self._complete()
        self._job["depth"] = 0

    def _complete(self) -> None:
        if self._rebuilder.running:
            self._rebuilder.complete(self._pool)
            self._pool = self._rebuilder.swap(self._pool)

    def _to_relative(self, world: NDArray[np.float64]) -> tuple[NDArray[np.float32], int, NDArray[np.bool_]]:
        """The points near enough, float32 relative to the origin; how many are not finite; (N,) which of all are near enough."""
        if not self._placed:
            finite = world[np.isfinite(world).all(axis=1)]
            if len(finite):
                self.origin = np.round(np.median(finite, axis=0))
                self._placed = True
        relative, is_near = np.empty(world.shape, np.float32), np.empty(len(world), np.bool_)
        kept, not_finite = keep_near(np.ascontiguousarray(world), self.origin, MAX_EXTENT, relative, is_near)
        return relative[:kept], not_finite, is_near

    def _relative_box(self, lo: ArrayLike, hi: ArrayLike) -> NDArray[np.float32]:
        """(1, 6) float32: `x ≥ lo` and `x < hi` have the same answer for a stored x after both are rounded up."""
        corners = np.concatenate([as_corner(lo, "lo") - self.origin, as_corner(hi, "hi") - self.origin])
        return round_up(corners)[None, :]

    def _collect(
        self, box: NDArray[np.float32], x: np.float32, y: np.float32, z: np.float32, max_sq: np.float32
    ) -> NDArray[np.float64]:
        stack = np.empty(STACK_DEPTH, STACK)
        out = np.empty((1024, 3), np.float32)
        found = collect(self.view(), box, x, y, z, max_sq, out, stack)
        if found > len(out):
            out = np.empty((found, 3), np.float32)
            collect(self.view(), box, x, y, z, max_sq, out, stack)
        out = out[:found]
        return out[np.lexsort(out.T[::-1])].astype(np.float64) + self.origin
