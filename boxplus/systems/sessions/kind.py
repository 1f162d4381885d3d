"""One place, or two of a kind? Racks, columns and walls lie over each other in any two aisles of a warehouse.

How well two of a kind do, the sessions tell themselves: shifted by a bay or turned by half they have the same kind of place, with
other things in it. Let d be the mean distance of what stands in one of them from the planes of the other, each point counted with
15 cm at most, and without a plane with that. At the right alignment most of what is in the racks lies where it did; at that of
another aisle it fits no better than at the next bay. The lead is 1 − d/d', with the smallest d' of all other alignments; where
nothing looks alike elsewhere d' is those 15 cm.
"""

from __future__ import annotations

from dataclasses import dataclass

from boxplus.manifolds import se3
from boxplus.maps.local_maps.registration import mean_distance, register
from boxplus.systems.sessions.config import SessionsConfig
from boxplus.systems.sessions.other_alignments import difference, is_same, laid_over, nearest_pairs, spread
from boxplus.systems.sessions.places import Places
from boxplus.systems.slam.loop import Floats
from boxplus.systems.slam.structure import upright_where_seen

_FAR = 0.15  # m, that a point is off a plane at most
_PAIRS = 6  # of local maps, for one alignment
_FEWEST = 500  # points that stand, for an alignment to be compared


@dataclass(frozen=True, slots=True)
class Lead:
    """By what part less than at the best other alignment what stands is off the planes.

    Attributes:
        share: 1 − d/d'.
        over: where that other alignment is, in words; None where no other one looks alike.
    """

    share: float
    over: str | None


def lead_of(place: Places, query: Places, T_place_query: Floats, others: list[Floats], config: SessionsConfig) -> Lead | None:
    """The lead of an alignment (7,) of two sessions over others that look alike; None where too little stands to compare."""
    here = _distance(place, query, T_place_query, None, config)
    if here is None:
        return None
    rivals = [(d, other) for other in others if (d := _distance(place, query, other, T_place_query, config)) is not None]
    nearest, best = min(rivals, key=lambda rival: rival[0], default=(_FAR, None))
    share = 1.0 - here / max(nearest, 1e-9)
    return Lead(share, None if best is None else difference(query, T_place_query, best))


def _distance(place: Places, query: Places, T_place_query: Floats, found: Floats | None, config: SessionsConfig) -> float | None:
    """Mean distance of what stands in local maps that an alignment lays over each other, each pair registered from there [m].

    Args:
        found: (7,) the alignment that was found; a pair that comes back to it does not count.
    """
    registration, total, count = config.slam.registration, 0.0, 0
    for pair in spread(nearest_pairs(place, query, T_place_query, config), _PAIRS):
        own, there = query.surface(pair[0]), place.surface(pair[1])
        if not (len(own.points) and len(there.points)):
            continue
        made = register(own, there, laid_over(place, query, pair, T_place_query), registration)
        if made is None:
            continue
        T = made.T_target_source
        if found is not None:
            first = laid_over(place, query, pair, found)
            if is_same(se3.log(se3.compose(se3.inverse(first), T)), config):
                continue
        for a, b, T_b_a in ((own, there, T), (there, own, se3.inverse(T))):
            stands = upright_where_seen(a, b, T_b_a, registration)
            if len(stands):
                total += len(stands) * mean_distance(stands, b, T_b_a, _FAR, registration)
                count += len(stands)
    return total / count if count >= _FEWEST else None
