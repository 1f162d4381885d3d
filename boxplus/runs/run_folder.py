"""The output folder of a run: what lies where, who may write there, and what an earlier run left (docs/output_folder.md)."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from boxplus.errors import InputError
from boxplus.formats.output import TEMPORARY_SUFFIX
from boxplus.runs.storage.folder_lock import locked_folder
from boxplus.runs.storage.output_folder import SUMMARY, doubts_of, output_folder, program_of, refuse_both, refuse_finished

PLOTS = ("trajectory.png", "status.png", "timing.png", "biases.png")
_MAP_FILE = re.compile(r"manifest\.json|journal-\d+\.bin|tiles/x[+-]\d+_y[+-]\d+_z[+-]\d+/\d+\.ply")

_SCAN_FILE = re.compile(r"-?\d+\.(pcd|ply|las|laz|e57)")


def is_map_file(inside: Path) -> bool:
    """Whether a file, by its path inside a map folder, is one of the map, a half-written one too."""
    return _MAP_FILE.fullmatch(inside.as_posix().removesuffix(TEMPORARY_SUFFIX)) is not None


@dataclass(frozen=True, slots=True)
class OdometryFolder:
    """The paths of the results that every odometry run has.

    Attributes:
        path: the folder.
    """

    path: Path

    @property
    def summary(self) -> Path:
        """Counts, timings, versions, warnings, and the state of the run."""
        return self.path / SUMMARY

    @property
    def config(self) -> Path:
        """The settings as used."""
        return self.path / "config.yaml"

    @property
    def trajectory(self) -> Path:
        """The trajectory with covariance and status; `.tum` and `.kitti.txt` lie beside it."""
        return self.path / "trajectory.csv"

    @property
    def checkpoint(self) -> Path:
        """From where a killed run can go on; gone when it has come to its end."""
        return self.path / "checkpoint.npz"

    @property
    def report(self) -> Path:
        """The report."""
        return self.path / "report.html"

    @property
    def plots(self) -> Path:
        """Folder of the pictures."""
        return self.path / "plots"

    def existing(self, more: Iterable[Path], pictures: Iterable[str]) -> Iterator[Path]:
        """Of the files that every run writes, `more` and `pictures`, those that are there, half-written ones too."""
        top = [self.summary, self.config, self.report, self.checkpoint, *more]
        top += [self.trajectory.with_name(f"trajectory.{ending}") for ending in ("tum", "kitti.txt", "csv")]
        top += [self.plots / name for name in pictures]
        for path in top:
            yield from (candidate for candidate in (path, path.with_name(path.name + TEMPORARY_SUFFIX)) if candidate.is_file())

    @contextmanager
    def locked_to_resume(self, program: str) -> Iterator[None]:
        """The folder as it is, locked while the block runs, for a run that goes on.

        Raises:
            InputError: no run to resume, one that is finished, or one of another command; another process is writing there.
        """
        if not self.checkpoint.is_file():
            refuse_finished(self.path, program)
            raise InputError(
                "the folder of a run that did not come to its end, with a checkpoint",
                f"none in {self.path}",
                "start the run without --resume; a checkpoint is written every few seconds",
            )
        other = program_of(self.summary) if self.summary.is_file() else None  # a run that was killed has none
        if other not in (None, program):
            raise InputError(
                f"a run of '{program}' to go on with",
                f"one of '{other}' in {self.path}",
                "go on with it by that command, or choose another folder with --output",
            )
        with locked_folder(self.path, program) as lock:
            lock.keep_file = False
            yield

    def holds_estimates(self) -> bool:
        """Whether the trajectory has a single row; a killed run may have written rows that its `run.json` does not count."""
        try:
            with self.trajectory.open("rb") as file:
                return sum(1 for _ in zip(file, range(2), strict=False)) > 1
        except OSError:
            return False


@dataclass(frozen=True, slots=True)
class RunFolder(OdometryFolder):
    """The paths of the results of `boxplus lio`."""

    @property
    def scans(self) -> Path:
        """One row a scan: velocity, biases, diagnosis, timing."""
        return self.path / "scans.csv"

    @property
    def tiles(self) -> Path:
        """The map in tiles."""
        return self.path / "map"

    @property
    def map_ply(self) -> Path:
        """The merged map."""
        return self.path / "map.ply"

    @property
    def map_pcd(self) -> Path:
        """The merged map, in the other format."""
        return self.path / "map.pcd"

    @property
    def scan_clouds(self) -> Path:
        """Folder of one cloud a scan, where they were asked for."""
        return self.path / "scans"

    @property
    def evaluation(self) -> Path:
        """The comparison with a ground truth, where one was given."""
        return self.path / "evaluation.json"

    def own_files(self) -> Iterator[Path]:
        """The files in the folder that a run writes."""
        yield from self.existing([self.scans, self.map_ply, self.map_pcd, self.evaluation], PLOTS)
        yield from (path for path in self.tiles.rglob("*") if path.is_file() and is_map_file(path.relative_to(self.tiles)))
        names = self.scan_clouds.glob("*")
        yield from (path for path in names if _SCAN_FILE.fullmatch(path.name.removesuffix(TEMPORARY_SUFFIX)) and path.is_file())

    def own_folders(self) -> Iterator[Path]:
        """The folders in it that a run creates, inner ones first."""
        yield from self.tiles.glob("tiles/*")
        yield from (self.tiles / "tiles", self.tiles, self.scan_clouds, self.plots)


def run_of_map(path: Path) -> RunFolder | None:
    """The run that a folder of tiles or a file is the map of; None where it lies in none, or is another one there."""
    own = Path(os.path.abspath(path))
    run = RunFolder(own.parent)
    return run if own in (run.tiles, run.map_ply, run.map_pcd) and run.summary.is_file() else None


def doubts_of_map(tiles: Path) -> list[str]:
    """Why a map folder is not to be trusted, as the run that it lies in says, in sentences; none where it lies in none."""
    run = run_of_map(tiles)
    doubts = [] if run is None else doubts_of(run.summary)[0]
    return [f"not to be trusted, as the run that wrote it says: {text}" for text in doubts]


@contextmanager
def claim_run_folder(folder: str | Path, *, overwrite: bool = False, resume: bool = False) -> Iterator[RunFolder]:
    """A folder to write a run into, locked while the block runs: new, empty, or cleared of an earlier run's own files.

    An earlier run without a single estimate is replaced, any other one with `overwrite`. What a run did not write is never
    removed. To `resume` a run, all of it stays.

    Raises:
        InputError: another process is writing there; the folder holds something else, or an earlier run and `overwrite` is
            not set; no run to resume; both are asked for.
        OutputError: it cannot be created or cleared.
    """
    refuse_both(overwrite, resume)
    run = RunFolder(Path(folder))
    if resume:
        with run.locked_to_resume("boxplus lio"):
            yield run
        return
    with output_folder(
        run.path, "boxplus lio", run.own_files, run.own_folders, overwrite=overwrite, holds_results=run.holds_estimates
    ):
        yield run
