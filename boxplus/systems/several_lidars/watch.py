"""Checks, while an odometry runs on merged scans, that each other LiDAR sees what the first one has seen, where it saw it.

The filter cannot tell: where the LiDARs look at different surfaces each fits its own part of the map, wherever it is declared to
lie. So, every so often, the surfaces are those of the first LiDAR alone, over some seconds (see `pair`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.several_lidars.judgement import PairJudgement, judge_pair
from boxplus.systems.several_lidars.motion import FEWEST_POSES, LidarMotion
from boxplus.systems.several_lidars.surfaces import Surfaces
from boxplus.systems.several_lidars.twins import Twins

_WINDOW_S, _SHORTEST_S = 10.0, 3.0
_EVERY_S = 30.0
_LONGEST_GAP_S = 0.5
_SURFACE_POINTS, _OTHER_POINTS = 1500, 80  # of a scan that are kept
_MOST_PENDING = 100
_MOST_TRIES = 12  # windows in a row, to check a LiDAR for the first time


@dataclass(slots=True)
class _Other:
    """One of the other LiDARs."""

    name: str
    number: int
    T_first_other: NDArray[np.float64]
    p_first: list[NDArray[np.float64]] = field(default_factory=list)
    time_ns: list[NDArray[np.int64]] = field(default_factory=list)
    windows: int = 0
    contradicted: int = 0
    streak: int = 0  # of windows in a row that contradict
    is_seen: bool = False  # whether a point of it was ever merged
    last: PairJudgement | None = None
    agreed: PairJudgement | None = None  # of the windows that agree, that which shows most, the last of these
    contradicting: PairJudgement | None = None

    @property
    def judgement(self) -> PairJudgement | None:
        """What contradicts, where the last window that shows anything does; else what agrees; else why nothing is known."""
        return (self.contradicting if self.streak else None) or self.agreed or self.last


class LidarWatch:
    """Follows the merged scans and the estimates of one run.

    Args:
        names: of the other LiDARs, in their order.
        T_first_other: (4, 4) of each, as declared.

    Attributes:
        contradiction: what is wrong with a LiDAR, a sentence; None as long as nothing is.
        every_s: time from the end of a window in which all is well to the begin of the next [s].
    """

    def __init__(self, names: Sequence[str], T_first_other: Sequence[NDArray[np.float64]]) -> None:
        self.contradiction: str | None = None
        self.every_s = _EVERY_S
        self._others = [_Other(name, k, np.array(T)) for k, (name, T) in enumerate(zip(names, T_first_other, strict=True), 1)]
        self._twins = Twins([np.eye(4), *(other.T_first_other for other in self._others)])
        self._time_ns: list[int] = []
        self._R: list[NDArray[np.float64]] = []
        self._p: list[NDArray[np.float64]] = []
        self._surface: list[NDArray[np.float64]] = []
        self._resume_ns: int | None = None
        self._tries = 0

    def judgements(self) -> dict[str, tuple[PairJudgement | None, int, int]]:
        """Of each other LiDAR: what is known of it, windows judged, windows that contradict."""
        return {other.name: (other.judgement, other.windows, other.contradicted) for other in self._others}

    def add_scan(self, scan: Scan) -> None:
        """Take a merged scan in, before its estimate comes."""
        if scan.lidar is None or self._rests(scan.end_ns):
            return
        self._twins.add(scan)
        for other in self._others:
            own = np.flatnonzero(scan.lidar == other.number)
            if len(own):
                other.is_seen = True
                own = own[:: -(-len(own) // _OTHER_POINTS)]
                other.p_first.append(scan.p_lidar[own].astype(np.float64))
                other.time_ns.append(scan.time_ns[own])
                del other.p_first[:-_MOST_PENDING], other.time_ns[:-_MOST_PENDING]

    def add_estimate(self, estimate: Estimate) -> list[str]:
        """Take the estimate of a scan in; returns what is new, one sentence each."""
        now = estimate.time_ns
        if self._rests(now):
            return []
        if estimate.status == "lost" or (self._time_ns and (now - self._time_ns[-1]) * 1e-9 > _LONGEST_GAP_S):
            self._forget(now)
        if estimate.status == "lost" or (self._time_ns and now <= self._time_ns[-1]):
            return []
        state = estimate.state
        self._time_ns.append(now)
        self._R.append(state.R_world_imu @ state.R_imu_lidar)
        self._p.append(state.p_world_imu + state.R_world_imu @ state.p_imu_lidar)
        first = np.arange(len(estimate.p_lidar)) if estimate.lidar is None else np.flatnonzero(estimate.lidar == 0)
        if len(first):
            first = first[:: -(-len(first) // _SURFACE_POINTS)]
            self._surface.append(state.to_world(estimate.p_lidar[first]))
        if (now - self._time_ns[0]) * 1e-9 < _WINDOW_S:
            return []
        return self._judge()

    def finish(self) -> list[str]:
        """No more scans will come; returns what is new."""
        told = []
        if len(self._time_ns) > 1 and (self._time_ns[-1] - self._time_ns[0]) * 1e-9 >= _SHORTEST_S:
            told = self._judge()
        for other in self._others:
            if other.streak and self.contradiction is None and 2 * other.contradicted >= other.windows:
                told += self._contradict(other)
            if other.windows == 0:
                if not other.is_seen:
                    told.append(
                        f"no point of LiDAR {other.name} was merged: none lies between min_range and max_range (another unit of "
                        "length?) and in the time of a scan; see 'boxplus inspect'"
                    )
                    continue
                why = "the recording is too short" if other.last is None else other.last.text
                told.append(
                    f"LiDAR {other.name} could not be checked against the first one, and was merged as declared: {why}; see "
                    "'boxplus inspect'"
                )
            elif other.agreed is not None and other.agreed.unshown and not other.streak:
                what = " and ".join(other.agreed.unshown)
                told.append(
                    f"the {what} of LiDAR {other.name} could not be checked against the first one, and was taken as declared: "
                    f"{other.agreed.text}"
                )
        return told

    def _rests(self, time_ns: int) -> bool:
        return self._resume_ns is not None and time_ns < self._resume_ns

    def _forget(self, before_ns: int | None = None) -> None:
        self._time_ns, self._R, self._p, self._surface = [], [], [], []
        for other in self._others:
            kept = [k for k, time in enumerate(other.time_ns) if before_ns is not None and int(time.max()) > before_ns]
            other.p_first, other.time_ns = [other.p_first[k] for k in kept], [other.time_ns[k] for k in kept]

    def _judge(self) -> list[str]:
        """Each other LiDAR against what the first one has seen in this window."""
        told: list[str] = []
        doubted, unverified = False, False
        end_ns = self._time_ns[-1]
        if len(self._time_ns) >= FEWEST_POSES and self._surface:
            motion = LidarMotion(np.array(self._time_ns), np.array(self._R), np.array(self._p))
            surfaces = Surfaces(np.concatenate(self._surface))
            for other in self._others:
                told += self._judge_one(other, motion, surfaces)
                doubted |= other.last is not None and other.last.verdict == "contradicted"
                unverified |= other.windows == 0
        self._forget(end_ns)
        # A doubt is followed up at once, as is a LiDAR not checked yet; what is known for sure is not looked at all the time.
        self._tries += unverified
        again = (doubted or (unverified and self._tries <= _MOST_TRIES)) and self.contradiction is None
        self._resume_ns = None if again else end_ns + round(self.every_s * 1e9)
        return told

    def _judge_one(self, other: _Other, motion: LidarMotion, surfaces: Surfaces) -> list[str]:
        if not other.p_first:
            return []
        T = other.T_first_other
        p_other = (np.concatenate(other.p_first) - T[:3, 3]) @ T[:3, :3]
        found = self._as_twin(other) or judge_pair(motion, surfaces, p_other, np.concatenate(other.time_ns), T)
        other.last = found
        if found.verdict == "unverified":
            return []
        other.windows += 1
        if found.verdict == "agree":
            other.streak = 0
            if other.agreed is None or len(found.unshown) <= len(other.agreed.unshown):
                other.agreed = found
            return []
        other.contradicted, other.streak, other.contradicting = other.contradicted + 1, other.streak + 1, found
        is_sure = other.streak > 1 or found.cause == "the same"
        return self._contradict(other) if is_sure and self.contradiction is None else []

    def _as_twin(self, other: _Other) -> PairJudgement | None:
        """The verdict on a LiDAR that was given before, which fits itself wherever that lies."""
        number = self._twins.of(other.number)
        if number is None:
            return None
        which = "the first one" if number == 0 else f"LiDAR {self._others[number - 1].name}"
        text = f"its points are those of {which}, to a millimetre: one sensor is given twice, and would count twice; leave it out"
        return PairJudgement("contradicted", "the same", text)

    def _contradict(self, other: _Other) -> list[str]:
        text = other.contradicting.text if other.contradicting is not None else ""
        if other.contradicting is not None and other.contradicting.cause == "the same":
            self.contradiction = f"LiDAR {other.name} is none of its own: {text}"
            return [self.contradiction]
        self.contradiction = (
            f"LiDAR {other.name} contradicts the first one: {text}; 'boxplus inspect' measures it by the path of the first "
            "alone, which the error has not bent"
        )
        return [self.contradiction]
