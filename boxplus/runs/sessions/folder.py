"""The output folder of `boxplus map merge` (docs/output_folder.md)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from boxplus.errors import InputError
from boxplus.formats.output import put_back, replaced_folder
from boxplus.runs.run_folder import is_map_file
from boxplus.runs.sessions.summary import MergeSummary, read_merge_summary
from boxplus.runs.storage.folder_lock import locked_beside
from boxplus.runs.storage.output_folder import SUMMARY, program_of

PROGRAM = "boxplus map merge"
_OWN = re.compile(
    r"run\.json|config\.yaml|encounters\.csv|changes\.csv|map\.ply|removed\.ply|sessions/[^/]+\.(csv|tum|kitti\.txt)"
)


@dataclass(frozen=True, slots=True)
class MergeFolder:
    """The paths of the results."""

    path: Path

    @property
    def summary(self) -> Path:
        """Facts: sessions, where they are, what is apart and why."""
        return self.path / SUMMARY

    @property
    def config(self) -> Path:
        """The settings as used."""
        return self.path / "config.yaml"

    @property
    def encounters(self) -> Path:
        """Every pair of local maps of two sessions that was looked at."""
        return self.path / "encounters.csv"

    @property
    def changes(self) -> Path:
        """What vanished and appeared between sessions."""
        return self.path / "changes.csv"

    @property
    def tiles(self) -> Path:
        """The joint map in tiles."""
        return self.path / "map"

    @property
    def map_ply(self) -> Path:
        """The joint map in one file."""
        return self.path / "map.ply"

    @property
    def removed(self) -> Path:
        """Points that were seen through."""
        return self.path / "removed.ply"

    @property
    def sessions(self) -> Path:
        """Folder of the trajectories in the joint world, one of each session."""
        return self.path / "sessions"


@dataclass(frozen=True, slots=True)
class ClaimedMerge:
    """The folder of a merge while no other process writes there; it may not exist yet."""

    path: Path

    @property
    def has_joint_map(self) -> bool:
        """Whether an earlier merge left a joint map there."""
        return MergeFolder(self.path).tiles.is_dir()

    @contextmanager
    def replaced(self) -> Iterator[MergeFolder]:
        """A folder to write into, which takes the place of the claimed one when the block ends well; until then that stays whole.

        Raises:
            OutputError: it cannot be created, cleared or renamed.
        """
        with replaced_folder(self.path) as made:
            yield MergeFolder(made)


@contextmanager
def claim_merge_folder(folder: str | Path, *, overwrite: bool = False) -> Iterator[ClaimedMerge]:
    """A folder for a joint map, locked while the block runs: from the look at what is there on, until it is replaced.

    Raises:
        InputError: another process is writing there; the folder holds something else, or an earlier merge and `overwrite` is not
            set.
        OutputError: the folder that holds it cannot be written.
    """
    path = Path(folder).resolve()  # what takes the place of a link would leave the map that it leads to as it was
    with locked_beside(path, PROGRAM):
        put_back(path)
        if path.is_dir():
            _refuse_what_is_there(path, overwrite)
        yield ClaimedMerge(path)


@contextmanager
def claim_joint_map(folder: str | Path) -> Iterator[tuple[ClaimedMerge, MergeSummary]]:
    """The folder of an earlier merge, which is to be replaced, locked while the block runs; and what is known of it.

    Raises:
        InputError: no results of 'boxplus map merge', or other files beside them; another process is writing there.
        OutputError: the folder that holds it cannot be written.
    """
    path = Path(folder).resolve()
    if not path.parent.is_dir():
        read_merge_summary(path / SUMMARY)  # refuses what is not there, before a lock makes folders for it
    with locked_beside(path, PROGRAM):
        put_back(path)
        before = read_merge_summary(path / SUMMARY)
        if others := [name for name in _files(path) if not _is_own(name)]:
            raise InputError("a joint map and nothing else", f"{path / others[0]}", "move it away: the whole folder is replaced")
        yield ClaimedMerge(path), before


def _refuse_what_is_there(path: Path, overwrite: bool) -> None:
    names = _files(path)
    if not names:
        return
    is_own = (path / SUMMARY).is_file() and program_of(path / SUMMARY) == PROGRAM
    if not is_own or not all(map(_is_own, names)):
        raise InputError("a new or empty output folder", f"other files in {path}", "choose another folder with --output")
    if not overwrite:
        raise InputError(
            "a new or empty output folder", f"the results of an earlier merge in {path}",
            "choose another folder with --output, or add --overwrite to replace them",
        )  # fmt: skip


def _files(path: Path) -> list[Path]:
    return [file.relative_to(path) for file in path.rglob("*") if not file.is_dir()]


def _is_own(name: Path) -> bool:
    """Whether a merge writes a file of this name, relative to its folder."""
    return bool(_OWN.fullmatch(name.as_posix())) or (name.parts[0] == "map" and is_map_file(Path(*name.parts[1:])))
