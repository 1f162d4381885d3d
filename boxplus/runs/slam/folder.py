"""The output folder of `boxplus slam`: corrected results, and the odometry's own in a folder inside (docs/output_folder.md)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from boxplus.errors import InputError
from boxplus.formats.output import EARLIER_SUFFIX, TEMPORARY_SUFFIX
from boxplus.runs.lidar_inertial.earlier_run import Standing, standing
from boxplus.runs.run_folder import RunFolder, is_map_file
from boxplus.runs.storage.folder_lock import locked_folder
from boxplus.runs.storage.output_folder import output_folder, program_of, refuse_both, refuse_finished, state_of

PROGRAM = "boxplus slam"
_NOT_ENDED = ("running", "failed")  # one that was interrupted in good order has left a checkpoint, or has lost it since
_LOCAL_MAP_FILE = re.compile(r"(\d{6,}|graph)\.npz")


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
        """Registered scans, each with its pose along the odometry: what a map of several sessions is made of."""
        return self.path / "scans.spool"

    @property
    def local_maps(self) -> Path:
        """Folder of the local maps, one file each, and of the graph."""
        return self.path / "local_maps"

    @property
    def graph(self) -> Path:
        """Where closed loops put the local maps, and every loop, for programs."""
        return self.local_maps / "graph.npz"

    @property
    def odometry(self) -> RunFolder:
        """The run of the odometry, as `boxplus lio` leaves it."""
        return RunFolder(self.path / "odometry")

    @contextmanager
    def locked_to_resume(self, program: str) -> Iterator[None]:
        """See `OdometryFolder.locked_to_resume`; there is something to do where the odometry is finished, but not the run."""
        if not self.odometry.checkpoint.is_file():
            refuse_finished(self.path, program)
        if not self.can_go_on():
            raise InputError(
                "the folder of a run of 'boxplus slam' that did not come to its end, with a checkpoint in odometry/",
                f"none in {self.path}",
                "start the run without --resume; a checkpoint is written every few seconds",
            )
        with locked_folder(self.path, program) as lock:
            lock.keep_file = False
            yield

    def odometry_standing(self) -> Standing:
        """How far the odometry came.

        Raises:
            InputError: its `run.json` cannot be read.
        """
        try:
            return standing(self.odometry)
        except InputError as error:
            raise InputError(
                error.expected, error.got, "put the file of that run back, or replace the whole run with --overwrite"
            ) from error

    def can_go_on(self) -> bool:
        """Whether a run left something to go on with: a checkpoint, or an odometry that is finished.

        Raises:
            InputError: see `odometry_standing`.
        """
        return self.odometry.checkpoint.is_file() or self.odometry_standing() == "finished"

    def stopped_before_its_first_checkpoint(self) -> bool:
        """Whether a run was begun here, neither ended nor left anything to go on with, and so can only begin anew.

        Raises:
            InputError: see `odometry_standing`.
        """
        if not self.summary.is_file() or program_of(self.summary) != PROGRAM or state_of(self.summary) not in _NOT_ENDED:
            return False
        found = self.odometry_standing()
        if found == "not begun":  # but what is there without a summary of this odometry may be all of one
            return not (self.odometry.summary.is_file() or self.odometry.holds_estimates())
        return found == "stopped before its first checkpoint"

    def own_files(self) -> Iterator[Path]:
        """See `RunFolder.own_files`."""
        yield from RunFolder.own_files(self)
        yield from self.existing([self.loops, self.georeference, self.gnss, self.trajectory_utm, self.spool], ())
        for tiles in self._half_replaced():
            yield from (path for path in tiles.rglob("*") if path.is_file() and is_map_file(path.relative_to(tiles)))
        yield from (path for path in self.local_maps.glob("*.npz*") if is_local_map_file(path))
        yield from self.odometry.own_files()

    def own_folders(self) -> Iterator[Path]:
        """See `RunFolder.own_folders`."""
        yield from self.odometry.own_folders()
        yield from (self.odometry.path, self.local_maps)
        for tiles in self._half_replaced():
            yield from (*tiles.glob("tiles/*"), tiles / "tiles", tiles)
        yield from RunFolder.own_folders(self)

    def _half_replaced(self) -> tuple[Path, Path]:
        """Where a killed run may have left the corrected map that it was writing, or the one before."""
        tiles = self.tiles
        return tiles.with_name(tiles.name + TEMPORARY_SUFFIX), tiles.with_name(tiles.name + EARLIER_SUFFIX)


def is_local_map_file(path: Path) -> bool:
    """Whether a file in the folder of local maps is one that a run writes, a half-written one too."""
    return _LOCAL_MAP_FILE.fullmatch(path.name.removesuffix(TEMPORARY_SUFFIX)) is not None


@contextmanager
def claim_slam_folder(folder: str | Path, *, overwrite: bool = False, resume: bool = False) -> Iterator[SlamFolder]:
    """A folder to write a run into, locked while the block runs; see `claim_run_folder`.

    To `resume` a run that was killed before there was anything to go on with, its folder is cleared, and the run begins anew:
    `can_go_on` of what is yielded tells. Where anything of a finished odometry stands, all of it stays.

    Raises:
        InputError: another process is writing there; the folder holds something else, or an earlier run and `overwrite` is not
            set; no run to resume, or one whose `run.json` cannot be read; both are asked for.
        OutputError: it cannot be created or cleared.
    """
    refuse_both(overwrite, resume)
    slam = SlamFolder(Path(folder))
    begins_anew = resume and slam.stopped_before_its_first_checkpoint()
    if resume and not begins_anew:
        with slam.locked_to_resume(PROGRAM):
            yield slam
        return

    def holds_results() -> bool:  # asked again under the lock: another process may have gone on meanwhile
        return not slam.stopped_before_its_first_checkpoint() if begins_anew else slam.odometry.holds_estimates()

    with output_folder(slam.path, PROGRAM, slam.own_files, slam.own_folders, overwrite=overwrite, holds_results=holds_results):
        yield slam
