"""An encounter: a local map of one session laid over one of another; and what two sessions make of all of theirs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from boxplus.systems.slam.loop import Floats, Loop


@dataclass(frozen=True, slots=True, eq=False)
class Encounter:
    """A `Loop` between two sessions; its `query` and `place` are numbers of local maps of either.

    Attributes:
        place_session, query_session: numbers of the sessions.
        loop: what was measured, and why it is not believed where it is not.
    """

    place_session: int
    query_session: int
    loop: Loop


@dataclass(frozen=True, slots=True, eq=False)
class Meeting:
    """What was found between two sessions.

    Attributes:
        place_session, query_session: numbers of the sessions.
        encounters: all that were looked at; those that the alignment rests on have no refusal.
        T_place_query: (7,) the query session's frame in the place session's, and `covariance` (6, 6) on its right, of the
            two sessions alone; None where they are not joined.
        predicted, confirmed: local maps that should overlap if the alignment is right, and those of them that do.
        standing: share of what stands upright in overlapping local maps of one and stands at the same place in the other; NaN
            where the meeting was refused before that was asked.
        refusal: why the two are not joined, in a sentence; None where they are.
        doubt: what is left to doubt where they are, after their names; None where nothing is.
        slip: where they are, and encounters say that the odometry of one slipped: a sentence; None where nothing says so.
    """

    place_session: int
    query_session: int
    encounters: Sequence[Loop]
    T_place_query: Floats | None = None
    covariance: Floats | None = None
    predicted: int = 0
    confirmed: int = 0
    standing: float = math.nan
    refusal: str | None = None
    doubt: str | None = None
    slip: str | None = None

    @property
    def accepted(self) -> list[Encounter]:
        """The encounters that the alignment rests on; none where the sessions are not joined."""
        if self.refusal is not None:
            return []
        return [Encounter(self.place_session, self.query_session, loop) for loop in self.encounters if loop.refusal is None]
