"""What `run.json` holds after `boxplus vo`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from boxplus.runs.cameras.summary import CameraSummary
from boxplus.runs.run_facts import Part, read_facts


class StreamFacts(Part):
    """A stream that the odometry used."""

    name: str
    use: str = Field(description="image, depth, left or right")
    model: str
    width: int
    height: int
    images: int = Field(0, description="of it that were read")
    sources: dict[str, str] = Field(default={}, description="where its calibration comes from")


class DirectSummary(CameraSummary):
    """The content of `run.json`."""

    program: Literal["boxplus vo"] = "boxplus vo"
    kind: Literal["rgbd", "stereo", "mono"]
    scale: Literal["metric", "unknown"] = Field(description="unknown: by about the first view's median depth")
    cameras: list[StreamFacts]
    start_problem: str = Field("", description="why there was no start when the last frame without one was seen")

    @property
    def length_unit(self) -> str:
        """See `RunFacts.length_unit`."""
        return "m" if self.scale == "metric" else "units of unknown scale"


def read_direct_summary(path: str | Path) -> DirectSummary:
    """Read `run.json` of 'boxplus vo'; see `read_facts`.

    Raises:
        InputError: missing, cut, not of this version, or of another kind of run.
    """
    return read_facts(DirectSummary, path)
