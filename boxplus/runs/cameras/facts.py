"""What `run.json` holds of any run with cameras: the recording as it was read, and where the time went."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from pydantic import Field

from boxplus.errors import printable
from boxplus.recordings.cameras.info import CameraRecordingInfo
from boxplus.runs.run_facts import Distribution, Part, WarningFacts

if TYPE_CHECKING:
    from boxplus.runs.run_loop import RunLoop


class CameraRecordingFacts(Part):
    """The recording as it was read."""

    path: str
    format: str
    imu: str = Field(description="topic or file of the IMU; empty where none is used")
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


def recording_facts(info: CameraRecordingInfo, progress: float, *, with_imu: bool) -> CameraRecordingFacts:
    """Of an opened recording."""
    return CameraRecordingFacts(
        path=printable(str(info.path.resolve())),
        format=info.format,
        imu=printable(info.imu.source) if with_imu and info.imu is not None else "",
        duration_s=info.duration_s,
        messages=info.message_count,
        progress=progress,
        evidence=[{"key": e.key, "value": e.value, "verdict": e.verdict, "text": e.text} for e in info.evidence],
    )


def evidence_warnings(info: CameraRecordingInfo) -> list[WarningFacts]:
    """What is doubtful about how the recording was read."""
    return [WarningFacts(text=f"{e.key}: {e.text}", count=1) for e in info.evidence if e.verdict != "ok"]


def frame_timing(loop: RunLoop[Any, Any, Any]) -> FrameTiming:
    """Of a run as it stands."""
    return FrameTiming(
        frame_ms=loop.counts.estimate_ms(),
        stages_ms=loop.counts.stages_ms(),
        reading_s=loop.seconds["reading"],
        odometry_s=loop.seconds["odometry"],
        writing_s=loop.seconds["writing"],
        total_s=time.perf_counter() - loop.began,
        real_time_factor=loop.real_time_factor(),
        compiled_kernels=loop.compiled,
    )
