"""`boxplus map update`: a joint map goes on with further runs; where none of them met it, it stays as it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from boxplus.errors import InputError
from boxplus.runs.sessions.config import MergeConfig
from boxplus.runs.sessions.folder import MergeFolder
from boxplus.runs.sessions.merge_run import MergeResult, merge_runs
from boxplus.runs.sessions.repeated import refuse_repeated
from boxplus.runs.sessions.session_run import open_session_run, session_names
from boxplus.runs.sessions.summary import read_merge_summary
from boxplus.runs.settings_file import load_settings
from boxplus.systems.sessions.encounter import Meeting
from boxplus.systems.sessions.sessions import SessionAlignment, align_sessions


def update_map(
    merged: str | Path, folders: Sequence[str | Path], *, progress: Callable[[Meeting], None] | None = None
) -> tuple[MergeResult | None, SessionAlignment]:
    """Join further runs with a joint map, with its own settings and in its frame: the sessions that it has are placed anew.

    The map that is there stays whole until the new one is; where none of the runs met it, it is not touched.

    Args:
        merged: output folder of 'boxplus map merge', whose runs are where they were.
        folders: output folders of finished runs of 'boxplus slam', later than those in the map.
        progress: called with every pair of sessions.

    Returns:
        What is in the folder now, None where it was left as it was; and where all sessions are.

    Raises:
        InputError: no joint map; a run of it that is gone; a run that is in it already; what `merge_runs` refuses.
        OutputError: the disk is full; the earlier map stays whole.
    """
    own = MergeFolder(Path(merged))
    before = read_merge_summary(own.summary)
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
    sessions = [run.session for run in runs]
    alignment = align_sessions(sessions, config.sessions, progress=progress)
    world = alignment.worlds[0]
    if 0 not in world.members or all(number < len(known) for number in world.members):
        return None, alignment
    result = merge_runs(paths, own.path, config, remove_dynamic=before.remove_dynamic, overwrite=True, align=lambda _: alignment)
    return result, alignment
