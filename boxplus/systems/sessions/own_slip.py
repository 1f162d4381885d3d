"""Did the odometry of a single run slip on its way? What it saw before the slip and what after are two sessions that met.

A loop far from where the odometry puts it is mostly two places that look alike, and is refused one by one. Where several of them
say the same, though, either the odometry slipped in between or a whole stretch of way looks like another one. Both stretches
are then asked what two sessions are asked, of which no odometry says anything: `meet` has to join them. Where they lie as the
odometry has them all is well; else the run is in doubt, unless as many loops across the same stretch of way bear it out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from boxplus._arguments import as_settings
from boxplus._chi_square import chi_square_quantile
from boxplus._words import counted
from boxplus.manifolds import se3
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.systems.sessions.config import SessionsConfig
from boxplus.systems.sessions.encounter import Meeting
from boxplus.systems.sessions.likeness import is_one_alignment
from boxplus.systems.sessions.meeting import meet
from boxplus.systems.sessions.places import Places
from boxplus.systems.sessions.session import Session
from boxplus.systems.slam.config import SlamConfig
from boxplus.systems.slam.consistency import largest_clique
from boxplus.systems.slam.loop import Loop
from boxplus.systems.slam.odometry_chain import OdometryChain, mahalanobis

_HYPOTHESES = 2  # pairs of stretches that are laid over each other, those that most loops speak for first
_FEWEST = 3  # local maps, of either stretch, that loops agree on, as `least_encounters` asks for
_LONGEST, _MARGIN = 8, 2  # local maps of a stretch that agreeing loops lie in, and that are taken in on either side
_LEAST_M, _LEAST_RAD = 0.5, np.deg2rad(2.0)  # less is drift that was claimed too small


def own_slip(
    count: int, map_of: Callable[[int], LocalMap], loops: Sequence[Loop], config: SlamConfig | None = None
) -> str | None:
    """A sentence on where the odometry of a run slipped; None where nothing says so.

    Args:
        count: local maps of the run; map_of: gives one by its number, such as a `LocalMapFolder`'s.
        loops: all that were looked at.
        config: settings of the run; what two stretches need in common is what two sessions do.

    Raises:
        InputError: OpenCV, the extra `vision`, is not installed and density images are wanted.
    """
    left = [loop for loop in loops if loop.refusal is not None and not loop.innovation <= loop.innovation_limit]
    if len(left) < _FEWEST:
        return None
    run = _Run(count, map_of, loops, as_settings(SlamConfig, config))
    for _ in range(_HYPOTHESES):
        agreeing = run.largest_agreeing(left)
        places, queries = ({getattr(loop, own) for loop in agreeing} for own in ("place", "query"))
        if min(len(places), len(queries)) < _FEWEST:
            return None
        if text := run.slip_between(*_stretches(agreeing)):
            return text
        left = [loop for loop in left if not any(loop is one for one in agreeing)]
    return None


def _stretches(agreeing: Sequence[Loop]) -> tuple[set[int], set[int]]:
    """Places and queries of as many of these loops as lie within a stretch of either that is not too long to be laid over."""
    for own in ("query", "place"):
        numbers = [getattr(loop, own) for loop in agreeing]
        within = [[loop for loop in agreeing if 0 <= getattr(loop, own) - first < _LONGEST] for first in sorted(set(numbers))]
        agreeing = max(within, key=len)
    return {loop.place for loop in agreeing}, {loop.query for loop in agreeing}


class _Run:
    """A run whose points stay where they are; what two of its stretches make of each other."""

    def __init__(self, count: int, map_of: Callable[[int], LocalMap], loops: Sequence[Loop], config: SlamConfig) -> None:
        self._map_of, self._loops = map_of, loops
        self._chain, self._way_m = OdometryChain(), list[float]()
        for number in range(count):
            local_map = map_of(number)
            self._chain.add(local_map)
            self._way_m.append(local_map.path_m)
        asked = SessionsConfig()
        stricter = {"least_overlap": asked.slam.least_overlap, "rival_fit": asked.slam.rival_fit}
        self._config = asked.model_copy(update={"slam": config.model_copy(update=stricter)})

    def largest_agreeing(self, loops: Sequence[Loop]) -> list[Loop]:
        """Loops that would move the way from their queries on by about the same."""
        T, way_m = np.stack(self._chain.poses), np.array(self._way_m)
        place, query = (np.array([getattr(loop, own) for loop in loops], dtype=np.int64) for own in ("place", "query"))
        measured = np.array([loop.T_place_query for loop in loops]).reshape(-1, 7)
        moved = se3.compose(se3.compose(T[place], measured), se3.inverse(T[query]))
        adjacent = np.eye(len(loops), dtype=np.bool_)
        for k in range(len(loops)):
            other = np.arange(k)[(np.maximum(place[k], place[:k]) < np.minimum(query[k], query[:k]))]
            there = query[other]
            is_one = is_one_alignment(moved[k], moved[other], T[there], np.abs(way_m[query[k]] - way_m[there]))
            adjacent[k, other] = adjacent[other, k] = is_one
        return [loops[k] for k in largest_clique(adjacent)] if loops else []

    def slip_between(self, places: set[int], queries: set[int]) -> str | None:
        """Whether the stretches around these met, and not where the odometry has them."""
        if len(self._bearing_out(max(places), min(queries))) >= len(queries):
            return None
        cut = (max(places) + min(queries) + 1) // 2
        before = range(max(min(places) - _MARGIN, 0), min(max(places) + _MARGIN + 1, cut))
        after = range(max(min(queries) - _MARGIN, cut), min(max(queries) + _MARGIN + 1, len(self._way_m)))
        meeting = meet(self._stretch("before", before), self._stretch("after", after), self._config)
        met = [(own.loop.place + before[0], own.loop.query + after[0]) for own in meeting.accepted]
        if not met:
            return None
        last, first = max(place for place, _ in met), min(query for _, query in met)
        apart = self._apart(meeting, met[len(met) // 2])
        if apart is None or len(self._bearing_out(last, first)) >= len({query for _, query in met}):
            return None
        ranges = f"{min(place for place, _ in met)} to {last} and {first} to {max(query for _, query in met)}"
        return (
            f"the odometry slipped by {apart} between local maps {last} and {first}, or two stretches of way look alike: "
            f"{counted(len(met), 'pair')} of local maps, of {ranges}, fit each other and agree on that; look whether they are "
            "one place: if so, make a run of either part (--start, --duration) and join them by 'boxplus map merge'; if not, "
            "forbid the loops between them (--loops)"
        )

    def _bearing_out(self, last: int, first: int) -> set[int]:
        """Queries from `first` on whose loops with places up to `last` are closed, as the odometry says."""
        return {
            loop.query
            for loop in self._loops
            if loop.is_accepted and loop.source != "forced" and loop.place <= last and loop.query >= first
        }

    def _stretch(self, name: str, numbers: range) -> Places:
        maps = [replace(self._map_of(number), number=k) for k, number in enumerate(numbers)]
        return Places(Session.of(name, maps), self._config.slam)

    def _apart(self, meeting: Meeting, pair: tuple[int, int]) -> str | None:
        """How far the meeting puts the second stretch from where the odometry has it; None where that is drift."""
        if meeting.T_place_query is None or meeting.covariance is None:
            return None
        place, query = pair
        T, slam = self._chain.poses, self._config.slam
        T_met = se3.compose(se3.compose(se3.inverse(T[place]), meeting.T_place_query), T[query])
        T_odo, S_odo = self._chain.between(place, query)
        xi = se3.log(se3.compose(se3.inverse(T_met), T_odo))
        Ad = se3.adjoint(se3.inverse(T[query]))
        S = slam.odometry_scale**2 * S_odo + Ad @ meeting.covariance @ Ad.T
        metres, turn = float(np.linalg.norm(T_met[4:] - T_odo[4:])), float(np.linalg.norm(xi[:3]))
        is_drift = mahalanobis(xi, S) <= math.sqrt(chi_square_quantile(slam.innovation, 6))
        if is_drift or (metres < _LEAST_M and turn < _LEAST_RAD):
            return None
        return f"{metres:.1f} m" + (f" and {np.rad2deg(turn):.0f}°" if turn >= _LEAST_RAD else "")
