"""Localisation in a saved map: scans of an odometry in, poses in the map out. Derivations: docs/localization.md.

localizer = Localizer(open_saved_map("run1"))
for time_ns, T_odo_body, p_body in scans:
    found = localizer.push(time_ns, T_odo_body, p_body)
    found.status                             # searching, localised, or odometry only
    found.T_map_body                         # never while searching
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._arguments import as_settings
from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se3
from boxplus.manifolds.se3 import SE3
from boxplus.maps.local_maps.builder import LocalMapBuilder
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.systems.localization.candidate import (
    Candidate,
    Query,
    best_first,
    contradiction,
    distinct,
    examine_all,
    lead,
    rivalry,
)
from boxplus.systems.localization.config import LocalizationConfig
from boxplus.systems.localization.global_search import Guess, PlaceImages
from boxplus.systems.localization.kind import Kind, same_place
from boxplus.systems.localization.map_lengths import MapLengths
from boxplus.systems.localization.map_tilt import MapTilt
from boxplus.systems.localization.place_map import PlaceMap
from boxplus.systems.localization.stays import Stays
from boxplus.systems.localization.tracking import Matched, Tracker
from boxplus.systems.localization.upright import level, up_in_body

Floats = NDArray[np.float64]
Status = Literal["localised", "odometry only", "searching"]

_QUERY_RANGE = 60.0  # m
_STILL = 1.0  # s after a registration was taken that a pose is localised, where no later one failed
_HERE = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
_REMEMBERED = 4  # poses that fitted a query
_NEVER = -(2**62)
_CONTRADICTIONS = 2  # in a row, after which the place is another one
_JUMP_S = 2.0  # between scans, after which nothing is known of the motion between


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """One query, looked for in the whole map.

    Attributes:
        time_ns: of its newest scan.
        candidates: what was looked at, the best fit first.
        verdict: why none is believed; empty where one is.
    """

    time_ns: int
    candidates: tuple[Candidate, ...]
    verdict: str


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """What was looked for: scans together, the newest one alone [body at its time], and its pose in the local map (7,)."""

    local_map: LocalMap
    scan: NDArray[np.float32]
    T_query_body: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Localization:
    """What is known of one scan.

    Attributes:
        time_ns: absolute [ns].
        status: "localised": held by the map; "odometry only": followed by the odometry from where the map held it last;
            "searching": not known, then `T_map_body` is None.
        T_map_body: (7,) [qw, qx, qy, qz, x, y, z]; covariance: (6, 6) of [w, v] on the right of it [rad, m].
        matched: this scan against the map; None where it was not compared.
        search: the query that this scan completed; None for most. Where a place is followed, its verdict contradicts it.
    """

    time_ns: int
    status: Status
    T_map_body: Floats | None
    covariance: Floats | None
    matched: Matched | None
    search: Search | None


class Localizer:
    """Finds where an odometry is in a map, follows it there, and finds it again where it is lost.

    Args:
        place_map: the map, from `open_saved_map`.
        config: settings; each has a default.

    Attributes:
        last_search: the newest query; last_query: what it asked for, None before one had points.
        losses: how often the place was lost; lost_because: why last, None before it was.
        stays: whether the places agree with each other.
        kind: whether the place is told from others of its kind.
        lengths: whether the map has the lengths that are seen; tilt: whether it stands upright.

    Example: docs/localization.md.
    """

    def __init__(self, place_map: PlaceMap, config: LocalizationConfig | None = None) -> None:
        self.config = as_settings(LocalizationConfig, config)
        self.last_search: Search | None = None
        self.last_query: Asked | None = None
        self.lost_because: str | None = None
        self.losses = 0
        self.stays = Stays()
        self.kind = Kind(self.config.least_lead, self.config.lead_margin, self.config.told_fit)
        self.lengths, self.tilt = MapLengths(), MapTilt()
        self._map = place_map
        self._images = PlaceImages(place_map.local_maps)
        self._tracker: Tracker | None = None
        self._before: tuple[int, Floats] | None = None
        self._promising: Floats | None = None  # T_map_odo of the query before, where it was nearly believed
        self._earlier: list[tuple[int, Floats]] = []  # place and T_map_odo of what fitted the query before
        self._held_ns = self._fitting_ns = self._tried_ns = self._failures = 0
        self._again_ns, self._again_s = 0, 0.0  # when it is looked for again, and how long after the time before
        self._contradictions = 0  # in a row
        self._contradicted_by: str | None = None
        self._is_odometry_lost = False  # since a scan fitted last
        self._begin_search()

    @property
    def doubt(self) -> str | None:
        """Why poses that were given out are not to be trusted; None where nothing speaks against them."""
        texts = [part.doubt for part in (self.stays, self.kind, self.lengths, self.tilt)]
        if self._contradictions and self._contradicted_by != self.kind.refusal:
            texts.append(f"the place that is followed may be a wrong one: in the newest search {self._contradicted_by}")
        return "; ".join(text for text in texts if text is not None) or None

    def push(
        self,
        time_ns: int,
        T_odo_body: ArrayLike,
        p_body: ArrayLike,
        up_odo: ArrayLike | None = (0.0, 0.0, 1.0),
        *,
        lost: bool = False,
    ) -> Localization:
        """Take a scan.

        Args:
            time_ns: absolute [ns], later than the one before.
            T_odo_body: (7,) pose of the body in the odometry's world.
            p_body: (N, 3) its points in the body's frame [m].
            up_odo: (3,) against gravity, in the odometry's world. None where nobody knows: while it is searched, surfaces of
                each query tell, within 45° of the body's z axis; then the map does.
            lost: the odometry does not know where this scan belongs.

        Raises:
            InputError: a time that is not later, arrays of another shape, not finite.
        """
        T_odo = SE3.check("T_odo_body", np.atleast_2d(as_floats(T_odo_body, "T_odo_body")))[0]
        points = np.asarray(p_body, dtype=np.float32)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError("p_body of shape (N, 3)", f"shape {points.shape}", "give points in the body's frame [m]")
        if self._before is not None and time_ns <= self._before[0]:
            raise InputError("scans in order of time", f"{time_ns} ns after {self._before[0]} ns", "push each scan once")
        points = points[np.isfinite(points).all(axis=1)]
        seconds = 0.0 if self._before is None else (time_ns - self._before[0]) * 1e-9
        step = _HERE if self._before is None else se3.compose(se3.inverse(self._before[1]), T_odo)
        if seconds > _JUMP_S:
            self._lose(f"no scan for {seconds:.1f} s", is_contradicted=False)
        if seconds > _JUMP_S or lost:
            self.stays.jump()
            if self._tracker is None:
                self.kind.forget()
        self._before = int(time_ns), T_odo
        self.stays.walk(float(np.linalg.norm(step[4:])))
        self.lengths.walk(float(np.linalg.norm(step[4:])))
        up = None if up_odo is None else as_floats(up_odo, "up_odo")
        if self._tracker is None:
            return self._search(int(time_ns), T_odo, points[:0] if lost else points, up)
        self._tracker.predict(step, seconds)
        return self._follow(self._tracker, int(time_ns), T_odo, points, up, lost)

    def believes(self, asked: Asked) -> Candidate | None:
        """The place of a query that this map is believed to have, at once and by itself; None where there is none."""
        candidates = best_first(self._candidates(asked.local_map, asked.T_query_body, asked.scan, []))
        if not candidates:
            return None
        best, verdict, _ = rivalry(candidates, self.config)
        is_believed = best is not None and not verdict and lead(best, candidates) >= self.config.least_lead
        return best if is_believed else None

    def _search(self, time_ns: int, T_odo: Floats, points: NDArray[np.float32], up: Floats | None) -> Localization:
        """Collect scans; look for what has been collected."""
        search = None
        for query in self._builder.push(time_ns, T_odo, np.zeros((6, 6)), points, up):
            search = self._look(query, time_ns, T_odo, points)
        if self._tracker is None:
            return Localization(time_ns, "searching", None, None, None, search)
        return Localization(time_ns, "localised", self._tracker.T_map_body, self._tracker.covariance, None, search)

    def _look(self, local_map: LocalMap, time_ns: int, T_odo: Floats, scan: NDArray[np.float32]) -> Search:
        config = self.config
        T_query_body = se3.compose(se3.inverse(local_map.T_odo_map), T_odo)
        candidates: list[Candidate] = []
        verdict = "the scans have no points"
        if len(local_map.points):
            self.last_query = Asked(local_map, scan, T_query_body)
            # What fitted before is asked again: a place that the search misses once stays a rival.
            earlier = [Guess(place, se3.compose(T, local_map.T_odo_map), 0.0) for place, T in self._earlier]
            candidates = best_first(self._candidates(local_map, T_query_body, scan, earlier))
            T_odo_query = se3.inverse(local_map.T_odo_map)
            fitting = distinct([candidate for candidate in candidates if candidate.fit >= config.least_fit])[:_REMEMBERED]
            self._earlier = [(one.place, se3.compose(one.T_map_query, T_odo_query)) for one in fitting]
            verdict = self._judge(candidates, local_map, T_query_body)
        self.last_search = Search(time_ns, tuple(candidates), verdict)
        return self.last_search

    def _candidates(
        self, local_map: LocalMap, T_query_body: Floats, scan: NDArray[np.float32], more: list[Guess]
    ) -> list[Candidate]:
        """What comes of the guesses from above, and of more of them, which come last."""
        seen = se3.act(T_query_body, scan.astype(np.float64)).astype(np.float32)
        query = Query.of(local_map.points, seen, T_query_body[4:])
        guesses = self._images.guesses(local_map.points, self.config.candidates)
        return examine_all([*more, *guesses], query, self._map.points_near, self.config)

    def _judge(self, candidates: list[Candidate], local_map: LocalMap, T_query_body: Floats) -> str:
        """Begin to follow the best candidate where it is believed; returns why not."""
        if not candidates:
            return "nothing that was seen stands, or none of it agrees with the map"
        best, verdict, at_once = rivalry(candidates, self.config)
        if best is None:
            self._promising = None
            return verdict
        T_map_odo = se3.compose(best.T_map_query, se3.inverse(local_map.T_odo_map))
        self.kind.see(lead(best, candidates), best.fit, T_map_odo, local_map.T_odo_map)  # also of those that are not believed
        verdict = verdict or self.kind.refusal or ""
        if verdict:
            self._promising = None
            return verdict
        if not at_once:
            before, self._promising = self._promising, T_map_odo
            if before is None or not same_place(before, T_map_odo, local_map.T_odo_map):
                return (
                    f"not {self.config.decisive:g} times as good as the next place: a second query has to agree, of "
                    f"{self.config.query_duration:g} s or {self.config.query_length:g} m more"
                )
        T_map_body = se3.compose(best.T_map_query, T_query_body)
        Ad = se3.adjoint(se3.inverse(T_query_body))
        self._tracker = Tracker(self._map, T_map_body, Ad @ best.covariance @ Ad.T, self.config)
        self._held_ns = self._fitting_ns = local_map.end_ns
        self._failures, self._is_odometry_lost = 0, False
        self.stays.begin(local_map.end_ns, T_map_odo, se3.compose(local_map.T_odo_map, T_query_body))
        self.kind.follow()
        self._again_ns = local_map.end_ns + (int(1e9 * self._again_s) if self.kind.is_told else 0)
        self._builder = self._new_builder()
        return ""

    def _follow(
        self, tracker: Tracker, time_ns: int, T_odo: Floats, points: NDArray[np.float32], up: Floats | None, lost: bool
    ) -> Localization:
        config = self.config
        matched = None
        self._is_odometry_lost |= lost
        if not lost and len(points) and (time_ns - self._tried_ns) * 1e-9 >= config.track_interval:
            self._tried_ns = time_ns
            is_due = self.lengths.is_due
            up_body = quaternion.to_matrix(tracker.T_map_body[:4])[2] if up is None else up_in_body(T_odo, up)
            matched = tracker.correct(points, level(up_body), with_lengths=is_due)
            self._failures = self._failures + 1 if matched.innovation > matched.limit else 0
            if is_due and matched.measured:
                self.lengths.see(matched.lengths)
            if up is not None and matched.measured == 6:
                self.tilt.see(quaternion.to_matrix(tracker.T_map_body[:4]) @ up_body)
            # One that fails ends it at once: a sensor that was carried away is not where the odometry has it.
            self._held_ns = time_ns if matched.measured else _NEVER
            # At the map's end what it still has near is seen as it is; elsewhere than that the place is another one.
            if matched.share >= config.least_share or matched.is_beyond:
                self._fitting_ns, self._is_odometry_lost = time_ns, False
        search = self._look_again(tracker, time_ns, T_odo, points[:0] if lost else points, up)
        reason = self._why_lost(time_ns, tracker)
        if reason:
            # Beyond the map, or after scans that the odometry lost, nothing that is seen speaks against where it was.
            self._lose(reason, is_contradicted=reason != self._why_vague(tracker) and not self._is_odometry_lost)
            return Localization(time_ns, "searching", None, None, matched, search)
        is_held = (time_ns - self._held_ns) * 1e-9 <= _STILL and not self._contradictions
        status: Status = "localised" if is_held else "odometry only"
        return Localization(time_ns, status, tracker.T_map_body, tracker.covariance, matched, search)

    def _look_again(
        self, tracker: Tracker, time_ns: int, T_odo: Floats, points: NDArray[np.float32], up: Floats | None
    ) -> Search | None:
        """Now and then look for what is seen in the whole map, as if nothing were known, and ask whether that is here."""
        config = self.config
        if not config.recheck_after or time_ns < self._again_ns:
            return None
        queries = self._builder.push(time_ns, T_odo, np.zeros((6, 6)), points, up)
        if not queries or not len(queries[0].points):
            return None
        T_query_body = se3.compose(se3.inverse(queries[0].T_odo_map), T_odo)
        T_map_query = se3.compose(tracker.T_map_body, se3.inverse(T_query_body))
        near = [float(np.linalg.norm(place.T_odo_map[4:] - T_map_query[4:])) for place in self._map.local_maps]
        candidates = self._candidates(queries[0], T_query_body, points, [Guess(int(np.argmin(near)), T_map_query, 0.0)])
        why = contradiction(candidates[0], candidates[1:], T_map_query, config)
        if why is None and candidates[0].refusal is None and not self.kind.is_told:
            T_map_odo = se3.compose(tracker.T_map_body, se3.inverse(T_odo))
            self.kind.see_again(lead(candidates[0], candidates[1:]), candidates[0].fit, T_map_odo, T_odo)
            why = self.kind.refusal
        self._builder = self._new_builder()
        self._contradictions = self._contradictions + 1 if why else 0
        self.stays.is_confirmed = why is None and (candidates[0].refusal is None or self.stays.is_confirmed)
        if why is None:
            self._again_ns = time_ns + int(1e9 * self._again_s)
            if self.kind.is_told:
                self._again_s = min(2.0 * self._again_s, config.recheck_interval)
        self._contradicted_by = why
        self.last_search = Search(time_ns, tuple(candidates), why or "")
        return self.last_search

    def _why_lost(self, time_ns: int, tracker: Tracker) -> str | None:
        config = self.config
        if self._failures >= config.failures:
            return f"{self._failures} registrations in a row contradict the odometry"
        if (time_ns - self._fitting_ns) * 1e-9 >= config.lost_after:
            return f"less than {100 * config.least_share:.0f} % of what stands has been in the map for {config.lost_after:g} s"
        if self._contradictions >= _CONTRADICTIONS:
            return f"{self._contradictions} times in a row {self._contradicted_by}"
        return self._why_vague(tracker)

    def _why_vague(self, tracker: Tracker) -> str | None:
        if tracker.sigma > self.config.largest_sigma:
            return f"followed by the odometry alone until the position was known to {tracker.sigma:.1f} m only"
        return None

    def _lose(self, reason: str, *, is_contradicted: bool) -> None:
        if self._tracker is not None and self._before is not None:
            time_ns, T_odo = self._before
            T_map_odo = se3.compose(self._tracker.T_map_body, se3.inverse(T_odo))
            self.stays.end(time_ns, T_map_odo, reason, is_contradicted=is_contradicted)
            self.lost_because = reason
            self.losses += 1
        if is_contradicted:
            self.kind.forget()
        self._begin_search()

    def _begin_search(self) -> None:
        config = self.config
        self._tracker = None
        self.lengths.begin()
        self.tilt.begin()
        self._promising = None
        self._earlier = []
        self._held_ns = self._fitting_ns = self._tried_ns = self._failures = 0
        self._again_s, self._again_ns = config.recheck_after, 0
        self._contradictions, self._contradicted_by = 0, None
        self._builder = self._new_builder()

    def _new_builder(self) -> LocalMapBuilder:
        config = self.config
        return LocalMapBuilder(
            LocalMapConfig(
                length=config.query_length,
                duration=config.query_duration,
                least_length=0.0,
                voxel=self._map.voxel,
                max_range=_QUERY_RANGE,
            ),  # type: ignore[call-arg]
            looks_anew=True,  # an odometry of a LiDAR alone drifts while it is searched
        )
