"""Did two sessions meet? Nothing is known of where one began in the other, so that one encounter alone proves nothing.

1. *Encounters*: what looks alike, where a second local map looks alike at the same alignment, is laid over each other, with
   every test of a loop but that of the odometry. Where the same maps fit as well elsewhere, within `reach` or turned, they say
   nothing.
2. *Agreement*: two encounters close a cycle with the ways of both sessions; the largest set in which all pairs do is the
   hypothesis.
3. *Directions*: along a street of even fronts all of them may leave open how far, and lie wherever their likeness put them. Then
   what faces along it is laid over each other, of all encounters at once, at every shift (`open_axis`). In the end each direction
   has to be measured.
4. *Prediction*: the hypothesis says which other local maps lie over each other. It is right only if they do.
5. *Rivals*: where another such set is nearly as large, and what it predicts lies over each other too, two places of one session
   look like one of the other: refused.
6. *Support*: enough encounters, of different local maps, along a way.
7. *What stands*: two streets have their ground and their fronts in common. What stands upright elsewhere has to as well; where
   nothing does, nothing tells them apart.
8. *Wholes*: the sessions do not fit as well shifted or turned as wholes.
9. *Kind*: what stands lies nearer to the surfaces of the other session than it does shifted or turned: two places of one kind
   have their racks and columns in common, and nothing that stands in them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from boxplus._words import counted, either
from boxplus.manifolds import se3
from boxplus.maps.local_maps.registration import fitting_share, register
from boxplus.systems.sessions.config import SessionsConfig
from boxplus.systems.sessions.encounter import Encounter, Meeting
from boxplus.systems.sessions.graph import JoinedGraph, join
from boxplus.systems.sessions.kind import lead_of
from boxplus.systems.sessions.open_axis import moved_along, open_axis, shift_along
from boxplus.systems.sessions.other_alignments import fits_otherwise, other_alignments
from boxplus.systems.sessions.places import Places
from boxplus.systems.sessions.slip import slip_of
from boxplus.systems.slam.consistency import agree, largest_clique
from boxplus.systems.slam.loop import Floats, Loop
from boxplus.systems.slam.proposals import Proposal
from boxplus.systems.slam.rivals import turned_rivals
from boxplus.systems.slam.structure import standing_in_common
from boxplus.systems.slam.verification import verify

_START = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
_SIGMAS_OF_REACH = 7.0  # standard deviations of the position of a proposal that make up the reach in which rivals are tried
_CLEAR = 0.35  # lead over other alignments up to which two of a kind cannot be excluded: warehouses with other pallets reach 0.23
_TILT, _YAW = 0.03, 0.1  # rad, of a proposal
_RIVAL_AGREEMENT = 0.6  # of density images, for a rival that is turned
_TOLERANCE, _RMS_FLOOR = 2.5, 0.02  # standard deviations, m: within which a point fits
_BASIN_ROTATION, _BASIN_POSITION, _BASIN_DRIFT = 0.2, 4.0, 0.03  # rad, m, m/m: by which two likenesses of one alignment differ
_PREDICTED = 2  # places that are looked at for each local map of the query session
_AS_WELL = "the maps fit as well"  # begins what is said of a rival
_FEWEST_STANDING = 100  # points, of all encounters together
_SAME_AXIS = 0.9  # cosine
_FIRST = 2  # encounters that agree make a hypothesis


@dataclass(frozen=True, slots=True, eq=False)
class _Belief:
    """What is believed of the pose of one local map of the query session in one of the place session."""

    T_place_query: Floats
    covariance: Floats

    def between(self, a: int, b: int) -> tuple[Floats, Floats]:
        """See `RelativePoses`; whatever is asked for, it is this pair."""
        del a, b
        return self.T_place_query, self.covariance


def meet(place: Places, query: Places, config: SessionsConfig, numbers: tuple[int, int] = (0, 1)) -> Meeting:
    """Look for encounters of two sessions and decide whether they were at the same place.

    Args:
        numbers: of the place session and of the query session, for the result.
    """
    return _Meeting(place, query, config, numbers).decide()


class _Meeting:
    def __init__(self, place: Places, query: Places, config: SessionsConfig, numbers: tuple[int, int]) -> None:
        self.place, self.query, self.config, self.numbers = place, query, config, numbers
        self.loops: dict[tuple[int, int], Loop] = {}
        self.proposed = 0
        self._not_told: str | None = None  # why nothing tells how far along an axis that all encounters leave open

    def decide(self) -> Meeting:
        self._look_for_encounters()
        standing = [loop for loop in self.loops.values() if loop.refusal is None]
        if len({loop.query for loop in standing}) < _FIRST:
            return self._refused(self._nothing_found())
        chosen = self._largest_agreeing(standing)
        if len(_queries(chosen)) < _FIRST:
            return self._refused(f"{len(standing)} encounters fit, but no two of them agree on where one session is in the other")
        chosen = self._closed(chosen)
        standing = [loop for loop in self.loops.values() if loop.refusal is None]
        predicted, confirmed, found = self._check_predictions(chosen)
        if rival := self._rival(standing, chosen, confirmed):
            return self._refused(rival, predicted, confirmed)
        self._take(found)
        standing = [loop for loop in self.loops.values() if loop.refusal is None]
        chosen = self._largest_agreeing(standing)
        if refusal := self._too_little(chosen, predicted, confirmed):
            return self._refused(refusal, predicted, confirmed)
        joined = self._joined(chosen)
        kept = {id(loop) for loop, is_kept in zip(chosen, joined.is_kept, strict=True) if is_kept}
        if refusal := self._too_little([loop for loop in chosen if id(loop) in kept], predicted, confirmed):
            return self._refused(refusal, predicted, confirmed)
        return self._as_wholes(joined, kept, predicted, confirmed)

    def _as_wholes(self, joined: JoinedGraph, kept: set[int], predicted: int, confirmed: int) -> Meeting:
        """Steps 3 and 7 to 9, of encounters whose alignment nothing else speaks against."""
        encounters, least = [loop for loop in self.loops.values() if id(loop) in kept], self.config.least_standing
        share = self._standing_share(encounters)
        if math.isnan(share):
            return self._refused("nothing stands upright where they lie over each other that could tell", predicted, confirmed)
        if share < least:
            why = f"{100.0 * share:.0f} % of what stands upright in one stands at the same place in the other"
            return self._refused(f"{why}, {100.0 * least:.0f} % are asked for", predicted, confirmed, share)
        if (axis := self._open_axis(encounters)) is not None:
            x, y, z = axis.tolist()
            where = f"({x:+.2f}, {y:+.2f}, {z:+.2f}) in the frame of {self.query.session.name}"
            why = f"{len(encounters)} encounters agree, but the surfaces of all of them leave open how far along {where} it lies"
            why = f"{why}: {self._not_told}" if self._not_told else why
            return self._refused(why, predicted, confirmed, share)
        T = joined.T_world_session[1]
        others = other_alignments(self.place, self.query, T, self.config)
        if otherwise := fits_otherwise(self.place, self.query, T, others, self.config):
            return self._refused(otherwise, predicted, confirmed, share)
        lead, asked = lead_of(self.place, self.query, T, others, self.config), self.config.least_lead
        if lead is None and others:
            why = "something else looks alike, and too little stands upright where they lie over each other to compare the two"
            return self._refused(why, predicted, confirmed, share)
        if lead is not None and lead.share < asked:
            why = f"what stands lies {100.0 * lead.share:.0f} % nearer to surfaces of the other than {lead.over or 'anywhere'}"
            why = f"two places of a kind, perhaps: {why}, {100.0 * asked:.0f} % are asked for"
            return self._refused(why, predicted, confirmed, share)
        doubt = None
        if lead is not None and lead.over is not None and lead.share < _CLEAR:
            doubt = (
                f"are at the same place or at two of a kind: what stands lies only {100.0 * lead.share:.0f} % nearer to surfaces "
                f"of the other than {lead.over}"
            )
        against = [loop for loop in self.loops.values() if loop.refusal is None and id(loop) not in kept]
        names = self.place.session.name, self.query.session.name
        slip = slip_of(encounters, self._largest_agreeing(against), names, joined.T_world_map)
        why = "contradicts the encounters that agree with each other"
        final = [replace(loop, refusal=why) if loop in against else loop for loop in self.loops.values()]
        final = [replace(loop, weight=float(loop.refusal is None)) for loop in final]
        T, covariance = joined.T_world_session[1], joined.covariance[1]
        return Meeting(*self.numbers, final, T, covariance, predicted, confirmed, share, doubt=doubt, slip=slip)

    def _refused(self, why: str, predicted: int = 0, confirmed: int = 0, standing: float = math.nan) -> Meeting:
        return Meeting(*self.numbers, list(self.loops.values()), None, None, predicted, confirmed, standing, why)

    def _standing_share(self, loops: list[Loop]) -> float:
        """Step 7, over encounters together; NaN where too little stands to tell."""
        found = [
            standing_in_common(
                self.query.surface(loop.query), self.place.surface(loop.place), loop.T_place_query, self.config.slam.registration
            )
            for loop in loops
        ]
        asked = sum(of for _, of in found)
        return sum(shared for shared, _ in found) / asked if asked >= _FEWEST_STANDING else math.nan

    def _nothing_found(self) -> str:
        if not self.loops:
            alike = f"{_pairs(self.proposed)} alike, but no two at one alignment"
            return alike if self.proposed else "no local map of one looks like one of the other"
        ambiguous = [(loop, rival) for loop in self.loops.values() if (rival := _rival_of(loop))]
        if len(ambiguous) >= _FIRST:
            loop, rival = ambiguous[0]
            return (
                f"what they have in common looks the same in several places: {len(ambiguous)} encounters fit as well elsewhere, "
                f"local map {loop.query} over {loop.place} {rival}"
            )
        passed = sum(loop.refusal is None for loop in self.loops.values())
        return f"{_pairs(len(self.loops))} alike at one alignment, and {passed or 'none'} of them {either(passed, 'fits', 'fit')}"

    def _look_for_encounters(self) -> None:
        """Step 1."""
        proposals = [(k, proposal) for k in range(len(self.query)) for proposal in self.place.proposals(self.query, k)]
        self.proposed = len(proposals)
        for number, proposal in self._seconded(proposals):
            self._take([self._verified(number, proposal, _Belief(proposal.T_start, _within(self.config)))])

    def _seconded(self, proposals: list[tuple[int, Proposal]]) -> list[tuple[int, Proposal]]:
        """Those for which another local map of the query session looks alike at the same alignment, roughly."""
        T_place, T_query = self.place.session.T_session_map, self.query.session.T_session_map
        anchors = [
            se3.compose(se3.compose(T_place[proposal.place], proposal.T_start), se3.inverse(T_query[number]))
            for number, proposal in proposals
        ]
        kept = []
        for a, (number, proposal) in enumerate(proposals):
            for b, (other, _) in enumerate(proposals):
                if other == number:
                    continue
                xi = se3.log(
                    se3.compose(se3.inverse(se3.compose(anchors[a], T_query[other])), se3.compose(anchors[b], T_query[other]))
                )
                far = _BASIN_POSITION + _BASIN_DRIFT * self.query.way(number, other)
                if np.linalg.norm(xi[:3]) <= _BASIN_ROTATION and np.linalg.norm(xi[3:]) <= far:
                    kept.append((number, proposal))
                    break
        return kept

    def _take(self, loops: list[Loop]) -> None:
        """Keep them, one for each pair: the first that was not refused, else the last."""
        for loop in loops:
            known = self.loops.get((loop.query, loop.place))
            if known is None or known.refusal is not None:
                self.loops[loop.query, loop.place] = loop

    def _verified(self, number: int, proposal: Proposal, belief: _Belief) -> Loop:
        maps = self.query.session.maps[number], self.place.session.maps[proposal.place]
        surfaces = self.query.surface(number), self.place.surface(proposal.place)
        rms = max(self.query.rms(number), self.place.rms(proposal.place))
        loop = verify(proposal, maps, surfaces, rms, belief, self.config.slam)
        if loop.refusal is None and proposal.source != "nearby" and (turned := self._turned_rival(loop)):
            loop = replace(loop, refusal=turned)
        return loop

    def _turned_rival(self, loop: Loop) -> str | None:
        """A sentence where the maps fit as well turned."""
        own, there, c = self.query.surface(loop.query), self.place.surface(loop.place), self.config.slam
        starts = turned_rivals(
            own.points, there.points, loop.T_place_query, cell=c.descriptor.cell, reach=self.config.reach, share=_RIVAL_AGREEMENT
        )
        tolerance = _TOLERANCE * max(loop.rms, _RMS_FLOOR)
        here = fitting_share(own, there, loop.T_place_query, tolerance, c.registration) if starts else 0.0
        for start in starts:
            other = register(own, there, start, c.registration)
            if other is None:
                continue
            if fitting_share(own, there, other.T_target_source, tolerance, c.registration) >= c.rival_fit * here:
                turn = se3.log(se3.compose(se3.inverse(loop.T_place_query), other.T_target_source))[:3]
                return f"{_AS_WELL} turned by {np.rad2deg(np.linalg.norm(turn)):.0f}°"
        return None

    def _largest_agreeing(self, loops: list[Loop]) -> list[Loop]:
        """Step 2."""
        adjacent = np.eye(len(loops), dtype=np.bool_)
        for a in range(len(loops)):
            for b in range(a):
                adjacent[a, b] = adjacent[b, a] = self._agree(loops[a], loops[b])
        return [loops[k] for k in largest_clique(adjacent)]

    def _agree(self, a: Loop, b: Loop) -> bool:
        return agree(a, b, self.query.chain, self.config.slam, self.place.chain)

    def _rival(self, standing: list[Loop], chosen: list[Loop], confirmed: int) -> str | None:
        """Step 5."""
        others = [loop for loop in standing if sum(self._agree(loop, own) for own in chosen) < 0.5 * len(chosen)]
        rival = self._largest_agreeing(others) if others else []
        mine, theirs, share = len(_queries(chosen)), len(_queries(rival)), self.config.rival_share
        if theirs < max(share * mine, 1.0):
            return None
        predicted, fitting, _ = self._check_predictions(rival)
        if fitting < max(share * confirmed, self.config.least_confirmed * predicted):
            return None
        own, other = (self._joined(loops).T_world_session[1] for loops in (chosen, rival))
        middle = self.query.session.T_session_map[:, 4:].mean(axis=0)
        turn = np.rad2deg(np.linalg.norm(se3.log(se3.compose(se3.inverse(own), other))[:3]))
        far = float(np.linalg.norm(se3.act(own, middle) - se3.act(other, middle)))
        how = f"{far:.1f} m" + (f" and {turn:.0f}°" if turn > 5.0 else "")
        return f"{mine} local maps agree on where one session is in the other, but {theirs} say {how} from there, which fits too"

    def _joined(self, chosen: list[Loop]) -> JoinedGraph:
        """Both sessions with these encounters."""
        first = chosen[len(chosen) // 2]
        T = self.place.session.T_session_map[first.place], self.query.session.T_session_map[first.query]
        anchor = se3.compose(se3.compose(T[0], first.T_place_query), se3.inverse(T[1]))
        encounters = [Encounter(0, 1, loop) for loop in chosen]
        sessions = self.place.session, self.query.session
        return join(sessions, encounters, np.stack([_START, anchor]), self.config.slam.gravity_sigma)

    def _check_predictions(self, chosen: list[Loop]) -> tuple[int, int, list[Loop]]:
        """Step 4: how many pairs of local maps should lie over each other, how many do, and what was found of them."""
        joined, found = self._joined(chosen), []
        known = {(loop.query, loop.place) for loop in chosen}
        predicted = confirmed = 0
        for number, place in self._predictions(joined):
            predicted += 1
            if (number, place) in known:
                confirmed += 1
                continue
            belief = self._expected(number, place, chosen)
            start = se3.compose(se3.inverse(joined.T_world_map[0][place]), joined.T_world_map[1][number])
            found.append(self._verified(number, Proposal(place, start, "nearby"), belief))
            confirmed += self._fits(found[-1])
        return predicted, confirmed, found

    def _predictions(self, joined: JoinedGraph) -> list[tuple[int, int]]:
        """Pairs (query, place) that should lie near each other."""
        places, queries = (T[:, 4:] for T in joined.T_world_map)
        found: list[tuple[int, int]] = []
        for number, position in enumerate(queries):
            distance = np.linalg.norm(places - position, axis=1)
            near = np.argsort(distance, kind="stable")[:_PREDICTED]
            found += [(number, place) for place in near.tolist() if distance[place] <= self.config.nearby]
        return found

    def _expected(self, number: int, place: int, chosen: list[Loop]) -> _Belief:
        """What the nearest encounter and the odometry of both sessions say of another pair."""
        e = min(chosen, key=lambda loop: self.place.way(place, loop.place) + self.query.way(number, loop.query))
        T_a, S_a = self.place.chain.between(place, e.place)
        T_b, S_b = self.query.chain.between(e.query, number)
        A_a = se3.adjoint(se3.inverse(se3.compose(e.T_place_query, T_b)))
        A_e = se3.adjoint(se3.inverse(T_b))
        covariance = A_a @ S_a @ A_a.T + A_e @ e.covariance @ A_e.T + S_b
        return _Belief(se3.compose(se3.compose(T_a, e.T_place_query), T_b), covariance)

    def _fits(self, loop: Loop) -> bool:
        """Whether a predicted pair overlaps as it should; directions that are open and rivals are no matter here."""
        c = self.config.slam
        is_near = np.isfinite(loop.innovation) and loop.innovation <= loop.innovation_limit
        bound = c.largest_rms * max(loop.rms_odometry, _RMS_FLOOR)
        return bool(is_near and min(loop.overlap) >= c.least_overlap and loop.rms <= bound)

    def _too_little(self, chosen: list[Loop], predicted: int, confirmed: int) -> str | None:
        """Step 6."""
        c = self.config
        if confirmed < c.least_confirmed * predicted:
            return f"if they met, {counted(predicted, 'pair')} of local maps would lie over each other; {confirmed} of them do"
        queries, places = _queries(chosen), {loop.place for loop in chosen}
        if min(len(queries), len(places)) < c.least_encounters:
            return (
                f"{len(chosen)} encounters agree, of {len(queries)} local maps of one session and {len(places)} of the other; "
                f"{c.least_encounters} of each are asked for"
            )
        spread = min(self.query.way(min(queries), max(queries)), self.place.way(min(places), max(places)))
        if spread < c.least_spread:
            return f"the encounters that agree lie within {spread:.0f} m of way, {c.least_spread:.0f} m are asked for"
        return None

    def _open_axis(self, loops: list[Loop]) -> Floats | None:
        return open_axis(loops, self.query, self.config.slam.registration.weak_sigma)

    def _closed(self, chosen: list[Loop]) -> list[Loop]:
        """Step 3: encounters that all leave one axis open, laid over each other anew at the only shift along it that fits.

        Those that leave it open wherever they were, and do not agree with these, are looked for again as well.
        """
        axis = self._open_axis(chosen)
        if axis is None:
            return chosen
        T = self._joined(chosen).T_world_session[1]
        found = shift_along(axis, chosen, T, self.place, self.query, self.config)
        self._not_told = found.refusal
        if found.refusal is not None:
            return chosen
        T = se3.compose(T, np.array([1.0, 0.0, 0.0, 0.0, *(found.metres * axis)]))
        before = dict(self.loops)
        for key, loop in before.items():
            if loop.refusal is None and self._open_axis([loop]) is not None:
                del self.loops[key]
        again = [self._laid_again(loop, T) for loop in chosen]
        again = [loop for loop in again if loop.refusal is None]
        count = sum(self._leaves_open(loop, axis) for loop in again)
        self._take([moved_along(loop, axis, self.query, count) if self._leaves_open(loop, axis) else loop for loop in again])
        standing = [loop for loop in self.loops.values() if loop.refusal is None]
        if len(standing) < _FIRST:
            self.loops, self._not_told = before, "laid where what they see together fits, single encounters do not"
            return chosen
        return self._largest_agreeing(standing)

    def _leaves_open(self, loop: Loop, axis: Floats) -> bool:
        own = self._open_axis([loop])
        return own is not None and abs(float(own @ axis)) > _SAME_AXIS

    def _laid_again(self, loop: Loop, T_place_query: Floats) -> Loop:
        """The same two local maps, from where the sessions lie."""
        T = self.place.session.T_session_map[loop.place], self.query.session.T_session_map[loop.query]
        start = se3.compose(se3.compose(se3.inverse(T[0]), T_place_query), T[1])
        return self._verified(loop.query, Proposal(loop.place, start, "nearby"), _Belief(start, _within(self.config)))


def _rival_of(loop: Loop) -> str | None:
    """Where else an encounter fits as well: 8.0 m away, or turned by 180°; None where that is not why it was refused."""
    if loop.refusal is None or not loop.refusal.startswith(_AS_WELL):
        return None
    return loop.refusal.removeprefix(_AS_WELL).split(",")[0].strip()


def _within(config: SessionsConfig) -> Floats:
    """(6, 6) covariance of a proposal, so wide that rivals are tried within reach."""
    return np.diag(np.array([_TILT, _TILT, _YAW, *[config.reach / _SIGMAS_OF_REACH] * 3]) ** 2)


def _queries(loops: list[Loop]) -> set[int]:
    return {loop.query for loop in loops}


def _pairs(count: int) -> str:
    return f"{counted(count, 'pair')} of local maps {either(count, 'looks', 'look')}"
