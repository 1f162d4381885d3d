"""What `run.json` holds after `boxplus slam`; that of the odometry is in the folder `odometry`."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Literal

from pydantic import Field

from boxplus.formats.output import atomic_file
from boxplus.runs.run_facts import Part, State


class SlamSummary(Part):
    """The facts of a run with loop closure."""

    program: Literal["boxplus slam"] = "boxplus slam"
    versions: dict[str, str]
    state: State
    started: datetime
    updated: datetime
    recording: str = Field(description="path of the recording")
    contradiction: str | None = Field(None, description="why the odometry is not to be trusted; see odometry/run.json")
    scans: int = 0
    path_length_m: float = Field(0.0, description="along the odometry [m]")
    local_maps: int = 0
    loops_looked_at: int = 0
    loops_accepted: int = 0
    loops_forced: int = Field(0, description="believed because the user said so")
    loops_refused: dict[str, int] = Field(default={}, description="how many, by what spoke against them")
    largest_shift_m: float = Field(0.0, description="by which closing loops moved a local map at most [m]")
    last_shift_m: float = Field(0.0, description="and the last one [m]")
    map_points: int = Field(0, description="in the corrected map")
    slam_s: float = Field(0.0, description="seconds spent on local maps and loops")
    writing_s: float = Field(0.0, description="and on writing the corrected trajectory and map")
    warnings: list[str] = Field(default=[])

    def write(self, path: Path) -> None:
        """Replace the file in one step.

        Raises:
            OutputError: it cannot be written; the file before stays.
        """
        with atomic_file(path) as file:
            file.write(self.model_dump_json(indent=2).encode())
