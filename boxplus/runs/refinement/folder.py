"""The output folder of `boxplus refine` (docs/output_folder.md)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from boxplus.errors import InputError
from boxplus.runs.run_folder import RunFolder
from boxplus.runs.storage.output_folder import output_folder

PROGRAM = "boxplus refine"


@dataclass(frozen=True, slots=True)
class RefineFolder(RunFolder):
    """The paths of the results of `boxplus refine`; trajectory and map are the refined ones."""

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


@contextmanager
def claim_refine_folder(folder: str | Path, run: str | Path, *, overwrite: bool = False) -> Iterator[RefineFolder]:
    """A folder to write a refined run into, locked while the block runs; see `claim_run_folder`.

    Args:
        run: the folder of the run that is refined, which is not written into.

    Raises:
        InputError: it is the folder of the run itself, or lies in it; another process is writing there; the folder holds
            something else, or an earlier run and `overwrite` is not set.
        OutputError: it cannot be created or cleared.
    """
    own = RefineFolder(Path(folder))
    if own.path.resolve().is_relative_to(Path(run).resolve()):
        raise InputError("another folder than that of the run", f"{own.path}", "choose one beside it with --output")
    with output_folder(own.path, PROGRAM, own.own_files, own.own_folders, overwrite=overwrite, holds_results=own.holds_estimates):
        yield own
