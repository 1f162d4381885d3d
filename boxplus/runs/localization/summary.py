"""What `run.json` holds after `boxplus localize`; that of the odometry is in the folder `odometry`."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Literal

from pydantic import Field

from boxplus.formats.output import atomic_file
from boxplus.runs.run_facts import Part, State


class LocalizationSummary(Part):
    """The facts of a run in a saved map."""

    program: Literal["boxplus localize"] = "boxplus localize"
    versions: dict[str, str]
    state: State
    started: datetime
    updated: datetime
    recording: str = Field(description="path of the recording")
    map: str = Field(description="path of the map")
    map_kind: str = Field(description="what wrote it")
    map_report: list[str] = Field(default=[], description="what it was opened as, what of it was recovered or computed")
    map_origin: list[float] = Field(
        default=[0.0, 0.0, 0.0],
        description="what positions in the map are counted from, in the coordinates of a LAS or LAZ file [m]",
    )
    places: int = Field(0, description="local maps of the map")
    contradiction: str | None = Field(None, description="why the odometry is not to be trusted; see odometry/run.json")
    scans: int = 0
    status: dict[str, int] = Field(default={}, description="scans by status")
    found_after_s: float | None = Field(None, description="from the first scan to the first pose in the map; null: never [s]")
    searches: int = Field(0, description="queries looked for in the whole map")
    losses: list[str] = Field(default=[], description="when and why the place was lost")
    doubt: str | None = Field(None, description="why poses in the map that were given out are not to be trusted; null: nothing")
    map_doubts: list[str] = Field(
        default=[], description="why the map is not to be trusted, as the run that wrote it says, and nobody accepted"
    )
    best_candidates: list[str] = Field(default=[], description="of the last search, where no place was found at its end")
    T_map_world: list[float] | None = Field(
        None, description="the odometry's world in the map at the end [qw … z]; null: unknown"
    )
    search_s: float = Field(0.0, description="seconds spent on searches")
    tracking_s: float = Field(0.0, description="and on following the place")
    warnings: list[str] = Field(default=[])

    @property
    def reasons(self) -> list[str]:
        """Why the result is not to be trusted, in sentences; none where nothing speaks against it."""
        found = [] if self.found_after_s is not None else ["no place was found", *self.best_candidates]
        found += [text for text in (self.doubt, self.contradiction) if text is not None]
        return found + [f"the map is not to be trusted, as the run that wrote it says: {text}" for text in self.map_doubts]

    def write(self, path: Path) -> None:
        """Replace the file in one step.

        Raises:
            OutputError: it cannot be written; the file before stays.
        """
        with atomic_file(path) as file:
            file.write(self.model_dump_json(indent=2).encode())
