"""What `run.json` holds after `boxplus vio`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from boxplus.runs.cameras.summary import CameraSummary
from boxplus.runs.run_facts import Part, read_facts

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


class VioSummary(CameraSummary):
    """The content of `run.json`."""

    program: Literal["boxplus vio"] = "boxplus vio"
    cameras: list[CameraFacts]
    start_problem: str | None = Field(None, description="why there was no start, when the last frame before it was seen")
    start_facts: dict[str, float] = Field(default={}, description="the tests that the start has passed, with their numbers")
    lines: int = Field(0, description="lines in lines.csv")
    time_offset_s: float = Field(0.0, description="added to the times of the images at the end, beside what the recording knows")


def read_vio_summary(path: str | Path) -> VioSummary:
    """Read `run.json` of 'boxplus vio'; see `read_facts`.

    Raises:
        InputError: missing, cut, not of this version, or of another kind of run.
    """
    return read_facts(VioSummary, path)
