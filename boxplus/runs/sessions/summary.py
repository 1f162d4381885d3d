"""What `run.json` holds after `boxplus map merge`."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Literal

from pydantic import Field

from boxplus.formats.output import atomic_file
from boxplus.runs.run_facts import Part, read_facts


class SessionFacts(Part):
    """One session, and where it is."""

    name: str
    run: str = Field(description="its output folder")
    local_maps: int
    joined: bool = Field(description="whether it is in the joint map")
    T_world_session: list[float] | None = Field(None, description="[qw, qx, qy, qz, x, y, z] of its own frame in the joint map's")
    sigma: list[float] | None = Field(None, description="standard deviations of that, [w, v] on the right [rad, m]")
    largest_bend_m: float | None = Field(None, description="by which joining moved one of its local maps within the session")
    apart_because: list[str] = Field(default=[], description="what spoke against joining it with each of the others")
    doubt: str | None = Field(None, description="why the run itself is not to be trusted")


class FrameFacts(Part):
    """What gives a joint map its frame."""

    session: str = Field(description="the first one in the map, in whose frame it is")
    time_ns: int = Field(description="of the first pose of that session's run")
    T_frame_imu: list[float] = Field(description="[qw, qx, qy, qz, x, y, z] of that pose in the run's own frame")
    first_points: list[str | None] | None = Field(None, description="digests of the points of its first scan, by shells")


class MergeSummary(Part):
    """The facts of a joint map."""

    program: Literal["boxplus map merge"] = "boxplus map merge"
    versions: dict[str, str]
    created: datetime
    sessions: list[SessionFacts]
    frame: FrameFacts | None = Field(None, description="null where no two sessions were joined")
    encounters_looked_at: int = 0
    encounters_accepted: int = 0
    remove_dynamic: bool = Field(False, description="whether what was seen through was looked for")
    map_points: int = Field(0, description="in the joint map; 0 where no two sessions were joined")
    removed_points: int | None = Field(None, description="seen through and kept apart; null where nobody looked")
    changes: int | None = Field(None, description="places that changed between sessions; null where nobody looked")
    seconds: float = 0.0
    doubts: list[str] = Field(default=[], description="why the joint map is not to be trusted; none: nothing speaks against it")
    accepted: list[str] = Field(default=[], description="of the doubts, those that somebody accepted")
    warnings: list[str] = Field(default=[])

    @property
    def joined(self) -> list[SessionFacts]:
        """The sessions in the joint map."""
        return [session for session in self.sessions if session.joined]

    @property
    def unaccepted(self) -> list[str]:
        """The doubts that nobody accepted, by what stands before the colon: figures after it may be others after an update."""
        accepted = {text.partition(": ")[0] for text in self.accepted}
        return [text for text in self.doubts if text.partition(": ")[0] not in accepted]

    def accept(self, doubts: Sequence[str]) -> MergeSummary:
        """The same with those of its doubts accepted that are among these."""
        open_ones = self.model_copy(update={"accepted": list(doubts)}).unaccepted
        return self.model_copy(update={"accepted": [text for text in self.doubts if text not in open_ones]})

    def write(self, path: Path) -> None:
        """Replace the file in one step.

        Raises:
            OutputError: it cannot be written; the file before stays.
        """
        with atomic_file(path) as file:
            file.write(self.model_dump_json(indent=2).encode())


def read_merge_summary(path: Path) -> MergeSummary:
    """Read `run.json` of 'boxplus map merge'.

    Raises:
        InputError: missing, cut, not of this version, or of another program.
    """
    return read_facts(MergeSummary, path)
