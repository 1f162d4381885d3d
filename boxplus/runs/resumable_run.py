"""A run that writes checkpoints, and goes on from the last one after it was killed."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from boxplus.recordings.recording import EventStream
from boxplus.runs.checkpoint import Checkpoint, CheckpointWriter, cut_to_whole_rows, read_checkpoint
from boxplus.runs.estimate_statistics import EstimateStatistics
from boxplus.runs.run_facts import State
from boxplus.runs.run_folder import OdometryFolder
from boxplus.runs.run_loop import EstimateT, EventT, FactsT, Progress, RunLoop


class ResumableRun(RunLoop[EventT, EstimateT, FactsT]):
    """One run with checkpoints.

    Args:
        recording: opened; folder: claimed.
        identity: of recording and settings, see `run_identity`; with the text of the latter.
        log: file with one row for each pose, beside the trajectory.
        statistics: what is counted; progress: called after every event that was read.

    Attributes:
        resumed: how often the run has gone on.
        written_until_ns: time of the last row that is there from before; None in a new run.
    """

    def __init__(
        self,
        recording: EventStream[Any, EventT],
        folder: OdometryFolder,
        identity: dict[str, str],
        log: Path,
        statistics: EstimateStatistics,
        progress: Callable[[Progress], None],
    ) -> None:
        super().__init__(recording, folder.summary, folder.config, identity["config"], statistics, progress)
        self._results, self._identity, self._log = folder, identity, log
        self.resumed = 0
        self.written_until_ns: int | None = None

    @abstractmethod
    def snapshot(self) -> tuple[dict[str, object], dict[str, object]]:
        """What the estimator holds, and what the run holds beside it; only to be written at once."""

    @abstractmethod
    def restore(self, odometry: dict[str, Any], run: dict[str, Any]) -> None:
        """Go on from a `snapshot`."""

    def resume(self) -> None:
        """Go on from the checkpoint in the folder.

        Estimates that came after it are made again, and written where their rows are not there yet.

        Raises:
            InputError: no checkpoint, a damaged one, or one of another recording or with other settings.
        """
        checkpoint = read_checkpoint(self._results, self._identity)
        self.written_until_ns = cut_to_whole_rows(self._results, self._log, checkpoint.statistics.count)
        self.counts = checkpoint.statistics
        self.restore(checkpoint.odometry, checkpoint.run)
        self.events, self.resumed = checkpoint.events, checkpoint.resumed + 1

    def is_new(self, time_ns: int) -> bool:
        """Whether an estimate has no row yet."""
        return self.written_until_ns is None or time_ns > self.written_until_ns

    def open(self, stack: ExitStack) -> None:
        """See `RunLoop.open`."""
        self._checkpoints = CheckpointWriter(self._results.checkpoint)

    def between_events(self) -> None:
        """See `RunLoop.between_events`."""
        if self._checkpoints.is_due:
            self._checkpoints.write(self._checkpoint())

    def at_end(self, state: State) -> None:
        """See `RunLoop.at_end`."""
        if state != "finished":
            self._checkpoints.write(self._checkpoint())

    def done(self, state: State) -> None:
        """See `RunLoop.done`: until then a killed run goes on from its checkpoint, were it only to merge its map again."""
        if state == "finished":
            self._results.checkpoint.unlink(missing_ok=True)

    def _checkpoint(self) -> Checkpoint:
        odometry, run = self.snapshot()
        return Checkpoint(self._identity, self.events, self.resumed, self.counts, odometry, run)
