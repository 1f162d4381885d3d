"""Where a fleet stands: `fleet.json`, replaced after every task."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from boxplus.runs.fleet.store import Store
from boxplus.runs.run_facts import Part

STATUS = "fleet.json"


class RecordingStatus(Part):
    """One recording."""

    name: str
    recording: str
    state: Literal["waiting", "finished", "failed"] = "waiting"
    error: str | None = Field(None, description="why it failed")
    doubt: str | None = Field(None, description="why its result is not to be trusted; such a one is left out of the joint map")
    seconds: float = Field(0.0, description="of its task; 0 where it was there already")
    scans: int = 0
    path_length_m: float = 0.0
    loops: int = 0
    joined: bool = Field(False, description="whether it is in the joint map")
    apart_because: list[str] = Field(default=[], description="what spoke against joining it with others, where it is not")


class FleetStatus(Part):
    """The facts of a fleet."""

    program: Literal["boxplus fleet run"] = "boxplus fleet run"
    stage: Literal["recordings", "pairs", "map", "finished"] = "recordings"
    recordings: list[RecordingStatus]
    pairs_looked_at: int = 0
    pairs_joined: int = 0
    pairs_failed: list[str] = Field(default=[], description="sentences on pairs whose task failed")
    contradictions: list[str] = Field(
        default=[], description="pairs that met by themselves, and that the others contradict: one of them is wrong"
    )
    pairs_in_doubt: list[str] = Field(
        default=[], description="pairs that met with a doubt, and that nothing else joins: they are not in one map"
    )
    map_points: int = Field(0, description="in the joint map; 0 where there is none")
    warnings: list[str] = Field(default=[], description="of the joint map")
    map_doubts: list[str] = Field(default=[], description="why the joint map is not to be trusted")
    earlier_map_kept: list[str] = Field(
        default=[],
        description="what speaks against a new joint map, for which that of an earlier fleet stays; none: it is the new one",
    )
    seconds: float = 0.0

    @property
    def failed(self) -> list[RecordingStatus]:
        """The recordings that did not come to their end."""
        return [recording for recording in self.recordings if recording.state == "failed"]

    @property
    def joined(self) -> list[str]:
        """Names of the recordings in the joint map."""
        return [recording.name for recording in self.recordings if recording.joined]

    @property
    def doubts(self) -> list[str]:
        """Why not all of the result is to be trusted, in sentences; none where nothing speaks against it."""
        found = [f"{own.name} failed: {own.error}" for own in self.failed]
        found += [f"{own.name} is left out of the joint map: {own.doubt}" for own in self.recordings if own.doubt is not None]
        found += [f"a pair could not be looked at: {text}" for text in self.pairs_failed]
        found += [f"the recordings contradict each other: {text}" for text in self.contradictions]
        found += [f"left out of the joint map: {text}" for text in self.pairs_in_doubt]
        found += [f"the joint map is in doubt: {text}" for text in self.map_doubts]
        found += [
            f"the joint map of an earlier fleet stays as it was, as something speaks against a new one: {text}; move it away, "
            "and the same command writes the new one"
            for text in self.earlier_map_kept
        ]
        sound = [own for own in self.recordings if own.state == "finished" and own.doubt is None]
        if self.stage == "finished" and len(sound) > 1 and not self.joined and not self.earlier_map_kept:
            found.append("no two of the recordings met: there is no joint map")
        return found

    def write(self, store: Store) -> None:
        """Replace the file in one step.

        Raises:
            OutputError: it cannot be written; the file before stays.
        """
        store.write(STATUS, self.model_dump_json(indent=2).encode())
