"""Reading a map folder: tile by tile, with a word on what an interrupted run left incomplete."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.clouds.cloud_file import cloud_writer
from boxplus.formats.clouds.ply import ply_vertex_count, read_ply
from boxplus.formats.clouds.point_cloud import as_records
from boxplus.formats.output import TEMPORARY_SUFFIX
from boxplus.maps.tiles.journal import read_journal
from boxplus.maps.tiles.layout import (
    MANIFEST,
    Manifest,
    TileIndex,
    list_journals,
    list_segments,
    list_tiles,
    read_manifest,
    split_by_tile,
    tile_folder,
)
from boxplus.maps.tiles.voxel_thinning import first_per_voxel


@dataclass(frozen=True, slots=True)
class Tile:
    """The points of one tile.

    Attributes:
        index: (i, j, k); the tile begins at index · tile_size in the world frame.
        points: (N, 3) float32, world frame [m].
        intensity: (N,) float32 or None.
    """

    index: TileIndex
    points: NDArray[np.float32]
    intensity: NDArray[np.float32] | None


@dataclass(frozen=True, slots=True)
class TileStore:
    """A map folder opened for reading; make one with `TileStore.open`.

    Attributes:
        folder: the map folder.
        manifest: its settings; `manifest.closed` says whether the run that wrote it came to its regular end.
        counts: points per tile, before thinning across segments.
        report: one sentence for everything that is torn, incomplete or was recovered; empty for a whole map.
        damage: those of them on points that are lost or left out.
    """

    folder: Path
    manifest: Manifest
    counts: dict[TileIndex, int]
    report: tuple[str, ...]
    damage: tuple[str, ...]
    _segments: dict[TileIndex, list[Path]]
    _unsorted: dict[TileIndex, list[NDArray[np.float32]]]

    @classmethod
    def open(cls, folder: str | Path) -> TileStore:
        """Look through a map folder without changing it.

        Raises:
            InputError: not a map folder.
        """
        base = Path(folder)
        manifest = read_manifest(base)
        report, damage = list[str](), list[str]()
        if not manifest.closed:
            report.append("the run that wrote this map did not close it: it was interrupted, or is still going on")
        segments: dict[TileIndex, list[Path]] = {}
        present = 0
        counts: dict[TileIndex, int] = {}
        written: set[tuple[TileIndex, int]] = set()
        for index in list_tiles(base):
            for generation, path in list_segments(base, index).items():
                present += 1
                try:
                    count = ply_vertex_count(path)
                except InputError as error:
                    damage.append(f"a segment is damaged and left out: {error}")
                    continue
                written.add((index, generation))
                segments.setdefault(index, []).append(path)
                counts[index] = counts.get(index, 0) + count
            torn = list(tile_folder(base, index).glob(f"*{TEMPORARY_SUFFIX}"))
            if torn:
                report.append(f"{torn[0]} was being written when the run ended; its points are read from the journal")
        if manifest.segments is not None and present < manifest.segments:
            damage.append(
                f"{manifest.segments - present} of the {manifest.segments} segments that were written are not there, and what "
                "they held is not in the map: put the files back, or copy the folder anew"
            )
        unsorted: dict[TileIndex, list[NDArray[np.float32]]] = {}
        for generation, path in list_journals(base).items():
            records, cut = read_journal(path)
            if len(records) and manifest.intensity is not None and manifest.intensity != (records.shape[1] == 4):
                damage.append(f"{path.name} has points {'without' if manifest.intensity else 'with'} intensities and is left out")
                continue
            taken = 0
            for index, rows in split_by_tile(records, manifest.tile_size_m):
                if (index, generation) not in written:
                    unsorted.setdefault(index, []).append(rows)
                    counts[index] = counts.get(index, 0) + len(rows)
                    taken += len(rows)
            report.append(f"{taken} points were read from {path.name}, not yet sorted into tiles")
            if cut:
                damage.append(f"{path.name}: its last block was cut and is lost")
        whole = (*report, *damage)
        return cls(base, manifest, dict(sorted(counts.items())), whole, tuple(damage), segments, unsorted)

    @property
    def point_count(self) -> int:
        """Points in all tiles, before thinning across segments."""
        return sum(self.counts.values())

    def iter_tiles(self, voxel: float | None = None) -> Iterator[Tile]:
        """One tile after the other, in order of their index; memory holds one tile.

        Args:
            voxel: keep one point per voxel of this edge [m], the one that was written first; None: as the map was
                written. Voxels end at the border of their tile.

        Raises:
            InputError: a segment was removed or damaged since the map was opened.
        """
        for index in self.counts:
            yield self.read_tile(index, voxel)

    def read_tile(self, index: TileIndex, voxel: float | None = None, damaged: list[str] | None = None) -> Tile:
        """One tile of `counts`.

        Args:
            voxel: as for `iter_tiles`.
            damaged: given a list, segments that cannot be read are left out and named in it.

        Raises:
            InputError: a segment was removed or damaged since the map was opened, and `damaged` is None.
        """
        edge = self.manifest.voxel_m if voxel is None else voxel
        parts = []
        for path in self._segments.get(index, []):
            try:
                parts.append(self._read_segment(path))
            except InputError as error:
                if damaged is None:
                    raise
                damaged.append(str(error))
        parts += self._unsorted.get(index, [])
        records = np.concatenate(parts) if parts else np.zeros((0, 3), np.float32)
        if edge is not None:
            records = records[first_per_voxel(records, edge)]
        intensity = np.ascontiguousarray(records[:, 3]) if records.shape[1] == 4 else None
        return Tile(index, np.ascontiguousarray(records[:, :3]), intensity)

    def _read_segment(self, path: Path) -> NDArray[np.float32]:
        cloud = read_ply(path)
        if self.manifest.intensity is not None and self.manifest.intensity != (cloud.intensity is not None):
            raise InputError(
                f"points {'with' if self.manifest.intensity else 'without'} intensities, as {MANIFEST} says",
                f"the opposite in {path}",
                "the file is not of this map: remove it",
            )
        return as_records(cloud.points, cloud.intensity)


def merge(folder: str | Path, outputs: Sequence[str | Path], voxel: float | None = None) -> int:
    """Write all tiles of a map folder into files of one cloud each, holding one tile in memory at a time.

    Args:
        folder: the map folder; it is not changed.
        outputs: files to write: PLY, PCD, LAS, LAZ (extra `las`) or E57 (extra `e57`), by their endings.
        voxel: keep one point per voxel of this edge [m]; None: as the map was written.

    Returns:
        The number of points written.

    Raises:
        InputError: not a map folder, a voxel that is not positive, no output, an ending of no format, or one whose library is
            not installed.
        OutputError: a file cannot be written; nothing incomplete is left behind.
    """
    if not outputs:
        raise InputError("an output file", "none", "name at least one")
    store = TileStore.open(folder)
    if voxel is not None and not voxel * 2**20 > store.manifest.tile_size_m:
        raise InputError(
            f"voxel above {store.manifest.tile_size_m / 2**20:.3g} m for tiles of {store.manifest.tile_size_m} m",
            f"{voxel} m",
            "give a larger voxel, or none to keep all points",
        )
    count = 0
    with ExitStack() as stack:
        writers = [stack.enter_context(cloud_writer(path)) for path in outputs]
        for tile in store.iter_tiles(voxel):
            for writer in writers:
                writer.append(tile.points, tile.intensity)
            count += len(tile.points)
    return count
