"""The output folder of `boxplus refine` (docs/output_folder.md)."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from boxplus.errors import InputError
from boxplus.formats.output import output_error, replaced_folder
from boxplus.runs.run_folder import RunFolder
from boxplus.runs.storage.folder_lock import LOCK, locked_beside, put_back_left
from boxplus.runs.storage.output_folder import output_folder, program_of, state_of

PROGRAM = "boxplus refine"
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RefineFolder(RunFolder):
    """The paths of the results of `boxplus refine`; trajectory and map are the refined ones.

    Attributes:
        takes_place_of: the earlier refinement that stays until this one has come to its end; None: there is none.
    """

    takes_place_of: Path | None = None

    @property
    def points(self) -> Path:
        """Points of the scans while the run goes on; gone afterwards."""
        return self.path / "points.spool"

    @property
    def georeference(self) -> Path:
        """Where on the Earth the map is; only of a run that was laid there."""
        return self.path / "georeference.yaml"

    def own_files(self) -> Iterator[Path]:
        """See `RunFolder.own_files`."""
        yield from RunFolder.own_files(self)
        yield from self.existing([self.points, self.georeference], ())


class _NotFinishedError(Exception):
    """A refinement did not come to its end; it never leaves this file."""


@contextmanager
def claim_refine_folder(folder: str | Path, run: str | Path, *, overwrite: bool = False) -> Iterator[RefineFolder]:
    """A folder to write a refined run into, locked while the block runs; see `claim_run_folder`.

    With `overwrite`, a refinement that came to its end stays whole until the new one has: what is yielded is a folder beside it
    then, which takes its place at the end of the block, together with what others have put there.

    Args:
        run: the folder of the run that is refined, which is not written into.

    Raises:
        InputError: it is the folder of the run itself, or lies in it; another process is writing there; the folder holds
            something else, what cannot be kept, or an earlier run and `overwrite` is not set.
        OutputError: it cannot be created, cleared or replaced.
    """
    own = RefineFolder(Path(folder).resolve())  # what takes the place of a link would leave the folder that it leads to
    if own.path.is_relative_to(Path(run).resolve()):
        raise InputError("another folder than that of the run", f"{own.path}", "choose one beside it with --output")
    put_back_left(own.path, PROGRAM)
    if overwrite and _is_finished(own):
        with locked_beside(own.path, PROGRAM), _replaced(own) as made:
            yield made
        return
    with output_folder(own.path, PROGRAM, own.own_files, own.own_folders, overwrite=overwrite, holds_results=own.holds_estimates):
        yield own


@contextmanager
def _replaced(own: RefineFolder) -> Iterator[RefineFolder]:
    """A folder beside an earlier refinement, which takes its place when the new one has come to its end."""
    for path in _of_others(own):  # what cannot be kept would show when all is computed
        if not path.is_symlink() and not (path.is_file() and os.access(path, os.R_OK)):
            raise InputError(
                "files beside an earlier refinement that can be read", f"{path}", "move it away, or choose another folder"
            )
    try:
        with replaced_folder(own.path) as path:
            made = RefineFolder(path, takes_place_of=own.path)
            yield made
            if not _is_finished(made):
                raise _NotFinishedError
            _keep_what_others_put(own, path)
    except BaseException as error:
        _log.warning("the earlier refinement in %s stays as it was", own.path)
        if not isinstance(error, _NotFinishedError):
            raise


def _is_finished(own: RefineFolder) -> bool:
    return own.summary.is_file() and program_of(own.summary) == PROGRAM and state_of(own.summary) == "finished"


def _of_others(own: RefineFolder) -> list[Path]:
    """What is there that a refinement does not write; of folders, what is in them."""
    written = {own.path / LOCK, *own.own_files()}
    return [path for path in own.path.rglob("*") if path not in written and (path.is_symlink() or not path.is_dir())]


def _is_linked(path: Path, there: Path) -> bool:
    try:
        os.link(path, there)
    except (OSError, NotImplementedError):  # not on every file system, nor of every owner's files
        return False
    return True


def _keep_what_others_put(own: RefineFolder, into: Path) -> None:
    """The same files where links can be made: somebody may be writing to one of them."""
    try:
        for path in _of_others(own):
            there = into / path.relative_to(own.path)
            there.parent.mkdir(parents=True, exist_ok=True)
            if path.is_symlink() or not _is_linked(path, there):
                shutil.copy2(path, there, follow_symlinks=False)
    except OSError as error:
        raise output_error(into, error) from error
