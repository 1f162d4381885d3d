"""`boxplus map update`: a joint map goes on with further runs, or stays as it is: none met it, one would go, it is in doubt."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from boxplus.errors import InputError
from boxplus.runs.sessions.config import MergeConfig
from boxplus.runs.sessions.folder import ClaimedMerge, MergeFolder, claim_joint_map
from boxplus.runs.sessions.frame import refuse_another_frame
from boxplus.runs.sessions.joined import doubts_of_joining
from boxplus.runs.sessions.merge_run import MergeResult, merge_runs
from boxplus.runs.sessions.repeated import refuse_repeated
from boxplus.runs.sessions.session_run import open_session_run, session_names
from boxplus.runs.sessions.summary import MergeSummary
from boxplus.runs.settings_file import load_settings
from boxplus.systems.sessions.encounter import Meeting
from boxplus.systems.sessions.sessions import SessionAlignment, align_sessions


@dataclass(frozen=True, slots=True, eq=False)
class UpdateResult:
    """What became of a joint map.

    Attributes:
        merged: what is in the folder now; None where it was left as it was.
        alignment: where all sessions are, the map's world first, the new ones last.
        left_because: texts of what kept the map as it was.
        doubts: what speaks against the new runs in the map; it is left as it was unless these were accepted.
    """

    merged: MergeResult | None
    alignment: SessionAlignment
    left_because: list[str]
    doubts: list[str]


def update_map(
    merged: str | Path,
    folders: Sequence[str | Path],
    *,
    accept_doubts: bool = False,
    progress: Callable[[Meeting], None] | None = None,
) -> UpdateResult:
    """Join further runs with a joint map, with its own settings and in its frame: the sessions that it has are placed anew.

    The map that is there stays whole until the new one is. Where none of the runs met it, it is not touched; nor where one of its
    own sessions would no longer be part of it: the new runs contradict it then, or one of its runs has been replaced; nor where
    something speaks against a new run in it, which may lie at another place of the same kind.

    Args:
        merged: output folder of 'boxplus map merge', whose runs are where they were.
        folders: output folders of finished runs of 'boxplus slam', later than those in the map.
        accept_doubts: replace it all the same where something speaks against a new run in it.
        progress: called with every pair of sessions.

    Raises:
        InputError: no joint map; a run of it that is gone, or another one in the place of that which gives it its frame; a run
            that is in it already; another process that is at it; what `merge_runs` refuses.
        OutputError: the disk is full; the earlier map stays whole.
    """
    with claim_joint_map(merged) as (claimed, before):
        return _updated(claimed, before, folders, accept_doubts, progress)


def _updated(
    claimed: ClaimedMerge,
    before: MergeSummary,
    folders: Sequence[str | Path],
    accept_doubts: bool,
    progress: Callable[[Meeting], None] | None,
) -> UpdateResult:
    own = MergeFolder(claimed.path)
    known = [Path(session.run) for session in before.joined]
    if not known:
        raise InputError("a joint map", f"{own.path}, in which no two runs met", "use 'boxplus map merge' with all runs")
    if gone := [path for path in known if not path.is_dir()]:
        raise InputError(f"the runs that {own.path} was made of", f"nothing at {gone[0]}", "put it back, or merge what is there")
    more = [Path(folder) for folder in folders]
    if again := {path.resolve() for path in more} & {path.resolve() for path in known}:
        raise InputError("runs that are not in the map", f"{sorted(again)[0]}, which is", "leave it out")
    paths = [*known, *more]
    config = load_settings(MergeConfig, own.config)
    runs = [open_session_run(path, name) for path, name in zip(paths, session_names(paths), strict=True)]
    refuse_repeated({run.session.name: run.identity for run in runs})
    refuse_another_frame(own.path, before.frame, runs[0])
    sessions = [run.session for run in runs]
    alignment = align_sessions(sessions, config.sessions, progress=progress)
    # Runs that met each other only may be more than the map has: that is no reason to leave it.
    own_world = next(world for world in alignment.worlds if 0 in world.members)
    alignment = replace(alignment, worlds=[own_world, *(world for world in alignment.worlds if world is not own_world)])
    if not set(range(len(known))) < set(own_world.members):
        return UpdateResult(None, alignment, _why_left_alone(alignment, len(more)), [])
    doubts = doubts_of_joining(alignment, [run.doubt for run in runs], held=len(known))
    if doubts and not accept_doubts:
        return UpdateResult(None, alignment, [], doubts)
    result = merge_runs(
        paths, claimed, config, remove_dynamic=before.remove_dynamic,
        accept_doubts=accept_doubts, accepted=before.accepted, align=lambda _: alignment,
    )  # fmt: skip
    return UpdateResult(result, alignment, [], doubts)


def _why_left_alone(alignment: SessionAlignment, more: int) -> list[str]:
    """What keeps a map as it is, a text for each session: of so many new runs, which come last, or of its own that would go."""
    known = len(alignment.sessions) - more
    members = alignment.worlds[0].members
    lost = [number for number in range(known) if number not in members]
    said = []
    for number in lost or range(known, known + more):
        name, what = alignment.sessions[number].name, "would no longer be part of the map" if lost else "apart"
        said.append(f"{name}: {what}" + "".join(f"\n  {text}" for text in alignment.why_apart(number)))
    return said
