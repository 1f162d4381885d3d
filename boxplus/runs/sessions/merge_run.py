"""`boxplus map merge`: runs of `boxplus slam` with unknown start poses in, one map of those that met out."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_settings
from boxplus.errors import InputError, printable
from boxplus.formats.clouds.ply import PlyWriter
from boxplus.formats.output import atomic_file
from boxplus.maps.seen_through import SeenThrough
from boxplus.maps.tiles.store import merge
from boxplus.maps.tiles.voxel_thinning import first_per_voxel
from boxplus.maps.tiles.writer import TileWriter
from boxplus.runs.sessions.config import MergeConfig, dump_merge_config
from boxplus.runs.sessions.folder import ClaimedMerge, MergeFolder, claim_merge_folder
from boxplus.runs.sessions.frame import frame_of
from boxplus.runs.sessions.joined import doubts_of_joining, merge_facts, write_session_trajectory
from boxplus.runs.sessions.repeated import refuse_repeated
from boxplus.runs.sessions.session_run import SessionRun, open_session_run, session_names
from boxplus.runs.sessions.summary import MergeSummary
from boxplus.runs.sessions.tables import write_changes, write_encounters
from boxplus.systems.sessions.encounter import Meeting
from boxplus.systems.sessions.session import Session
from boxplus.systems.sessions.sessions import JointWorld, SessionAlignment, align_sessions

Floats = NDArray[np.float64]
Align = Callable[[Sequence[Session]], SessionAlignment]

_THINNED = 2_000_000  # points collected before they are thinned


class WorseMapError(InputError):
    """A joint map that something speaks against was to replace an earlier one."""


@dataclass(frozen=True, slots=True, eq=False)
class MergeResult:
    """What a merge leaves in memory: `summary` as in `run.json`, and `alignment` of all sessions."""

    summary: MergeSummary
    alignment: SessionAlignment


def merge_runs(
    folders: Sequence[str | Path],
    output: str | Path | ClaimedMerge,
    config: MergeConfig | None = None,
    *,
    remove_dynamic: bool = False,
    overwrite: bool = False,
    accept_doubts: bool = False,
    accepted: Sequence[str] = (),
    progress: Callable[[Meeting], None] | None = None,
    align: Align | None = None,
) -> MergeResult:
    """Find out which runs met, and write one map of the largest group that did; the runs themselves stay as they are.

    Args:
        folders: output folders of finished runs of 'boxplus slam', in order of time; the first that is joined gives the frame.
        output: created; docs/output_folder.md says what it holds. An earlier merge there stays whole until the new one is.
            Or what `claim_merge_folder` yields: whoever holds it has asked whether the new one may take its place.
        config: settings; each has a default.
        remove_dynamic: leave out of the map what rays of other stretches of way went through, and report what changed.
        overwrite: replace an earlier merge.
        accept_doubts: also where something speaks against the new joint map, or there is none.
        accepted: doubts that were accepted before.
        progress: called with every pair of sessions.
        align: says where the sessions are; `align_sessions` over all pairs where it is left out.

    Raises:
        InputError: fewer than two runs, one that is none, or two of one recording; a folder that holds something else; OpenCV is
            not installed.
        WorseMapError: a new map with a doubt in the place of an earlier one.
        OutputError: the disk is full or the folder cannot be written; what was there before stays whole.
    """
    began = time.perf_counter()
    config = as_settings(MergeConfig, config)
    paths = [Path(folder) for folder in folders]
    if len({path.resolve() for path in paths}) < max(len(paths), 2):
        raise InputError("two runs at least, each given once", ", ".join(map(str, paths)) or "none", "name their output folders")
    runs = [open_session_run(path, name) for path, name in zip(paths, session_names(paths), strict=True)]
    sessions = [run.session for run in runs]
    refuse_repeated({run.session.name: run.identity for run in runs})
    claimed = nullcontext(output) if isinstance(output, ClaimedMerge) else claim_merge_folder(output, overwrite=overwrite)
    with claimed as place:
        alignment = align(sessions) if align is not None else align_sessions(sessions, config.sessions, progress=progress)
        if place is not output and place.has_joint_map and not accept_doubts:
            _refuse_a_worse_map(place.path, alignment, [run.doubt for run in runs])
        with place.replaced() as own:
            summary = _write(own, runs, alignment, config, remove_dynamic)
            summary = summary.model_copy(update={"seconds": time.perf_counter() - began})
            summary = summary.accept(summary.doubts if accept_doubts else accepted)
            summary.write(own.summary)
    return MergeResult(summary, alignment)


def _refuse_a_worse_map(path: Path, alignment: SessionAlignment, doubts: Sequence[str | None]) -> None:
    """To overwrite says that the earlier map may go, not that what takes its place may be wrong."""
    against = doubts_of_joining(alignment, doubts)
    if len(alignment.worlds[0].members) == 1:
        against = ["no two of the runs met"]
    if against:
        raise WorseMapError(
            f"a joint map that nothing speaks against, to replace the one in {path}", "; ".join(against),
            "choose another folder with --output and look at that map, or add --accept-doubts",
        )  # fmt: skip


def _write(
    own: MergeFolder, runs: Sequence[SessionRun], alignment: SessionAlignment, config: MergeConfig, remove_dynamic: bool
) -> MergeSummary:
    """Everything but the summary."""
    world = alignment.worlds[0]
    places, doubts = [printable(str(run.folder.path.resolve())) for run in runs], [run.doubt for run in runs]
    summary = merge_facts(alignment, places, doubts).model_copy(update={"remove_dynamic": remove_dynamic})
    with atomic_file(own.config) as file:
        file.write(dump_merge_config(config).encode())
    write_encounters(own.encounters, alignment.meetings, [run.session.name for run in runs])
    if len(world.members) == 1:
        return summary
    update = _write_map(own, runs, world, config, remove_dynamic) | {"frame": frame_of(runs[world.members[0]])}
    for number, T in zip(world.members, world.T_world_map, strict=True):
        write_session_trajectory(own.sessions, runs[number], T)
    return summary.model_copy(update=update)


def _write_map(
    own: MergeFolder, runs: Sequence[SessionRun], world: JointWorld, config: MergeConfig, remove_dynamic: bool
) -> dict[str, object]:
    """Tiles of all scans where the sessions are now, without what was seen through; returns facts."""
    members = [(runs[number], T) for number, T in zip(world.members, world.T_world_map, strict=True)]
    seen = _rays_through(members, config) if remove_dynamic else None
    has_intensity = all(_has_intensity(run, T) for run, T in members)
    removed = 0
    with TileWriter(own.tiles, tile_size=config.map.tile_size, voxel=config.map.voxel) as tiles:
        if seen is None:
            for run, T in members:
                for scan in run.scans(T):
                    tiles.append(scan.points, scan.intensity if has_intensity else None)
        else:
            with PlyWriter(own.removed) as apart:
                for run, T in members:
                    for scan in run.scans(T):
                        goes = seen.is_removed(scan.points)
                        intensity = scan.intensity if has_intensity else None
                        tiles.append(scan.points[~goes], None if intensity is None else intensity[~goes])
                        apart.append(scan.points[goes], None if intensity is None else intensity[goes])
                        removed += int(np.count_nonzero(goes))
    if config.map.ply:
        merge(own.tiles, [own.map_ply])
    if seen is None:
        return {"map_points": tiles.stored}
    changes = write_changes(own.changes, seen, [run.session.name for run, _ in members], config.map.change_voxels)
    return {"map_points": tiles.stored, "removed_points": removed, "changes": changes}


def _rays_through(members: Sequence[tuple[SessionRun, Floats]], config: MergeConfig) -> SeenThrough:
    """The rays of all sessions, stretch by stretch, against the points of all of them."""
    edge = 0.5 * config.seen_through.voxel
    kept, waiting, count = np.zeros((0, 3), np.float32), list[NDArray[np.float32]](), 0
    for run, T in members:
        for scan in run.scans(T):
            waiting.append(scan.points.astype(np.float32))
            count += len(scan.points)
            if count > _THINNED:
                kept, waiting, count = _thinned([kept, *waiting], edge), [], 0
    kept = _thinned([kept, *waiting], edge)
    seen = SeenThrough(kept.astype(np.float64), len(members), config.seen_through)
    for number, (run, T) in enumerate(members):
        for origins, ends in run.stretches(T):
            seen.add_stretch(number, origins, ends)
    return seen


def _thinned(parts: Sequence[NDArray[np.float32]], edge: float) -> NDArray[np.float32]:
    points = np.concatenate(parts)
    return np.ascontiguousarray(points[first_per_voxel(points, edge)])


def _has_intensity(run: SessionRun, T: Floats) -> bool:
    return next((scan.intensity is not None for scan in run.scans(T)), True)
