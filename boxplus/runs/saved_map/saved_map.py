"""Open a map that an earlier run saved, or a bare cloud: its points around any position, and its local maps."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._arguments import as_settings
from boxplus.errors import InputError
from boxplus.formats.clouds.cloud_file import CLOUD_ENDINGS, read_cloud
from boxplus.formats.clouds.las import read_survey
from boxplus.formats.clouds.point_cloud import FARTHEST_M
from boxplus.formats.output import advice_to_put_back
from boxplus.formats.trajectory import Trajectory
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.maps.tiles.layout import MANIFEST, TileIndex, tile_folder
from boxplus.maps.tiles.store import TileStore
from boxplus.maps.tiles.voxel_thinning import first_per_voxel
from boxplus.runs.fleet.recordings import is_recording
from boxplus.runs.run_folder import RunFolder, run_of_map
from boxplus.runs.saved_map.map_trajectories import map_trajectories
from boxplus.runs.saved_map.places import along, over_ground
from boxplus.runs.saved_map.tiled_points import TiledPoints
from boxplus.runs.storage.output_folder import doubts_of, program_of

_SPREAD = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)
_MARKER = 1e18  # m, and beyond: no coordinates
_ROUNDING = 0.01  # m, by which a point may lie outside of its tile
_ALONE_M, _MOST_ALONE, _FEWEST = 2.0, 0.9, 1000  # points alone in a cube of such an edge show no surface; share, and number
_WHAT = "a folder of 'boxplus lio', 'slam' or 'map merge', a map folder with tiles, or a PLY, PCD, LAS, LAZ or E57 file"

_MAKE_ONE = "make a map of it by 'boxplus slam', and give its output folder"


@dataclass(frozen=True, slots=True, eq=False)
class SavedMap:
    """A map from disk.

    Attributes:
        path: what was opened.
        kind: "boxplus lio", "boxplus slam", "boxplus map merge", "map folder" or "point cloud".
        local_maps: places in it; T_odo_map (7,) is the pose of each in the map's frame, z up, and its points are those that can
            be seen from there. Covariances are those of the trajectory, zero for a map without one.
        trajectories: the poses it was made on, in the map's frame: of a run, or each session of a joint map; none for a bare one.
        voxel: one point per voxel of this edge is given [m].
        origin: (3,) what is counted from, in the coordinates of the file it is from [m]; zero for most, a multiple of 1 km where
            a LAS or LAZ file has coordinates of the Earth.
        report: sentences on what it was opened as, and what had to be computed.
        damage: on what is torn and left out, as it was found so far: a tile may turn out damaged when it is read.
        doubts: why the run that wrote it says it is not to be trusted; accepted: what of that somebody accepted.
    """

    path: Path
    kind: str
    local_maps: list[LocalMap]
    trajectories: list[Trajectory]
    voxel: float
    report: list[str]
    _points: TiledPoints
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    damage: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    accepted: list[str] = field(default_factory=list)

    def points_near(self, centre: ArrayLike, radius: float) -> NDArray[np.float32]:
        """(N, 3) float32 points within `radius` [m] of `centre` (3,), in the map's frame; tiles are read as they are needed."""
        return self._points.near(centre, radius)

    def all_points(self, most: int) -> NDArray[np.float32] | None:
        """(N, 3) float32, all of them; None where there are more than `most`."""
        found, count = [np.zeros((0, 3), np.float32)], 0
        for index in self._points.tiles:
            found.append(self._points.tile(index))
            count += len(found[-1])
            if count > most:
                return None
        return np.concatenate(found)


def open_saved_map(path: str | Path, config: LocalMapConfig | None = None) -> SavedMap:
    """Open the folder of a run or of a joint map, a folder with map tiles, or a PLY, PCD, LAS, LAZ or E57 file, as a map.

    Of a run, the (corrected) trajectory says where its local maps are, of a joint map those of its sessions. Without one they
    stand on a grid over the ground, which is said in `report`. z is taken to be up.

    Args:
        config: where local maps are cut, their voxel and range.

    Raises:
        InputError: none of these; no map in it, or no point; a trajectory without times.

    Example:
        `saved = open_saved_map("run1_slam"); saved.points_near([0.0, 0.0, 0.0], 30.0)`
    """
    config = as_settings(LocalMapConfig, config)
    base = Path(path)
    if not base.exists():
        advice = advice_to_put_back(base, base.absolute().parent) or "check the path"
        raise InputError(_WHAT, f"nothing at {base}", advice)
    report, damage, doubts, accepted = list[str](), list[str](), list[str](), list[str]()
    kind, trajectories, origin = "point cloud", list[Trajectory](), np.zeros(3)
    if base.is_file():
        points, origin = _of_file(base, config.voxel, damage)
        if (run := run_of_map(base)) is not None:
            doubts, accepted = doubts_of(run.summary)
        if origin.any():
            report.append(f"positions in the map are counted from {', '.join(f'{v:.0f}' for v in origin)} m of the file")
    else:
        tiles, kind, trajectories = _what_is_in(base, report, doubts, accepted)
        points = _of_tiles(tiles, config.voxel, report, damage)
    if not points.tiles:
        raise InputError("a map with points", f"none in {base}", "; ".join(damage) or "give the map of a run that went through")
    if trajectories:
        local_maps = along(trajectories, points.near, config)
        way = "its trajectory" if len(trajectories) == 1 else f"the trajectories of its {len(trajectories)} sessions"
        report.append(f"{len(local_maps)} local maps were computed from the map along {way}")
    else:
        local_maps, spacing = over_ground(points, points.near, config)
        report.append(
            f"the map has no trajectory: {len(local_maps)} local maps were computed over its ground, every {spacing:g} m, and "
            "z is taken to be up"
        )
    if not local_maps:
        raise InputError("a map with ground to stand on, z up", f"none in {base}", "turn the cloud so that z is up, in metres")
    return SavedMap(base, kind, local_maps, trajectories, config.voxel, report, points, origin, damage, doubts, accepted)


def _what_is_in(base: Path, report: list[str], doubts: list[str], accepted: list[str]) -> tuple[Path, str, list[Trajectory]]:
    """The folder with the tiles, what wrote it, and the trajectories they were made on."""
    is_bare = (base / MANIFEST).is_file()
    folder = run_of_map(base) if is_bare else RunFolder(base)
    if folder is None:
        return base, "map folder", []
    if not is_bare and not (folder.tiles / MANIFEST).is_file():
        raise _no_tiles(folder)
    program = program_of(folder.summary) if folder.summary.is_file() else None
    trajectories = map_trajectories(folder.path)
    for trajectory in trajectories:
        report.extend(trajectory.warnings)
        trajectory.times  # noqa: B018 - refuses one without times
    if program is not None:
        for kept, texts in zip((doubts, accepted), doubts_of(folder.summary), strict=True):
            kept.extend(texts)
    if is_bare and trajectories:
        whose = "trajectory is" if len(trajectories) == 1 else "trajectories are"
        report.append(f"the map belongs to the run in {folder.path}, whose {whose} used")
    kind = "map folder" if is_bare and not trajectories else program or "map folder"
    return folder.tiles, kind, trajectories


def _no_tiles(folder: RunFolder) -> InputError:
    """What is in place of a map, and what to do about it."""
    advice = advice_to_put_back(folder.tiles)
    if folder.summary.is_file():
        program = program_of(folder.summary) or "a run"
        found = f"a folder of {program!r} without map tiles, {folder.path}"
        if program == "boxplus map merge":
            return InputError(_WHAT, f"{found}: no two of its runs met", "give the folder of one of them")
        return InputError(_WHAT, found, advice or "run without --no-map, or give the folder of a run that wrote a map")
    if is_recording(folder.path):
        return InputError(_WHAT, f"a recording, {folder.path}", _MAKE_ONE)
    return InputError(_WHAT, f"a folder without map tiles, {folder.path}", advice or "give the output folder of a run")


def _of_tiles(folder: Path, voxel: float, report: list[str], damage: list[str]) -> TiledPoints:
    store = TileStore.open(folder)
    damage.extend(store.damage)
    report.extend(text for text in store.report if text not in store.damage)

    def note(text: str) -> None:
        if text not in damage:  # a tile that was let go of is read again
            damage.append(text)

    size = store.manifest.tile_size_m

    def read(index: TileIndex) -> NDArray[np.float32]:
        torn: list[str] = []
        points = store.read_tile(index, damaged=torn).points
        for text in torn:
            note(f"a tile is damaged, and what could not be read is left out: {text}")
        # Overwritten bytes read as numbers too; those of a tile lie in it.
        low = np.array(index) * size
        inside = ((points >= low - _ROUNDING) & (points <= low + size + _ROUNDING)).all(axis=1)
        if not inside.all():
            name = tile_folder(folder, index).name
            note(f"tile {name} is damaged: {np.count_nonzero(~inside)} of its points lie outside of it and are left out")
            points = points[inside]
        return np.ascontiguousarray(points[first_per_voxel(points, voxel)])

    return TiledPoints(store.counts, store.manifest.tile_size_m, read)


def _of_file(path: Path, voxel: float, damage: list[str]) -> tuple[TiledPoints, NDArray[np.float64]]:
    """A cloud is kept in memory as a whole, thinned; and the origin (3,) that it is counted from."""
    origin, ending = np.zeros(3), path.suffix.lower()
    if ending not in CLOUD_ENDINGS:
        raise InputError(_WHAT, f"a file {path.name}", _MAKE_ONE if is_recording(path) else "convert it to one of these")
    if ending in (".las", ".laz"):
        cloud, origin = read_survey(path)
    else:
        cloud = read_cloud(path)
    points = cloud.points[np.isfinite(cloud.points).all(axis=1)]
    _refuse_another_unit(path, points)
    # A few are markers of no return (1e30); all of them are of a map projection, and lost their digits as they were written.
    is_near = (np.abs(points) <= FARTHEST_M).all(axis=1)
    if far := len(points) - int(np.count_nonzero(is_near)):
        farthest = float(np.abs(points).max())
        if 2 * far > len(points):
            raise InputError(
                f"coordinates within {FARTHEST_M / 1e3:.0f} km of the origin, which float32 holds to 4 mm",
                f"{far} of {len(points)} points farther away, up to {farthest:.0f} m, which it holds to "
                f"{np.spacing(np.float32(farthest)):.2g} m ({path})",
                "subtract a local origin from them before they are written as float32",
            )
        damage.append(
            f"{far} of {len(points)} points lie farther than {FARTHEST_M / 1e3:.0f} km from the origin and are left out"
        )
        points = points[is_near]
    return TiledPoints.of(points, voxel), origin


def _refuse_another_unit(path: Path, points: NDArray[np.float32]) -> None:
    """Surfaces in metres have many points in a cube of 2 m; in millimetres, and mostly in centimetres, each is alone in its own.

    Asked before anything else: such a site reaches farther than float32 is good for, and has a tile for every point.
    """
    seen = points[(np.abs(points) < _MARKER).all(axis=1)]
    if len(seen) < _FEWEST:
        return
    cubes = np.floor(seen.astype(np.float64) / _ALONE_M).astype(np.int64).view(np.uint64)
    x, y, z = (cubes[:, k] * _SPREAD[k] for k in range(3))  # sums that wrap around: two cubes share one about never
    alone = len(np.unique(x + y + z)) / len(seen)
    if alone <= _MOST_ALONE:
        return
    low, high = np.percentile(seen, [1.0, 99.0], axis=0)
    extent = " x ".join(f"{width:.0f}" for width in high - low)
    raise InputError(
        f"a cloud in metres, with surfaces of many points in a cube of {_ALONE_M:g} m",
        f"{100.0 * alone:.0f} % of the points alone in theirs, in a cloud of {extent} m ({path})",
        "multiply it by 0.001 where it is in millimetres, by 0.01 in centimetres; thin it less where it is in metres",
    )
