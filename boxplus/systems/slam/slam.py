"""Loop closure: local maps of an odometry in, the places seen again and the corrected poses out. Derivations: docs/slam.md.

slam = Slam()
for local_map in local_maps:
    for loop in slam.add(local_map):
        …                                  # every loop that was looked at, with what spoke for and against it
corrected = slam.correction().apply(time_ns, T_odo_body)
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_settings
from boxplus.errors import InputError
from boxplus.manifolds import se3
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.maps.local_maps.registration import Surface, surface_distance
from boxplus.systems.slam.config import SlamConfig
from boxplus.systems.slam.consistency import agree, largest_clique
from boxplus.systems.slam.correction import Correction
from boxplus.systems.slam.graph import close_graph
from boxplus.systems.slam.loop import Floats, Loop
from boxplus.systems.slam.odometry_chain import OdometryChain
from boxplus.systems.slam.outcome import SlamOutcome
from boxplus.systems.slam.proposals import Proposal, Proposer
from boxplus.systems.slam.seam import Seams
from boxplus.systems.slam.verification import verify

Pair = tuple[int, int]
"""Numbers of two local maps, (query, place), the later one first."""

_FAR, _SEVERAL = 3.0, 2  # limits of the innovation beyond which a loop is false rather than the odometry, loops for a doubt
_FIRST = 256  # local maps that there is room for in the beginning
_KEPT_SURFACES = 12  # trees over local maps are built again where they are older


class Slam:
    """Closes loops over the local maps of one odometry, which itself is never touched.

    Args:
        config: settings; each has a default.
        forbidden: pairs of local maps that are no loop, whatever they look like.
        forced: pairs that are one: no test refuses it, and it is registered from where the odometry has it.
        stored: where a local map that was added can be read again by its number, such as a `LocalMapFolder`'s; then none of their
            points stay in memory. None keeps them.

    Attributes:
        loops: every loop that was looked at, the latest state of each.
        T_map: (n, 7) of the local maps, as estimated now.

    Raises:
        InputError: a pair that is forbidden and forced, or not of an earlier map; OpenCV, the extra `vision`, is not installed.

    Example: docs/slam.md.
    """

    def __init__(
        self,
        config: SlamConfig | None = None,
        *,
        forbidden: Iterable[Pair] = (),
        forced: Iterable[Pair] = (),
        stored: Callable[[int], LocalMap] | None = None,
    ) -> None:
        self.config = as_settings(SlamConfig, config)
        self._forbidden, self._forced = _checked_pairs(forbidden, forced)
        self._stored = stored
        self._maps: list[LocalMap] = []
        self._odometry = OdometryChain()
        self._proposer = Proposer(self.config)
        self._surfaces: dict[int, Surface] = {}
        self._rms: list[float] = []
        self._seams = Seams(self.config)
        self._newest: LocalMap | None = None
        self._agreements: dict[Pair, bool] = {}  # of loops that stand, which do not change any more
        self._closed = 0  # maps that the last closing saw
        self._scale = 1.0  # of the odometry's covariances, see `_drift_scale`
        self.loops: list[Loop] = []
        self._placed = np.zeros((_FIRST, 7))  # T_map, and room for more

    def add(self, local_map: LocalMap) -> list[Loop]:
        """Take the next local map; returns the loops that were looked at for it, most of them refused.

        Raises:
            InputError: a map whose number is not the next.
        """
        query = len(self._maps)
        if local_map.number != query:
            raise InputError(f"local map {query}", f"number {local_map.number}", "add the maps of one builder in their order")
        self._maps.append(local_map if self._stored is None else replace(local_map, points=local_map.points[:0]))
        self._newest = local_map
        self._odometry.add(local_map)
        if query == len(self._placed):
            self._placed = np.concatenate([self._placed, np.zeros_like(self._placed)])
        self._placed[query] = self._predicted(query)
        self._rms.append(self._rms_of_odometry(query))
        self._seams.add(local_map, self._surface(query), self._odometry)
        verified = [self._verified(query, proposal) for proposal in self._proposals(query)]
        looked_at = _without_contradictions(verified, self._odometry, self.config)
        first = len(self.loops)
        self.loops += _best_of_each_place(looked_at)
        if any(loop.refusal is None for loop in self.loops[first:]):
            self._close()
        return self.loops[first:]

    @property
    def T_map(self) -> Floats:
        """See the class."""
        return self._placed[: len(self._maps)]

    @property
    def doubt(self) -> str | None:
        """A sentence where successive local maps contradict each other, or loops that pass every other test the odometry; None
        where neither does."""
        return "; ".join(text for text in (self._seams.doubt(self.loops), self._drift()) if text is not None) or None

    def _drift(self) -> str | None:
        """What loops say that are refused for the odometry alone."""
        near = [
            loop
            for loop in self.loops
            if loop.refusal is not None
            and loop.measured >= self.config.least_measured
            and min(loop.overlap) >= self.config.least_overlap
            and loop.innovation_limit < loop.innovation < _FAR * loop.innovation_limit
        ]
        if len(near) < _SEVERAL:
            return None
        most = max(loop.innovation for loop in near)
        return (
            f"{len(near)} loops fit but lie up to {most:.1f} standard deviations from the odometry: it drifts more than claimed "
            "and than local_maps.drift_rotation and drift_position allow for, or they are false; look at them before you believe "
            "either"
        )

    def correction(self) -> Correction:
        """What closing the loops changed; the identity where there was none.

        Raises:
            InputError: no local map yet.
        """
        if not self._maps:
            raise InputError("a local map at least", "none", "add one first")
        steps = max(self._scale, 1.0) * np.stack([m.covariance for m in self._maps])
        return Correction(
            np.array([m.time_ns for m in self._maps], dtype=np.int64),
            np.stack(self._odometry.poses),
            self.T_map.copy(),
            *self._covariances(steps),
            steps,
        )

    def _covariances(self, steps: Floats) -> tuple[Floats, Floats]:
        """Of the local maps against the first, and of each with the one before: from the graph, then along the odometry.

        Where the loops say that the odometry drifts less than assumed, its poses are weighed by that, but not believed: drift
        that is small in tilt must not pass for a small one in yaw.
        """
        covariance, cross = np.zeros((2, *steps.shape))
        known, kept = 1, [loop for loop in self.loops if loop.is_accepted]
        if kept:
            known = self._closed
            forced = [True] * len(kept)
            graph = close_graph(self._odometry.poses[:known], list(steps[:known]), kept, self.config.gravity_sigma, forced)
            covariance[:known], cross[1:known] = graph.covariances()
        for k in range(known, len(steps)):
            Ad = se3.adjoint(se3.compose(se3.inverse(self.T_map[k]), self.T_map[k - 1]))
            cross[k] = covariance[k - 1] @ Ad.T
            covariance[k] = Ad @ cross[k] + steps[k]
        return covariance, cross

    def outcome(self) -> SlamOutcome:
        """All that is known now, without the points of local maps.

        Raises:
            InputError: no local map yet.
        """
        return SlamOutcome(self.correction(), list(self.loops), self.doubt, self._scale)

    def _close(self) -> None:
        """Believe the largest set of loops that agree with each other and with the odometry, and move the maps."""
        standing = [k for k, loop in enumerate(self.loops) if loop.refusal is None]
        forced = [k for k in standing if self.loops[k].source == "forced"]
        free = [k for k in standing if self.loops[k].source != "forced"]
        agree = free if len(free) < 2 else [free[k] for k in largest_clique(self._consistent(free))]
        chosen = sorted(forced + agree)
        self._scale = self._drift_scale([self.loops[k] for k in chosen])
        graph = close_graph(
            self._odometry.poses,
            [self._scale * m.covariance for m in self._maps],
            [self.loops[k] for k in chosen],
            self.config.gravity_sigma,
            [k in forced for k in chosen],
        )
        self._closed = len(graph.T_map)
        self._placed[: self._closed] = graph.T_map
        kept = {k for k, is_kept in zip(chosen, graph.is_kept, strict=True) if is_kept}
        for k in standing:
            self.loops[k] = replace(self.loops[k], weight=float(k in kept))

    def _drift_scale(self, loops: list[Loop]) -> float:
        """Factor of the odometry's covariances: what the innovations of loops make of it, and one loop's worth of belief in it.

        An odometry that drifts less than is assumed for every sensor must not be bent to the centimetres of a registration.
        """
        squares = sum((self.config.odometry_scale * loop.innovation) ** 2 for loop in loops if loop.source != "forced")
        dof = sum(loop.measured for loop in loops if loop.source != "forced")
        return (6.0 + squares) / (6.0 + dof)

    def _consistent(self, numbers: list[int]) -> NDArray[np.bool_]:
        adjacent = np.eye(len(numbers), dtype=np.bool_)
        for a, first in enumerate(numbers):
            for b in range(a):
                pair = first, numbers[b]
                if pair not in self._agreements:
                    self._agreements[pair] = agree(self.loops[pair[0]], self.loops[pair[1]], self._odometry, self.config)
                adjacent[a, b] = adjacent[b, a] = self._agreements[pair]
        return adjacent

    def _predicted(self, query: int) -> Floats:
        """Where a new local map is, from the corrected pose of the one before."""
        poses = self._odometry.poses
        if query == 0:
            return poses[0]
        return se3.compose(self._placed[query - 1], se3.compose(se3.inverse(poses[-2]), poses[-1]))

    def _proposals(self, query: int) -> list[Proposal]:
        before = bisect_right(self._maps, self._maps[query].path_m - self.config.least_way, key=lambda m: m.path_m)
        found = self._proposer.propose(query, self._map, before, self._odometry, self.T_map)
        free = [p for p in found if (query, p.place) not in self._forbidden and (query, p.place) not in self._forced]
        wanted = sorted(place for q, place in self._forced if q == query)
        T = self.T_map
        return [Proposal(place, se3.compose(se3.inverse(T[place]), T[query]), "forced") for place in wanted] + free

    def _verified(self, query: int, proposal: Proposal) -> Loop:
        rms = max(self._rms[query], self._rms[proposal.place])
        maps = self._maps[query], self._maps[proposal.place]
        surfaces = self._surface(query), self._surface(proposal.place)
        loop = verify(proposal, maps, surfaces, rms, self._odometry, self.config)
        is_believed_anyhow = proposal.source == "forced" and loop.information.any()
        return replace(loop, refusal=None, objection=loop.refusal) if is_believed_anyhow else loop

    def _rms_of_odometry(self, query: int) -> float:
        """How well a map fits the one before it: what the odometry's own errors make of surfaces [m]."""
        if query == 0:
            return 0.0
        start = se3.compose(se3.inverse(self._odometry.poses[query - 1]), self._odometry.poses[query])
        found = surface_distance(self._surface(query), self._surface(query - 1), start, self.config.registration)
        return self._rms[-1] if found is None else found

    def _surface(self, number: int) -> Surface:
        if number not in self._surfaces:
            if len(self._surfaces) >= _KEPT_SURFACES:
                del self._surfaces[next(iter(self._surfaces))]
            self._surfaces[number] = Surface.of(self._map(number).points)
        return self._surfaces[number]

    def _map(self, number: int) -> LocalMap:
        if self._newest is not None and self._newest.number == number:
            return self._newest
        return self._maps[number] if self._stored is None else self._stored(number)


def _checked_pairs(forbidden: Iterable[Pair], forced: Iterable[Pair]) -> tuple[set[Pair], set[Pair]]:
    sets = tuple({(int(a), int(b)) for a, b in pairs} for pairs in (forbidden, forced))
    for query, place in sets[0] | sets[1]:
        if not 0 <= place < query:
            raise InputError("pairs (query, place) of local maps, the later one first", f"({query}, {place})", "see loops.csv")
    if both := sets[0] & sets[1]:
        raise InputError("loops that are forbidden or forced", f"both for {sorted(both)[0]}", "take it out of one of the lists")
    return sets[0], sets[1]


def _best_of_each_place(loops: list[Loop]) -> list[Loop]:
    """One loop for each place: an accepted one before a refused one, then the larger overlap."""
    best: dict[int, Loop] = {}
    for loop in loops:
        known = best.get(loop.place)
        if known is None or (loop.refusal is None, min(loop.overlap)) > (known.refusal is None, min(known.overlap)):
            best[loop.place] = loop
    return list(best.values())


def _without_contradictions(loops: list[Loop], odometry: OdometryChain, config: SlamConfig) -> list[Loop]:
    """One cannot be at two places at once: where two loops of a query contradict each other, neither is believed."""
    refused: dict[int, str] = {}
    for a, first in enumerate(loops):
        for b in range(a):
            second = loops[b]
            is_asked = first.refusal is None and second.refusal is None and "forced" not in (first.source, second.source)
            if is_asked and not agree(first, second, odometry, config):
                refused[a] = f"contradicts the loop with {second.place}, which fits as well"
                refused[b] = f"contradicts the loop with {first.place}, which fits as well"
    return [replace(loop, refusal=refused[k]) if k in refused else loop for k, loop in enumerate(loops)]
