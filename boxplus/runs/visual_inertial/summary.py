"""What `run.json` holds after `boxplus vio`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from boxplus.runs.cameras.facts import CameraRecordingFacts, FrameTiming
from boxplus.runs.run_facts import Part, RunFacts, read_facts

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
