"""The loop of every odometry run: events in, estimates to disk at once, and a `run.json` that always says how far it came."""

from __future__ import annotations

import functools
import platform
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, Generic, TypeVar

import boxplus
from boxplus._jit import on_compilation
from boxplus.errors import BoxplusError, InputError, OutputError
from boxplus.formats.output import atomic_file
from boxplus.recordings.recording import EventStream
from boxplus.runs.estimate_statistics import EstimateStatistics
from boxplus.runs.run_facts import RunFacts, State

_SUMMARY_EVERY_S = 2.0

FactsT = TypeVar("FactsT", bound=RunFacts)
EventT = TypeVar("EventT")
EstimateT = TypeVar("EstimateT")


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a run is.

    Attributes:
        share: of the recording, 0 to 1.
        count: estimates so far; 0 in stages that make none.
        unit: what one is for (`scans`, `frames`).
        status: of the last one, or "starting".
        compiling: name of the kernel that is being compiled, or None.
        stage: what goes on: "odometry", "merging the map", "finding planes" …
    """

    share: float
    count: int
    unit: str
    status: str
    compiling: str | None = None
    stage: str = "odometry"


class RunLoop(ABC, Generic[EventT, EstimateT, FactsT]):
    """One run: its clock, its counts, and what becomes of it. A kind of run says what to do with events and estimates.

    Args:
        recording: opened.
        summary_path, config_path: of `run.json` and `config.yaml`.
        config: text of the latter.
        statistics: what is counted.
        progress: called after every event that was read.
    """

    def __init__(
        self,
        recording: EventStream[Any, EventT],
        summary_path: Path,
        config_path: Path,
        config: str,
        statistics: EstimateStatistics,
        progress: Callable[[Progress], None],
    ) -> None:
        self.recording = recording
        self.summary_path, self.config_path, self.config_text = summary_path, config_path, config
        self.counts = statistics
        self.progress = progress
        self.started = datetime.now(UTC)
        self.began = time.perf_counter()
        self.ended: float | None = None
        self.seconds = dict.fromkeys(("reading", "odometry", "writing"), 0.0)
        self.events = 0
        self.compiled = 0
        self.stage, self.status = "odometry", "starting"
        self._summary_due = 0.0

    @abstractmethod
    def open(self, stack: ExitStack) -> None:
        """Open the files that estimates go to."""

    @abstractmethod
    def push(self, event: EventT) -> list[EstimateT]:
        """One event through the odometry."""

    @abstractmethod
    def flush(self) -> list[EstimateT]:
        """What the odometry still holds, at the end of the recording."""

    @abstractmethod
    def keep(self, estimate: EstimateT) -> None:
        """Write one estimate, and count it."""

    @abstractmethod
    def summarize(self, state: State, error: str | None) -> FactsT:
        """The facts as they are."""

    @abstractmethod
    def nothing_found(self) -> InputError:
        """Why there is no estimate at the end of the recording."""

    def between_events(self) -> None:
        """After an event, before the next one."""

    def at_end(self, state: State) -> None:
        """The last event was read, or the run was asked to stop; files are still open."""

    def finish(self) -> None:
        """All files are closed; what remains to be made of them."""

    def done(self, state: State) -> None:
        """Everything is written, and `run.json` says so."""

    def execute(self, should_stop: Callable[[], bool]) -> FactsT:
        """Everything, and the facts of it."""
        with atomic_file(self.config_path) as file:
            file.write(self.config_text.encode())
        self.write_summary("running")
        try:
            state = self._process(should_stop)
            if state == "finished" and not self.counts.count:
                raise self.nothing_found()
            self.finish()
        except BaseException as problem:
            named = str(problem) if isinstance(problem, BoxplusError) else f"{type(problem).__name__}: {problem}"
            with suppress(OutputError):  # the disk may be full; then the facts of a moment ago stay
                if isinstance(problem, KeyboardInterrupt):
                    self.write_summary("interrupted")
                else:
                    self.write_summary("failed", named)
            raise
        summary = self.write_summary(state)
        self.done(state)
        return summary

    def _process(self, should_stop: Callable[[], bool]) -> State:
        """Every event through the odometry, every estimate to disk."""
        with ExitStack() as stack:
            stack.enter_context(on_compilation(self._on_compilation))
            self.open(stack)
            events = iter(self.recording)
            for _ in range(self.events):
                next(events, None)
            state: State = "interrupted"
            while not should_stop():
                began = time.perf_counter()
                event = next(events, None)
                read = time.perf_counter()
                self.seconds["reading"] += read - began
                estimates = self.flush() if event is None else self.push(event)
                self.seconds["odometry"] += time.perf_counter() - read
                for estimate in estimates:
                    self.keep(estimate)
                self.show_progress()
                if event is None:
                    state = "finished"
                    break
                self.events += 1
                self.between_events()
                if time.perf_counter() > self._summary_due:
                    self.write_summary("running")
            self.ended = time.perf_counter()
            self.at_end(state)
        return state

    def write_summary(self, state: State, error: str | None = None) -> FactsT:
        """Write `run.json` as things are."""
        summary = self.summarize(state, error)
        summary.write(self.summary_path)
        self._summary_due = time.perf_counter() + _SUMMARY_EVERY_S
        return summary

    def show_progress(self, compiling: str | None = None) -> None:
        """Tell how far the run is."""
        count, unit = self.counts.count, self.counts.unit
        self.progress(Progress(self.recording.progress, count, unit, self.status, compiling, self.stage))

    def real_time_factor(self) -> float:
        """Sensor time by the time of the run until its last estimate, reading included."""
        return self.counts.duration_s / ((self.ended or time.perf_counter()) - self.began)

    def _on_compilation(self, kernel: str) -> None:
        self.compiled += 1
        self.show_progress(kernel)


@functools.cache
def versions(*packages: str) -> dict[str, str]:
    """Of boxplus, Python, the platform, and what `packages` are installed."""
    found = {"boxplus": boxplus.__version__, "python": platform.python_version(), "platform": platform.platform()}
    for name in ("numpy", "numba", "scipy", *packages):
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def peak_memory_mb() -> float | None:
    """Of this process, where the system tells."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
