"""What `run.json` holds of any odometry run: the facts that do not depend on its sensors, written from its first second on."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from boxplus.errors import InputError
from boxplus.formats.output import atomic_file

State = Literal["running", "finished", "interrupted", "failed"]
PartT = TypeVar("PartT", bound="Part")


class Part(BaseModel):
    """A part of `run.json`."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class StartFacts(Part):
    """How the estimator began."""

    kind: str
    text: str
    duration_s: float


class Distribution(Part):
    """Milliseconds per estimate."""

    median: float
    mean: float
    p99: float
    max: float


class Gap(Part):
    """A time without data."""

    begin_s: float = Field(description="since the first estimate")
    duration_s: float


class WeakInterval(Part):
    """Successive estimates of one status other than ok."""

    begin_s: float = Field(description="since the first estimate")
    end_s: float
    status: str
    count: int = Field(description="of estimates")
    text: str


class WarningFacts(Part):
    """A warning, and how often it came (texts that differ only in their numbers are one)."""

    text: str
    count: int
    first_s: float | None = Field(None, description="since the first estimate")


class RunFacts(Part, ABC):
    """The facts of a run; each kind of run adds its own, with its `program`."""

    program: str
    versions: dict[str, str]
    state: State
    error: str | None = None
    process: int = Field(description="process id of the run")
    started: datetime
    updated: datetime
    start: StartFacts | None = None
    status: dict[str, int] = Field(default={}, description="estimates by status")
    first_time_ns: int | None = None
    last_time_ns: int | None = None
    duration_s: float = Field(0.0, description="between the first and the last estimate [s]")
    path_length_m: float = Field(0.0, description="sum of the distances between successive estimates")
    contradiction: str | None = Field(
        None,
        description="why the run is not to be trusted, whatever the status: how the sensors contradict each other, or how "
        "little it knows itself",
    )
    imu_samples_read: int = 0
    rejected: dict[str, dict[str, int]] = Field(default={}, description="what was not used, by place and reason")
    weak_intervals: list[WeakInterval] = []
    imu_gaps: list[Gap] = []
    peak_memory_mb: float | None = None
    warnings: list[WarningFacts] = []

    @property
    @abstractmethod
    def estimates(self) -> tuple[int, str]:
        """How many there are, and what one is for (`scans`, `frames`)."""

    @property
    def length_unit(self) -> str:
        """Of positions and of the path."""
        return "m"

    @property
    def not_shown(self) -> str | None:
        """Which errors of the sensors the motion would not have shown; None if it would have shown all."""
        return None

    @property
    @abstractmethod
    def progress(self) -> float:
        """Share of the recording that was read, 0 to 1."""

    @property
    @abstractmethod
    def written(self) -> str:
        """What is complete up to the last estimate."""

    def write(self, path: Path) -> None:
        """Replace the file in one step.

        Raises:
            OutputError: it cannot be written; the file before stays.
        """
        with atomic_file(path) as file:
            file.write(self.model_dump_json(indent=2).encode())

    def describe_state(self) -> str:
        """One sentence on how far the run came, and whether the sensors contradict each other."""
        doubt = "" if self.contradiction is None else f"; not to be trusted: {self.contradiction}"
        return self.describe_progress() + doubt

    def describe_progress(self) -> str:
        """One sentence on how far the run came."""
        count, unit = self.estimates
        reached = f"{count} {unit}" + (f" ({self.duration_s:.1f} s)" if count else "")
        if self.state == "finished":
            return f"finished: {reached}"
        complete = f"{self.written} are complete up to there; {self.progress:.0%} of the recording was read"
        if self.state == "interrupted":
            return f"interrupted after {reached}: {complete}"
        if self.state == "failed":
            return f"stopped by an error after {reached}: {complete}. {self.error}"
        if _is_alive(self.process, self.updated):
            return f"still running, {reached} so far"
        return f"interrupted (the process ended without a word) after at least {reached}: {complete}"


def read_facts(kind: type[PartT], path: str | Path) -> PartT:
    """Read `run.json`.

    Raises:
        InputError: missing, cut, not of this version, or of another kind of run.
    """
    program = kind.model_fields["program"].default
    try:
        return kind.model_validate_json(Path(path).read_bytes())
    except OSError as error:
        raise InputError("the output folder of a run, with run.json", f"{path}: {error.strerror}", "check the path") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        if where == "program":
            raise InputError(
                f"the output folder of '{program}'",
                f"one of {first['input']!r} ({path})",
                f"give one of '{program}'",
            ) from error
        raise InputError(
            "run.json as this version of boxplus writes it", f"{where}: {first['msg']} ({path})", f"run '{program}' again"
        ) from error


def _is_alive(process: int, updated: datetime) -> bool:
    if os.name == "nt":  # there, os.kill would end the process
        return (datetime.now(UTC) - updated).total_seconds() < 10.0
    try:
        os.kill(process, 0)
    except PermissionError:
        return True
    except (OSError, OverflowError):
        return False
    return True
