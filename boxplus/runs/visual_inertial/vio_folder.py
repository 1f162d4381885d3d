"""The output folder of `boxplus vio`: what lies where, and who may write there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from boxplus.runs.output_folder import output_folder
from boxplus.runs.run_folder import OdometryFolder

PLOTS = ("trajectory.png", "tracked.png", "biases.png")


@dataclass(frozen=True, slots=True)
class VioFolder(OdometryFolder):
    """The paths of the results of `boxplus vio`."""

    @property
    def frames(self) -> Path:
        """One row a frame: velocity, biases, corners, diagnosis, timing."""
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
        yield from self.existing([self.frames, self.landmarks, self.evaluation], PLOTS)


@contextmanager
def claim_vio_folder(folder: str | Path, *, overwrite: bool = False) -> Iterator[VioFolder]:
    """A folder to write a run into, locked while the block runs; see `output_folder`.

    Raises:
        InputError: another process is writing there; the folder holds something else, or an earlier run and `overwrite` is not
            set.
        OutputError: it cannot be created or cleared.
    """
    run = VioFolder(Path(folder))
    with output_folder(
        run.path, "boxplus vio", run.own_files, lambda: [run.plots], overwrite=overwrite, holds_results=run.holds_estimates
    ):
        yield run
