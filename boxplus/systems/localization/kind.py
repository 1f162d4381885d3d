"""Whether a place is told from others of its kind, and not only a place of the right kind.

Racks, columns and walls fit wherever there are such, also in the map of another hall built alike. The lead of a place over its
rivals in one query (`candidate.lead`) varies by a third of itself: its mean over the queries in a row that came to the place has
to reach a limit before a pose is given, and to exceed it by what so few queries may be off before the place is told. Until then
it is asked again while it is followed, and a run that ends before it was told says so. Where much of what stands is nowhere in
the map, its rivals may only lie farther beyond the map's end: that tells nothing. Derivation: docs/localization.md.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._words import either
from boxplus.manifolds import se3
from boxplus.systems.localization.global_search import same_pose

Floats = NDArray[np.float64]

_AGREE = 1.0, np.deg2rad(5.0), 1.0  # m, rad, m: two queries that say the same, the odometry between them


class Kind:
    """What the queries in a row that came to one place say of it.

    Args:
        least: mean lead, of a place that is believed at all.
        margin: and so much more over the root of the number of queries, of one that is told.
        least_fit: mean share of what stands that is in the map, of one that is told.
    """

    def __init__(self, least: float, margin: float, least_fit: float) -> None:
        self._least, self._margin, self._least_fit = least, margin, least_fit
        self._leads: list[float] = []
        self._fits: list[float] = []
        self._T_map_odo: Floats | None = None
        self._is_followed = False  # poses in this place were given out
        self._left: str | None = None  # doubt of an earlier place, which was left before it was told
        self._left_at: Floats | None = None  # T_map_odo of that one

    @property
    def mean(self) -> float:
        """Of the leads; zero before there is one."""
        return float(np.mean(self._leads)) if self._leads else 0.0

    @property
    def is_told(self) -> bool:
        """Whether the place is told from others of its kind."""
        if not self._leads or np.mean(self._fits) < self._least_fit:
            return False
        return self.mean >= self._least + self._margin / math.sqrt(len(self._leads))

    @property
    def refusal(self) -> str | None:
        """Why the place is not believed; None where the mean lead is what is asked for."""
        if self.mean >= self._least:
            return None
        return f"a place of the same kind, perhaps another one: {self._nearer} at any other pose, {self._percent} asked for"

    @property
    def doubt(self) -> str | None:
        """Why poses that were given out may be those of another place of the kind; None where nothing says so."""
        if self._left is not None or not self._is_followed or self.is_told:
            return self._left
        queries = f"{len(self._leads)} {either(len(self._leads), 'query', 'queries')}"
        missing = f"{100.0 * (1.0 - np.mean(self._fits)):.0f} % of it"
        return (
            f"the place may be another one of the same kind: over {queries} {self._nearer} at any other pose, other places of "
            f"a kind come to {self._percent}, and {missing} is nowhere in the map; a longer way tells"
        )

    def see(self, lead: float, fit: float, T_map_odo: Floats, T_odo: Floats) -> None:
        """A query that came to a place, believed or not: T_map_odo (7,), where the odometry is at T_odo (7,)."""
        if self._T_map_odo is None or not same_place(self._T_map_odo, T_map_odo, T_odo):
            self.forget()
        self.see_again(lead, fit, T_map_odo, T_odo)

    def see_again(self, lead: float, fit: float, T_map_odo: Floats, T_odo: Floats) -> None:
        """A query of the place that is followed, however far the odometry has drifted since the one before."""
        self._leads.append(lead)
        self._fits.append(fit)
        self._T_map_odo = T_map_odo
        if self.is_told and self._left_at is not None and same_place(self._left_at, T_map_odo, T_odo):
            self._left = self._left_at = None  # it was the same place, after all

    def follow(self) -> None:
        """Poses in this place are given out from now on."""
        self._is_followed = True

    def forget(self) -> None:
        """The next query is of another place, or nobody knows of which."""
        if self._left is None:
            self._left, self._left_at = self.doubt, self._T_map_odo
        self._leads, self._fits, self._T_map_odo, self._is_followed = [], [], None, False

    @property
    def _nearer(self) -> str:
        return f"what stands lies {100.0 * self.mean:.0f} % nearer to surfaces of the map than"

    @property
    def _percent(self) -> str:
        return f"{100.0 * self._least:.0f} %"


def same_place(first: Floats, second: Floats, T_odo: Floats) -> bool:
    """Whether two T_map_odo (7,) put the odometry's pose (7,) at the same place."""
    return same_pose(se3.compose(first, T_odo), se3.compose(second, T_odo), *_AGREE)
