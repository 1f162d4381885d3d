"""What `run.json` holds after `boxplus vio`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from boxplus.runs.run_facts import Distribution, Part, RunFacts, read_facts

Matrix = list[list[float]]


class CameraFacts(Part):
    """A camera of the run."""

    name: str
    model: str
    width: int
    height: int
    images: int = Field(0, description="images of it that were read")
    T_imu_camera_start: Matrix
    T_imu_camera_end: Matrix | None = None
    sources: dict[str, str] = Field(default={}, description="where intrinsics, mounting and time offset come from")


class CameraRecordingFacts(Part):
    """The recording as it was read."""

    path: str
    format: str
    imu: str = Field(description="topic or file of the IMU")
    duration_s: float = Field(description="between its first and last message [s]")
    messages: int = Field(description="images and IMU samples to read")
    progress: float = Field(0.0, description="share of the recording that was read, 0 to 1")
    evidence: list[dict[str, str]] = Field(default=[], description="every reading found from the data: key, value, verdict, text")


class FrameTiming(Part):
    """Where the time went."""

    frame_ms: Distribution | None = Field(None, description="the odometry's time per frame, all stages")
    stages_ms: dict[str, Distribution] = Field(default={})
    reading_s: float = Field(0.0, description="waiting for the reader, decoding of images included, all in all")
    odometry_s: float = 0.0
    writing_s: float = Field(0.0, description="trajectory, frames and landmarks")
    total_s: float = Field(0.0, description="from the start of the run to this writing")
    real_time_factor: float = Field(0.0, description="sensor time by the time of the run until its last frame, reading included")
    compiled_kernels: int = Field(0, description="kernels compiled during the run: more than zero on first use only")


class VioSummary(RunFacts):
    """The content of `run.json`."""

    program: Literal["boxplus vio"] = "boxplus vio"
    recording: CameraRecordingFacts
    cameras: list[CameraFacts]
    frames: int = Field(0, description="with a state; those before the start have none")
    keyframes: int = 0
    frames_before_start: int = 0
    start_problem: str | None = Field(None, description="why there was no start, when the last frame before it was seen")
    start_facts: dict[str, float] = Field(default={}, description="the tests that the start has passed, with their numbers")
    time_offset_s: float = Field(0.0, description="added to the times of the images at the end, beside what the recording knows")
    landmarks: int = Field(0, description="points in landmarks.ply")
    timing: FrameTiming = FrameTiming()  # type: ignore[call-arg]

    @property
    def estimates(self) -> tuple[int, str]:
        """See `RunFacts.estimates`."""
        return self.frames, "frames"

    @property
    def progress(self) -> float:
        """See `RunFacts.progress`."""
        return self.recording.progress

    @property
    def written(self) -> str:
        """See `RunFacts.written`."""
        return "trajectory and frames"


def read_vio_summary(path: str | Path) -> VioSummary:
    """Read `run.json` of 'boxplus vio'; see `read_facts`.

    Raises:
        InputError: missing, cut, not of this version, or of another kind of run.
    """
    return read_facts(VioSummary, path)
