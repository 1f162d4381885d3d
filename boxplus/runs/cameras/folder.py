"""The output folder of a run with cameras: what lies where, and who may write there."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from boxplus.runs.run_folder import OdometryFolder
from boxplus.runs.storage.output_folder import output_folder, refuse_both


@dataclass(frozen=True, slots=True)
class CameraRunFolder(OdometryFolder, ABC):
    """The paths of the results of a run with cameras."""

    @property
    @abstractmethod
    def program(self) -> str:
        """Who writes here."""

    @property
    @abstractmethod
    def pictures(self) -> tuple[str, ...]:
        """Names of the pictures in `plots`."""

    @property
    def frames(self) -> Path:
        """One row a frame: what an estimate says besides its pose, diagnosis, timing."""
        return self.path / "frames.csv"

    @property
    def landmarks(self) -> Path:
        """The sparse map."""
        return self.path / "landmarks.ply"

    @property
    def evaluation(self) -> Path:
        """The comparison with a ground truth, where one was given."""
        return self.path / "evaluation.json"

    def own_files(self) -> Iterator[Path]:
        """The files in the folder that a run writes."""
        yield from self.existing([self.frames, self.landmarks, self.evaluation], self.pictures)


@dataclass(frozen=True, slots=True)
class VioFolder(CameraRunFolder):
    """The paths of the results of `boxplus vio`."""

    @property
    def program(self) -> str:
        """See `CameraRunFolder.program`."""
        return "boxplus vio"

    @property
    def pictures(self) -> tuple[str, ...]:
        """See `CameraRunFolder.pictures`."""
        return ("trajectory.png", "tracked.png", "biases.png")

    @property
    def lines(self) -> Path:
        """The lines of the map, where the run followed some."""
        return self.path / "lines.csv"

    def own_files(self) -> Iterator[Path]:
        """The files in the folder that a run writes."""
        yield from self.existing([self.frames, self.landmarks, self.lines, self.evaluation], self.pictures)


@dataclass(frozen=True, slots=True)
class DirectFolder(CameraRunFolder):
    """The paths of the results of `boxplus vo`."""

    @property
    def program(self) -> str:
        """See `CameraRunFolder.program`."""
        return "boxplus vo"

    @property
    def pictures(self) -> tuple[str, ...]:
        """See `CameraRunFolder.pictures`."""
        return ("trajectory.png", "residuals.png")


FolderT = TypeVar("FolderT", bound=CameraRunFolder)


@contextmanager
def claim_camera_folder(run: FolderT, *, overwrite: bool = False, resume: bool = False) -> Iterator[FolderT]:
    """A folder to write a run into, locked while the block runs; see `output_folder`. To `resume` a run, all of it stays.

    Raises:
        InputError: another process is writing there; the folder holds something else, or an earlier run and `overwrite` is not
            set; no run to resume; both are asked for.
        OutputError: it cannot be created or cleared.
    """
    refuse_both(overwrite, resume)
    if resume:
        with run.locked_to_resume(run.program):
            yield run
        return
    with output_folder(
        run.path, run.program, run.own_files, lambda: [run.plots], overwrite=overwrite, holds_results=run.holds_estimates
    ):
        yield run
