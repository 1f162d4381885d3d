"""A loop closure, and everything that was asked of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Source = Literal["appearance", "scan context", "nearby", "forced"]


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """The local map `query` was laid over the earlier one `place`.

    Attributes:
        query, place: numbers of the local maps.
        source: who proposed it: `appearance`, the density images; `scan context`; `nearby`, the estimate; `forced`, the user.
        inliers: matching features that agree on a motion; 0 where nobody looked.
        T_place_query: (7,) measured, and `T_start` (7,) what the registration started from.
        covariance, information: (6, 6) of it, on the right, see `Registration`.
        measured: how many of the six directions the surfaces determine.
        overlap: shares of the query's points near the place's, and the other way round.
        rms: of the distances to planes [m]; rms_odometry: the same between successive maps there.
        innovation: distance from what the odometry says, in standard deviations; innovation_limit: what a true loop may have.
        refusal: why it is not believed, in a sentence; None where it passed every test so far.
        objection: what spoke against one that is believed all the same, as it is forced; None where nothing did.
        weight: in the pose graph: 1 believed, 0 refused.
    """

    query: int
    place: int
    source: Source
    inliers: int
    T_start: Floats
    T_place_query: Floats
    covariance: Floats
    information: Floats
    measured: int = 0
    overlap: tuple[float, float] = (0.0, 0.0)
    rms: float = float("nan")
    rms_odometry: float = float("nan")
    innovation: float = float("nan")
    innovation_limit: float = float("nan")
    refusal: str | None = None
    objection: str | None = None
    weight: float = 0.0

    @property
    def is_accepted(self) -> bool:
        """Whether the result rests on it."""
        return self.refusal is None and self.weight > 0.5
