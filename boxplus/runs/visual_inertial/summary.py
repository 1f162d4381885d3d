"""What `run.json` holds after `boxplus vio`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from boxplus.runs.cameras.summary import CameraSummary
from boxplus.runs.run_facts import Part, read_facts
from boxplus.systems.visual_inertial_odometry.inertial_watch import LEAST_LENGTH, LEAST_SIGMAS

Matrix = list[list[float]]


class LengthFacts(Part):
    """What the IMU says of the cameras' lengths, which come from a baseline or, of one camera, from the IMU itself."""

    longer: float | None = Field(
        description="by what share lengths of the cameras are longer than those of the IMU; null where no acceleration tells"
    )
    sigma: float | None = Field(description="standard deviation of that; null likewise")

    @property
    def text(self) -> str:
        """In a line."""
        if self.longer is None or self.sigma is None:
            return "not told by the IMU: too little acceleration; a wrong baseline would not be noticed"
        least = max(LEAST_LENGTH, LEAST_SIGMAS * self.sigma)
        return (
            f"by the cameras {self.longer:+.1%} of the IMU's, ± {self.sigma:.1%}; errors of less than {least:.1%} are not noticed"
        )


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
    lengths: LengthFacts | None = Field(None, description="of the cameras, against the IMU's; null before there was a start")
    lines: int = Field(0, description="lines in lines.csv")
    time_offset_s: float = Field(0.0, description="added to the times of the images at the end, beside what the recording knows")


def read_vio_summary(path: str | Path) -> VioSummary:
    """Read `run.json` of 'boxplus vio'; see `read_facts`.

    Raises:
        InputError: missing, cut, not of this version, or of another kind of run.
    """
    return read_facts(VioSummary, path)
