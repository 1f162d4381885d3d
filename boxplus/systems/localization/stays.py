"""Whether the places of one run agree with each other, and which of them nothing but itself ever spoke for.

A place that is lost because what is seen there is not what the map has was perhaps never the right one: poses in it were given
all the same. It was right where the whole map, searched again while it was followed, told no other, and where it is found again
as the odometry has it. Where it is found elsewhere, the sensor was carried without the odometry noticing, or one of the two is
wrong.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.systems.localization.global_search import same_pose

Floats = NDArray[np.float64]

_APART, _TURNED, _ABOVE = 1.0, np.deg2rad(5.0), 1.0  # m, rad, m: places that are one
_DRIFT = 0.02  # m/m, of the odometry from the one to the other


class Stays:
    """The places of a run, one after the other.

    Attributes:
        is_confirmed: whether the whole map was searched again while the place of now was followed, and told no other.
    """

    def __init__(self) -> None:
        self.is_confirmed = False
        self._began_ns = 0
        self._way = 0.0  # since the last one was lost
        self._lost: tuple[Floats, str] | None = None  # T_map_odo of the last one, and what spoke against it
        self._open: str | None = None  # of that one, as long as it is not found again
        self._elsewhere: str | None = None

    @property
    def doubt(self) -> str | None:
        """Why poses that were given out are not to be trusted; None where nothing speaks against them."""
        return self._elsewhere or self._open

    def walk(self, way: float) -> None:
        """The odometry went so far [m]."""
        self._way += way

    def jump(self) -> None:
        """The odometry does not know how it moved: where it has the last place says nothing any more."""
        self._lost = None

    def begin(self, time_ns: int, T_map_odo: Floats, T_odo: Floats) -> None:
        """A place is found: T_map_odo (7,), where the odometry is at T_odo (7,)."""
        self.is_confirmed, self._began_ns, self._open = False, time_ns, None
        if self._lost is None:
            return
        (before, why), drift = self._lost, _DRIFT * self._way
        A, B = se3.compose(before, T_odo), se3.compose(T_map_odo, T_odo)
        if not same_pose(A, B, _APART + drift, _TURNED, _ABOVE + drift):
            away = float(np.linalg.norm(A[4:] - B[4:]))
            self._elsewhere = (
                f"the place was lost ({why}) and found again {away:.1f} m from where the odometry has it since: the sensor was "
                "carried and the odometry did not notice, or one of the two places is wrong"
            )
        self._lost = None

    def end(self, time_ns: int, T_map_odo: Floats, why: str, *, is_contradicted: bool) -> None:
        """The place of now is lost; by what is seen in it, or only because nothing told where it is."""
        self._way = 0.0
        self._lost = (T_map_odo, why) if is_contradicted else None
        if is_contradicted and not self.is_confirmed:
            seconds = (time_ns - self._began_ns) * 1e-9
            self._open = (
                f"the place that was followed for {seconds:.1f} s may be a wrong one: it was lost ({why}) before a search of the "
                "whole map had confirmed it, and was not found again"
            )
