"""The output folder of `boxplus localize`: poses in the map, and the odometry's own run inside (docs/output_folder.md)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from boxplus.runs.run_folder import OdometryFolder, RunFolder
from boxplus.runs.storage.output_folder import output_folder

PROGRAM = "boxplus localize"


@dataclass(frozen=True, slots=True)
class LocalizationFolder(OdometryFolder):
    """The paths of the results of `boxplus localize`; the trajectory is in the map's frame."""

    @property
    def log(self) -> Path:
        """One row a scan: status, share of matched points, innovation."""
        return self.path / "localization.csv"

    @property
    def searches(self) -> Path:
        """Every place that was looked at, and why it was believed or not."""
        return self.path / "searches.csv"

    @property
    def odometry(self) -> RunFolder:
        """The run of the odometry, as `boxplus lio` leaves it."""
        return RunFolder(self.path / "odometry")

    def own_files(self) -> Iterator[Path]:
        """The files in the folder that a run writes."""
        yield from self.existing([self.log, self.searches], ())
        yield from self.odometry.own_files()

    def own_folders(self) -> Iterator[Path]:
        """The folders in it that a run creates, inner ones first."""
        yield from self.odometry.own_folders()
        yield self.odometry.path


@contextmanager
def claim_localization_folder(folder: str | Path, *, overwrite: bool = False) -> Iterator[LocalizationFolder]:
    """A folder to write a run into, locked while the block runs; see `claim_run_folder`.

    Raises:
        InputError: another process is writing there; the folder holds something else, or an earlier run and `overwrite` is not
            set.
        OutputError: it cannot be created or cleared.
    """
    own = LocalizationFolder(Path(folder))
    with output_folder(
        own.path, PROGRAM, own.own_files, own.own_folders, overwrite=overwrite, holds_results=own.odometry.holds_estimates
    ):
        yield own
