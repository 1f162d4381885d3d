"""Writing the map to disk while the run goes on: every registered point, in tiles, with bounded memory."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError, OutputError
from boxplus.formats.clouds.ply import PlyWriter, ply_vertex_count, read_ply
from boxplus.formats.clouds.point_cloud import as_records
from boxplus.formats.output import TEMPORARY_SUFFIX, make_folder, output_error
from boxplus.maps.tiles.journal import JournalWriter, read_journal
from boxplus.maps.tiles.layout import (
    MANIFEST,
    Manifest,
    TileIndex,
    journal_path,
    list_journals,
    list_segments,
    list_tiles,
    read_manifest,
    segment_path,
    split_by_tile,
    tile_folder,
    write_manifest,
)
from boxplus.maps.tiles.voxel_thinning import RecentVoxels, first_per_voxel

_log = logging.getLogger(__name__)

LARGEST_COORDINATE = 1e6
"""Points farther from the world origin than this are not map points but a sign of a lost filter [m]."""
_SEGMENTS_BEFORE_COMPACTION = 4


class TileWriter:
    """Streams registered points to a map folder (layout: docs/map_files.md).

    Points first go to a journal, which reaches the operating system before `append` returns, and to memory. When
    `max_buffered_points` are in memory, a background thread sorts them into tiles, writes one segment file per tile
    (temporary file, fsync, rename) and removes their journal; meanwhile at most as many again can be taken. A killed
    process therefore loses no appended block; the map then says `closed: false`, and opening it reads the journals.

    With `voxel`, one point per voxel is kept. Points whose voxel was filled a short while ago are dropped at once; when
    the segments of a tile have doubled since it was last thinned, they are rewritten as one thinned segment, so that the
    disk space is bounded by the volume that was seen, not by the time.

    A folder that already holds a map of the same settings is continued. Any other folder that is not empty is refused;
    nothing but superseded segments and leftovers of this writer's own is ever removed.

    Args:
        folder: created where it does not exist.
        tile_size: edge of the cubic tiles [m].
        max_buffered_points: bound of the memory, about 120 bytes a point (60 MB at the default).
        voxel: keep one point per voxel of this edge [m]; None keeps every point.

    Raises:
        InputError: settings that are not positive, a folder with other contents, a map with other settings.
        OutputError: the folder cannot be written.
    """

    def __init__(
        self,
        folder: str | Path,
        tile_size: float = 50.0,
        max_buffered_points: int = 500_000,
        voxel: float | None = None,
    ) -> None:
        if not (
            0 < tile_size <= LARGEST_COORDINATE and max_buffered_points > 0 and (voxel is None or 1e-3 <= voxel <= tile_size)
        ):
            raise InputError(
                "tile_size > 0 m, max_buffered_points > 0 and 0.001 m ≤ voxel ≤ tile_size",
                f"{tile_size}, {max_buffered_points} and {voxel}",
                "correct the settings",
            )
        self.folder = make_folder(folder)
        self.rejected = 0
        """Points that were not finite or farther than `LARGEST_COORDINATE` from the origin."""
        self.stored = 0
        """Points taken over so far, after thinning."""
        self._max_buffered = max_buffered_points
        self._manifest = self._open_folder(tile_size, voxel)
        self._recent = None if voxel is None else RecentVoxels(voxel)
        self._chunks: list[NDArray[np.float32]] = []
        self._buffered = 0
        self._journal: JournalWriter | None = None
        self._failure: OutputError | None = None
        self._closed = False
        self._generation = self._recover()
        write_manifest(self.folder, self._manifest)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="boxplus-map")
        self._pending: Future[None] | None = None

    def _open_folder(self, tile_size: float, voxel: float | None) -> Manifest:
        if not (self.folder / MANIFEST).exists():
            if next(self.folder.iterdir(), None) is not None:
                raise InputError(
                    "an empty folder or one with a boxplus map",
                    f"other files in {self.folder}",
                    "choose another folder for the map",
                )
            return Manifest(float(tile_size), voxel)
        manifest = read_manifest(self.folder)
        if (manifest.tile_size_m, manifest.voxel_m) != (float(tile_size), voxel):
            raise InputError(
                f"tile_size {manifest.tile_size_m} m and voxel {manifest.voxel_m}, as the map in {self.folder} has",
                f"tile_size {tile_size} m and voxel {voxel}",
                "use the same settings to continue that map, or another folder",
            )
        return replace(manifest, closed=False, segments=None)

    def _recover(self) -> int:
        """Finish what an interrupted run left behind; returns the next generation."""
        last = 0
        for index in list_tiles(self.folder):
            for leftover in tile_folder(self.folder, index).glob(f"*.ply{TEMPORARY_SUFFIX}"):
                with suppress(OSError):
                    leftover.unlink()
            last = max(last, *list_segments(self.folder, index), 0)
        for generation, path in list_journals(self.folder).items():
            journal = read_journal(path)
            _log.warning("%s: taking over %d points of an interrupted run", path, len(journal.records))
            self._store(generation, [journal.records])
            last = max(last, generation)
        return last + 1

    def append(self, points_world: ArrayLike, intensity: ArrayLike | None = None) -> None:
        """Take over a block of points.

        Args:
            points_world: (N, 3) float64 or float32, world frame [m]; stored as float32. Points that are not finite are dropped
                and counted in `rejected`.
            intensity: (N,) or None; in every block of a map or in none.

        Raises:
            InputError: shapes that do not match, or intensities in some blocks only.
            OutputError: the disk is full or the folder cannot be written, now or in the background since the last call;
                what was appended before is intact. Every later call raises the same error. Also after `close`.
        """
        records = as_records(points_world, intensity)
        self._check_usable()
        if self._manifest.intensity is None:
            self._manifest = replace(self._manifest, intensity=intensity is not None)
            self._attempt(lambda: write_manifest(self.folder, self._manifest))
        elif self._manifest.intensity != (intensity is not None):
            raise InputError(
                f"points {'with' if self._manifest.intensity else 'without'} intensities, as the map in {self.folder} has",
                "the opposite",
                "give intensities in every block or in none",
            )
        if not np.abs(records[:, :3]).max(initial=0.0) < LARGEST_COORDINATE:  # also true for NaN
            usable = (np.abs(records[:, :3]) < LARGEST_COORDINATE).all(axis=1)
            self.rejected += int(len(records) - usable.sum())
            records = records[usable]
        if self._recent is not None:
            records = records[self._recent.new(records)]
        if not len(records):
            return
        self._attempt(lambda: self._to_journal(records))
        self._chunks.append(records)
        self._buffered += len(records)
        self.stored += len(records)
        if self._buffered >= self._max_buffered:
            self._attempt(self._hand_over)

    def _check_usable(self) -> None:
        if self._pending is not None and self._pending.done():
            self._attempt(self._wait)
        if self._failure is not None:
            raise self._failure
        if self._closed:
            raise OutputError(f"expected an open map {self.folder} – got one that was closed – append before close()")

    def _attempt(self, step: Callable[[], None]) -> None:
        """Run a step that writes; its failure is the last thing this writer does."""
        try:
            step()
        except OSError as error:
            self._failure = error if isinstance(error, OutputError) else output_error(self.folder, error)
            raise self._failure from error

    def _to_journal(self, records: NDArray[np.float32]) -> None:
        if self._journal is None:
            self._journal = JournalWriter(journal_path(self.folder, self._generation), records.shape[1])
        self._journal.append(records)

    def _hand_over(self) -> None:
        """Give the buffered points to the background thread; waits while it still works on those before."""
        self._wait()
        if self._journal is not None:
            self._journal.close()
            self._journal = None
            self._pending = self._worker.submit(self._store, self._generation, self._chunks)
            self._generation += 1
            self._chunks, self._buffered = [], 0

    def _wait(self) -> None:
        if self._pending is not None:
            pending, self._pending = self._pending, None
            pending.result()

    def _store(self, generation: int, chunks: Sequence[NDArray[np.float32]]) -> None:
        """Write the segments of a generation, then remove its journal."""
        for index, records in split_by_tile(np.concatenate(chunks), self._manifest.tile_size_m):
            if not segment_path(self.folder, index, generation).exists():  # else written before an interruption
                self._store_segment(index, generation, records)
        try:
            journal_path(self.folder, generation).unlink()
        except OSError as error:
            raise output_error(self.folder, error) from error

    def _store_segment(self, index: TileIndex, generation: int, records: NDArray[np.float32]) -> None:
        make_folder(tile_folder(self.folder, index))
        superseded: list[Path] = []
        voxel = self._manifest.voxel_m
        if voxel is not None:
            records = records[first_per_voxel(records, voxel)]
            superseded = self._due_for_compaction(index, len(records))
            older = [as_records(cloud.points, cloud.intensity) for cloud in map(read_ply, superseded)]
            if any(rows.shape[1] != records.shape[1] for rows in older):
                _log.warning("%s holds points with and without intensities; it is left as it is", tile_folder(self.folder, index))
                superseded = []
            if superseded:
                records = np.concatenate([*older, records])
                records = records[first_per_voxel(records, voxel)]
        with PlyWriter(segment_path(self.folder, index, generation)) as writer:
            writer.append(records[:, :3], records[:, 3] if records.shape[1] == 4 else None)
        for path in superseded:
            path.unlink(missing_ok=True)

    def _due_for_compaction(self, index: TileIndex, added: int) -> list[Path]:
        """The segments of a tile, when they and the `added` points are to be rewritten as one; else none."""
        segments = list(list_segments(self.folder, index).values())
        if len(segments) < _SEGMENTS_BEFORE_COMPACTION:
            return []
        try:
            counts = [ply_vertex_count(path) for path in segments]
        except InputError as error:
            _log.warning("%s; the tile is left as it is", error)
            return []
        return segments if sum(counts) + added >= 2 * max(counts) else []

    def close(self) -> None:
        """Write what is still buffered and mark the map as closed; safe to call twice.

        Raises:
            OutputError: the disk is full; what was appended is intact in the journal.
        """
        if self._closed:
            return
        self._closed = True
        try:
            if self._failure is None:
                self._attempt(self._hand_over)
                self._attempt(self._wait)
                self._attempt(self._write_closed)
        finally:
            self._worker.shutdown(wait=True)
            if self._journal is not None:
                self._journal.close()
                self._journal = None

    def _write_closed(self) -> None:
        segments = sum(len(list_segments(self.folder, index)) for index in list_tiles(self.folder))
        write_manifest(self.folder, replace(self._manifest, closed=True, segments=segments))

    def __enter__(self) -> TileWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        if error is None:
            self.close()
        else:
            with suppress(OutputError):
                self.close()
