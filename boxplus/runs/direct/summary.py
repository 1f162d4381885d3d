"""What `run.json` holds after `boxplus vo`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from boxplus.runs.cameras.facts import CameraRecordingFacts, FrameTiming
from boxplus.runs.run_facts import Part, RunFacts, read_facts


class StreamFacts(Part):
    """A stream that the odometry used."""

    name: str
    use: str = Field(description="image, depth, left or right")
    model: str
    width: int
    height: int
    images: int = Field(0, description="of it that were read")
    sources: dict[str, str] = Field(default={}, description="where its calibration comes from")


class DirectSummary(RunFacts):
    """The content of `run.json`."""

    program: Literal["boxplus vo"] = "boxplus vo"
    recording: CameraRecordingFacts
    kind: Literal["rgbd", "stereo", "mono"]
    scale: Literal["metric", "unknown"] = Field(description="unknown: by about the first view's median depth")
    cameras: list[StreamFacts]
    frames: int = Field(0, description="with a pose or lost")
    keyframes: int = 0
    frames_before_start: int = Field(0, description="of one camera alone, until two views told depths; they have no pose")
    start_problem: str = Field("", description="why there was no start when the last frame without one was seen")
    landmarks: int = Field(0, description="points in landmarks.ply")
    timing: FrameTiming = FrameTiming()  # type: ignore[call-arg]

    @property
    def estimates(self) -> tuple[int, str]:
        """See `RunFacts.estimates`."""
        return self.frames, "frames"

    @property
    def length_unit(self) -> str:
        """See `RunFacts.length_unit`."""
        return "m" if self.scale == "metric" else "units of unknown scale"

    @property
    def progress(self) -> float:
        """See `RunFacts.progress`."""
        return self.recording.progress

    @property
    def written(self) -> str:
        """See `RunFacts.written`."""
        return "trajectory and frames"


def read_direct_summary(path: str | Path) -> DirectSummary:
    """Read `run.json` of 'boxplus vo'; see `read_facts`.

    Raises:
        InputError: missing, cut, not of this version, or of another kind of run.
    """
    return read_facts(DirectSummary, path)
