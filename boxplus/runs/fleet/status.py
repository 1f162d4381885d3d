"""Where a fleet stands: `fleet.json`, replaced after every task."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from boxplus.formats.output import atomic_file
from boxplus.runs.run_facts import Part


class RecordingStatus(Part):
    """One recording."""

    name: str
    recording: str
    state: Literal["waiting", "finished", "failed"] = "waiting"
    error: str | None = Field(None, description="why it failed")
    doubt: str | None = Field(None, description="why its result is not to be trusted")
    seconds: float = Field(0.0, description="of its task; 0 where it was there already")
    scans: int = 0
    path_length_m: float = 0.0
    loops: int = 0


class FleetStatus(Part):
    """The facts of a fleet."""

    program: Literal["boxplus fleet run"] = "boxplus fleet run"
    stage: Literal["recordings", "pairs", "map", "finished"] = "recordings"
    recordings: list[RecordingStatus]
    pairs_looked_at: int = 0
    pairs_joined: int = 0
    pairs_failed: list[str] = Field(default=[], description="sentences on pairs whose task failed")
    joined: list[str] = Field(default=[], description="names of the recordings in the joint map")
    seconds: float = 0.0

    @property
    def failed(self) -> list[RecordingStatus]:
        """The recordings that did not come to their end."""
        return [recording for recording in self.recordings if recording.state == "failed"]

    def write(self, path: Path) -> None:
        """Replace the file in one step.

        Raises:
            OutputError: it cannot be written; the file before stays.
        """
        with atomic_file(path) as file:
            file.write(self.model_dump_json(indent=2).encode())
