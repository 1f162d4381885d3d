"""What `run.json` holds: the facts of a run, written from its first second on."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from boxplus.errors import InputError
from boxplus.formats.output import atomic_file

State = Literal["running", "finished", "interrupted", "failed"]
Matrix = list[list[float]]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class RecordingFacts(_Part):
    """The recording as it was read."""

    path: str
    format: str
    lidar_topic: str
    imu_topic: str
    duration_s: float = Field(description="between its first and last message [s]")
    messages: int = Field(description="LiDAR and IMU messages to read")
    progress: float = Field(0.0, description="share of the recording that was read, 0 to 1")
    evidence: list[dict[str, str]] = Field(default=[], description="every reading found from the data: key, value, verdict, text")


class ExtrinsicFacts(_Part):
    """The LiDAR's pose in the IMU frame."""

    source: str
    text: str
    estimation: str
    T_imu_lidar_start: Matrix
    T_imu_lidar_end: Matrix | None = None


class StartFacts(_Part):
    """How the filter began."""

    kind: str
    text: str
    duration_s: float


class Distribution(_Part):
    """Milliseconds per scan."""

    median: float
    p99: float
    max: float


class TimingFacts(_Part):
    """Where the time went."""

    scan_ms: Distribution | None = Field(None, description="the odometry's time per scan, all stages")
    stages_ms: dict[str, Distribution] = {}
    reading_s: float = Field(0.0, description="waiting for the reader, all in all")
    odometry_s: float = 0.0
    writing_s: float = Field(0.0, description="trajectory and map tiles")
    merging_s: float = Field(0.0, description="map.ply and map.pcd")
    total_s: float = Field(0.0, description="from the start of the run to this writing")
    real_time_factor: float = Field(0.0, description="sensor time by the time of the run until its last scan, reading included")
    compiled_kernels: int = Field(0, description="kernels compiled during the run: more than zero on first use only")


class Gap(_Part):
    """A time without data."""

    begin_s: float = Field(description="since the first estimate")
    duration_s: float


class WeakInterval(_Part):
    """Successive scans that were not fully determined by the LiDAR."""

    begin_s: float = Field(description="since the first estimate")
    end_s: float
    status: str
    scans: int
    text: str


class WarningFacts(_Part):
    """A warning, and how often it came (texts that differ only in their numbers are one)."""

    text: str
    count: int
    first_s: float | None = Field(None, description="since the first estimate")


class MapFacts(_Part):
    """The map on disk."""

    registered_points: int = Field(0, description="points handed to the map, before thinning")
    stored_points: int = Field(0, description="points in the tiles")
    merged_points: int | None = Field(None, description="points in map.ply and map.pcd")
    rejected_points: int = Field(0, description="not finite, or more than 1000 km from the origin")
    voxel_m: float | None = None


class RunSummary(_Part):
    """The content of `run.json`."""

    program: Literal["boxplus lio"] = "boxplus lio"
    versions: dict[str, str]
    state: State
    error: str | None = None
    process: int = Field(description="process id of the run")
    resumed: int = Field(0, description="how often the run went on after it had been killed or interrupted")
    started: datetime
    updated: datetime
    recording: RecordingFacts
    extrinsic: ExtrinsicFacts
    start: StartFacts | None = None
    scans: int = 0
    status: dict[str, int] = Field(default={}, description="scans by status")
    first_time_ns: int | None = None
    last_time_ns: int | None = None
    duration_s: float = Field(0.0, description="between the first and the last estimate [s]")
    path_length_m: float = Field(0.0, description="sum of the distances between successive estimates")
    contradiction: str | None = Field(
        None, description="why the run is not to be trusted, whatever the status: how LiDAR and IMU contradict each other"
    )
    scans_read: int = 0
    imu_samples_read: int = 0
    rejected: dict[str, dict[str, int]] = Field(
        default={}, description="what was not used, by place (recording, odometry, points) and reason"
    )
    weak_intervals: list[WeakInterval] = []
    imu_gaps: list[Gap] = []
    scan_gaps: list[Gap] = []
    timing: TimingFacts = TimingFacts()  # type: ignore[call-arg]
    map: MapFacts = MapFacts()  # type: ignore[call-arg]
    peak_memory_mb: float | None = None
    warnings: list[WarningFacts] = []

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
        return self._describe_progress() + doubt

    def _describe_progress(self) -> str:
        reached = f"{self.scans} scans" + (f" ({self.duration_s:.1f} s)" if self.scans else "")
        if self.state == "finished":
            return f"finished: {reached}"
        complete = f"trajectory and map are complete up to there; {self.recording.progress:.0%} of the recording was read"
        if self.state == "interrupted":
            return f"interrupted after {reached}: {complete}"
        if self.state == "failed":
            return f"stopped by an error after {reached}: {complete}. {self.error}"
        if _is_alive(self.process, self.updated):
            return f"still running, {reached} so far"
        return f"interrupted (the process ended without a word) after at least {reached}: {complete}"


def read_summary(path: str | Path) -> RunSummary:
    """Read `run.json`.

    Raises:
        InputError: missing, cut or not of this version.
    """
    try:
        return RunSummary.model_validate_json(Path(path).read_bytes())
    except OSError as error:
        raise InputError("the output folder of a run, with run.json", f"{path}: {error.strerror}", "check the path") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        if where == "program":
            raise InputError(
                "the output folder of 'boxplus lio'",
                f"one of {first['input']!r} ({path})",
                "open its report.html, or run that command again",
            ) from error
        raise InputError(
            "run.json as this version of boxplus writes it", f"{where}: {first['msg']} ({path})", "run 'boxplus lio' again"
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
