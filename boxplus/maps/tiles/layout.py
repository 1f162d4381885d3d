"""What a map folder looks like on disk: manifest, tiles of segments, journals. See docs/map_files.md."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.output import atomic_file

MANIFEST = "manifest.json"
TILES = "tiles"
_FORMAT = "boxplus-map-tiles"
_VERSION = 1
_TILE = re.compile(r"x([+-]\d+)_y([+-]\d+)_z([+-]\d+)")
_SEGMENT = re.compile(r"(\d+)\.ply")
_JOURNAL = re.compile(r"journal-(\d+)\.bin")

TileIndex = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Manifest:
    """What must be known of a map folder before its files can be read.

    Attributes:
        tile_size_m: edge of the cubic tiles [m]; tile (i, j, k) begins at (i, j, k)·tile_size_m in the world frame.
        voxel_m: edge of the voxels that hold one point each [m], or None when every point was kept.
        intensity: whether the points have intensities; None until the first points came.
        closed: whether the writer came to its regular end.
        segments: files that it left then, of all tiles; None where it did not come to its end.
    """

    tile_size_m: float
    voxel_m: float | None
    intensity: bool | None = None
    closed: bool = False
    segments: int | None = None


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Replace the manifest in one step.

    Raises:
        OutputError: it cannot be written.
    """
    content = {"format": _FORMAT, "version": _VERSION, **asdict(manifest)}
    with atomic_file(folder / MANIFEST) as file:
        file.write((json.dumps(content, indent=2) + "\n").encode())


def read_manifest(folder: Path) -> Manifest:
    """Read and check the manifest.

    Raises:
        InputError: missing, or not one this version understands.
    """
    path = folder / MANIFEST
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content.pop("format") != _FORMAT or content.pop("version") != _VERSION:
            raise ValueError
        manifest = Manifest(**content)
        size, voxel, segments = manifest.tile_size_m, manifest.voxel_m, manifest.segments
        if not (isinstance(size, int | float) and size > 0 and (voxel is None or (isinstance(voxel, int | float) and voxel > 0))):
            raise ValueError
        if not (segments is None or (type(segments) is int and segments >= 0)):
            raise ValueError
    except OSError as error:
        raise InputError(
            f"a map folder with a {MANIFEST}", f"{path}: {error.strerror}", "give the folder a run wrote its map to"
        ) from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError(
            f"a {MANIFEST} of a version {_VERSION} map", f"something else ({path})", "use the boxplus that wrote it"
        ) from None
    return manifest


def tile_folder(folder: Path, index: TileIndex) -> Path:
    """Where the segments of a tile are."""
    return folder / TILES / "x{:+06d}_y{:+06d}_z{:+06d}".format(*index)


def segment_path(folder: Path, index: TileIndex, generation: int) -> Path:
    """The segment that `generation` added to a tile."""
    return tile_folder(folder, index) / f"{generation:08d}.ply"


def journal_path(folder: Path, generation: int) -> Path:
    """The journal of the points that become the segments of `generation`."""
    return folder / f"journal-{generation:08d}.bin"


def list_tiles(folder: Path) -> list[TileIndex]:
    """The tiles that have a folder, in order."""
    base = folder / TILES
    names = [path.name for path in base.iterdir()] if base.is_dir() else []
    return sorted((int(m[1]), int(m[2]), int(m[3])) for name in names if (m := _TILE.fullmatch(name)))


def list_segments(folder: Path, index: TileIndex) -> dict[int, Path]:
    """The whole segments of a tile by generation, in order."""
    base = tile_folder(folder, index)
    found = {int(m[1]): path for path in base.iterdir() if (m := _SEGMENT.fullmatch(path.name))} if base.is_dir() else {}
    return dict(sorted(found.items()))


def list_journals(folder: Path) -> dict[int, Path]:
    """The journals that were not turned into segments yet, by generation, in order."""
    return dict(sorted((int(m[1]), path) for path in folder.iterdir() if (m := _JOURNAL.fullmatch(path.name))))


def split_by_tile(records: NDArray[np.float32], tile_size: float) -> Iterator[tuple[TileIndex, NDArray[np.float32]]]:
    """Each tile with its rows of `records` (N, 3 or more), rows in their order, tiles in order."""
    if not len(records):
        return
    index = np.floor(records[:, :3].astype(np.float64) / tile_size).astype(np.int64)
    order = np.lexsort((index[:, 2], index[:, 1], index[:, 0]))
    index = index[order]
    begins = np.flatnonzero(np.r_[True, (index[1:] != index[:-1]).any(axis=1)])
    for begin, rows in zip(begins, np.split(order, begins[1:]), strict=True):
        i, j, k = index[begin].tolist()
        yield (i, j, k), records[rows]
