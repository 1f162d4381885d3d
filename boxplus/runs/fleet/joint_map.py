"""The joint map of a fleet, written in parallel: each session is cut into regions by one task, each region joined by another.

Of every voxel the point is kept that comes first, in the order of the sessions and of their scans, whichever task ends first:
the map is that of `boxplus map merge`, point by point.
"""

from __future__ import annotations

import io
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.clouds.ply import write_ply
from boxplus.formats.clouds.point_cloud import as_records
from boxplus.maps.tiles.layout import TileIndex, segment_path, split_by_tile
from boxplus.maps.tiles.voxel_thinning import RecentVoxels, first_per_voxel
from boxplus.maps.tiles.writer import LARGEST_COORDINATE
from boxplus.runs.fleet.store import open_store
from boxplus.runs.fleet.tasks import OF_A_SESSION, run_of
from boxplus.runs.sessions.config import JointMapConfig
from boxplus.runs.sessions.joined import write_session_trajectory
from boxplus.runs.sessions.session_run import open_session_run

Floats = NDArray[np.float64]
Region = tuple[int, int]

PARTS = "map_parts"
"""Folder in the store of what sessions gave to regions, until the joint map is written."""

_TILES = 4  # along each side of a region, which has all heights
_OF_A_MAP = (*OF_A_SESSION, "scans.spool", "trajectory.csv")


@dataclass(frozen=True, slots=True)
class Cut:
    """What a session gave to the joint map: points of each region, before others were there; whether they have intensities."""

    points: dict[Region, int]
    intensity: bool


@dataclass(frozen=True, slots=True)
class JoinedRegion:
    """What was written of a region of the joint map: points, and the segments that hold them, one for each tile."""

    points: int
    segments: int


def cut_run(store: str, name: str, number: int, T_world_map: Floats, into: str, config: JointMapConfig) -> Cut:
    """Put the scans of a run where its local maps (n, 7) are now, one file for each region, and its trajectory.

    Args:
        number: of the session, by which the files of a region are ordered.
        into: name of the joint map in the store.
    """
    place = open_store(store)
    tiles, intensity = dict[TileIndex, list[NDArray[np.float32]]](), True
    recent = None if config.voxel is None else RecentVoxels(config.voxel)
    with place.reading(run_of(name), _OF_A_MAP) as folder:
        run = open_session_run(folder, name)
        for scan in run.scans(T_world_map):
            intensity = intensity and scan.intensity is not None
            records = as_records(scan.points, scan.intensity)
            records = records[(np.abs(records[:, :3]) < LARGEST_COORDINATE).all(axis=1)]
            if recent is not None:
                records = records[recent.new(records)]
            for index, rows in split_by_tile(records, config.tile_size):
                tiles.setdefault(index, []).append(rows)
        with tempfile.TemporaryDirectory(prefix="boxplus-fleet-") as scratch:
            write_session_trajectory(Path(scratch), run, T_world_map)
            for file in sorted(Path(scratch).iterdir()):
                place.write(f"{into}/sessions/{file.name}", file.read_bytes())
    columns = 4 if intensity else 3
    regions: dict[Region, dict[TileIndex, NDArray[np.float32]]] = {}
    for index, parts in tiles.items():
        records = np.concatenate([rows[:, :columns] for rows in parts])
        if config.voxel is not None:
            records = records[first_per_voxel(records, config.voxel)]
        regions.setdefault((index[0] // _TILES, index[1] // _TILES), {})[index] = records
    for region, inside in regions.items():
        place.write(_part(region, number), _packed(inside))
    return Cut({region: sum(map(len, inside.values())) for region, inside in regions.items()}, intensity)


def join_region(
    store: str, region: Region, numbers: Sequence[int], into: str, config: JointMapConfig, intensity: bool
) -> JoinedRegion:
    """Write the tiles of a region from what the sessions `numbers`, in this order, gave to it.

    Raises:
        InputError: a part that was written is gone.
    """
    place = open_store(store)
    tiles: dict[TileIndex, list[NDArray[np.float32]]] = {}
    for number in numbers:
        data = place.read(_part(region, number))
        if data is None:
            raise InputError("the parts of a region", f"no {place / _part(region, number)}", "run the fleet again")
        for index, records in _unpacked(data).items():
            tiles.setdefault(index, []).append(records)
    count = 0
    with tempfile.TemporaryDirectory(prefix="boxplus-fleet-") as scratch:
        for index, parts in sorted(tiles.items()):
            records = np.concatenate([rows[:, : 4 if intensity else 3] for rows in parts])
            if config.voxel is not None:
                records = records[first_per_voxel(records, config.voxel)]
            file = Path(scratch) / "tile.ply"
            write_ply(file, records[:, :3], records[:, 3] if intensity else None)
            place.write(segment_path(Path(f"{into}/map"), index, 0).as_posix(), file.read_bytes())
            count += len(records)
    return JoinedRegion(count, len(tiles))


def _part(region: Region, number: int) -> str:
    return f"{PARTS}/{region[0]}_{region[1]}/{number:06d}.npz"


def _packed(tiles: dict[TileIndex, NDArray[np.float32]]) -> bytes:
    index = np.array(list(tiles), dtype=np.int64)
    counts = np.array([len(records) for records in tiles.values()], dtype=np.int64)
    file = io.BytesIO()
    np.savez(file, index=index, counts=counts, records=np.concatenate(list(tiles.values())))
    return file.getvalue()


def _unpacked(data: bytes) -> dict[TileIndex, NDArray[np.float32]]:
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        parts = np.split(stored["records"], np.cumsum(stored["counts"])[:-1])
        return {(i, j, k): rows for (i, j, k), rows in zip(stored["index"].tolist(), parts, strict=True)}
