"""What `run.json` holds after any run with cameras."""

from __future__ import annotations

from pydantic import Field

from boxplus.runs.cameras.facts import CameraRecordingFacts, FrameTiming
from boxplus.runs.run_facts import RunFacts


class CameraSummary(RunFacts):
    """What the contents of `run.json` share."""

    resumed: int = Field(0, description="how often the run went on after it had been killed or interrupted")
    recording: CameraRecordingFacts
    frames: int = Field(0, description="with a pose or lost; those before the start have none")
    keyframes: int = 0
    frames_before_start: int = Field(0, description="that were seen until a start was found")
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
