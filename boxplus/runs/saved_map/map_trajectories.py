"""The trajectories that a map was made on: that of a run, or those of all sessions of a joint map."""

from __future__ import annotations

from pathlib import Path

from boxplus.formats.trajectory import Trajectory, read_trajectory
from boxplus.runs.run_folder import RunFolder
from boxplus.runs.sessions.folder import PROGRAM, MergeFolder
from boxplus.runs.storage.output_folder import program_of


def map_trajectories(folder: Path) -> list[Trajectory]:
    """Of an output folder, in the frame of its map; none where it has none.

    Raises:
        InputError: one that cannot be read.
    """
    run, joint = RunFolder(folder), MergeFolder(folder)
    if run.trajectory.is_file():
        return [read_trajectory(run.trajectory)]
    if joint.summary.is_file() and program_of(joint.summary) == PROGRAM:
        return [read_trajectory(path) for path in sorted(joint.sessions.glob("*.csv"))]
    return []
