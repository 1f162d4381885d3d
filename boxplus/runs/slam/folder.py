"""The output folder of `boxplus slam`: corrected results, and the odometry's own in a folder inside (docs/output_folder.md)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from boxplus.runs.output_folder import output_folder
from boxplus.runs.run_folder import RunFolder

PROGRAM = "boxplus slam"


@dataclass(frozen=True, slots=True)
class SlamFolder(RunFolder):
    """The paths of the results of `boxplus slam`; trajectory and map are the corrected ones."""

    @property
    def loops(self) -> Path:
        """Every loop that was looked at, and why it was believed or not."""
        return self.path / "loops.csv"

    @property
    def georeference(self) -> Path:
        """Where on the Earth the map is; only with positions by satellite."""
        return self.path / "georeference.yaml"

    @property
    def gnss(self) -> Path:
        """Every fix that was compared with the odometry."""
        return self.path / "gnss.csv"

    @property
    def trajectory_utm(self) -> Path:
        """The trajectory in UTM, where it was asked for."""
        return self.path / "trajectory_utm.csv"

    @property
    def spool(self) -> Path:
        """Registered scans while the run goes on; gone afterwards."""
        return self.path / "scans.spool"

    @property
    def odometry(self) -> RunFolder:
        """The run of the odometry, as `boxplus lio` leaves it."""
        return RunFolder(self.path / "odometry")

    def own_files(self) -> Iterator[Path]:
        """See `RunFolder.own_files`."""
        yield from RunFolder.own_files(self)
        yield from self.existing([self.loops, self.georeference, self.gnss, self.trajectory_utm, self.spool], ())
        yield from self.odometry.own_files()

    def own_folders(self) -> Iterator[Path]:
        """See `RunFolder.own_folders`."""
        yield from self.odometry.own_folders()
        yield self.odometry.path
        yield from RunFolder.own_folders(self)


@contextmanager
def claim_slam_folder(folder: str | Path, *, overwrite: bool = False) -> Iterator[SlamFolder]:
    """A folder to write a run into, locked while the block runs; see `claim_run_folder`.

    Raises:
        InputError: another process is writing there; the folder holds something else, or an earlier run and `overwrite` is not
            set.
        OutputError: it cannot be created or cleared.
    """
    slam = SlamFolder(Path(folder))
    with output_folder(
        slam.path, PROGRAM, slam.own_files, slam.own_folders, overwrite=overwrite, holds_results=slam.odometry.holds_estimates
    ):
        yield slam
