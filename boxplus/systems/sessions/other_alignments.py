"""Would two sessions fit as well otherwise, as a whole? Shifted within reach, or turned by a quarter, half or three quarters.

A hall that is the same seen from either end, a corridor with a twin: every local map has its own place there, and none of them a
rival near by. Only the sessions as wholes have one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.maps.local_maps.registration import fitting_share, register
from boxplus.systems.sessions.config import SessionsConfig
from boxplus.systems.sessions.places import Places
from boxplus.systems.slam.loop import Floats
from boxplus.systems.slam.rivals import rival_shifts, turned_rivals

_AGREEMENT = 0.6  # of density images, against that of the alignment found, for another one to be tried
_SHIFTS = 3  # tried
_POINTS = 200_000  # of a session, in its density image
_PAIRS = 8  # of local maps that are laid over each other for one alignment
_SAME_TURN = 0.2  # rad
_TOLERANCE = 2.5  # standard deviations from a plane within which a point fits
_RMS_FLOOR = 0.02  # m: successive maps that fit better than this say nothing about others


def other_alignments(place: Places, query: Places, T_place_query: Floats, config: SessionsConfig) -> list[Floats]:
    """Alignments (7,) of two sessions at which they look nearly as alike from above as at the one that was found.

    Args:
        T_place_query: (7,) of the sessions' frames, as found.
    """
    middle = np.concatenate([[1.0, 0.0, 0.0, 0.0], query.session.T_session_map[:, 4:].mean(axis=0)])
    own = _cloud(query, se3.inverse(middle))
    there = _cloud(place, np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    T, cell = se3.compose(T_place_query, middle), config.slam.descriptor.cell
    others = turned_rivals(own, there, T, cell=cell, reach=config.reach, share=_AGREEMENT)
    least, sigma = config.slam.rival_distance, np.eye(2) * (config.reach / 3.0) ** 2
    for shift in rival_shifts(own, there, T, cell=cell, least=least, sigma=sigma, share=_AGREEMENT, count=_SHIFTS):
        moved = T.copy()
        moved[4:6] += shift
        others.append(moved)
    return [se3.compose(other, se3.inverse(middle)) for other in others]


def fits_otherwise(
    place: Places, query: Places, T_place_query: Floats, others: list[Floats], config: SessionsConfig
) -> str | None:
    """A sentence on another alignment of two sessions whose local maps lie over each other as well; None where there is none.

    Args:
        T_place_query: (7,) of the sessions' frames, as found. others: from `other_alignments`.
    """
    found = _AsFound(place, query, T_place_query, config)
    for alignment in others:
        pairs = nearest_pairs(place, query, alignment, config)
        if len(pairs) < config.rival_share * len(found.places):
            continue
        tried = spread(pairs, _PAIRS)
        fitting = sum(_fits(place, query, pair, alignment, found, config) for pair in tried)
        if fitting >= config.least_confirmed * len(tried):
            return f"as wholes they fit as well {difference(query, T_place_query, alignment)}"
    return None


def difference(query: Places, T_place_query: Floats, other: Floats) -> str:
    """How another alignment of the query session differs, in words: turned by 180°, 4.0 m away."""
    middle = np.concatenate([[1.0, 0.0, 0.0, 0.0], query.session.T_session_map[:, 4:].mean(axis=0)])
    T, moved = se3.compose(T_place_query, middle), se3.compose(other, middle)
    turn = np.rad2deg(np.linalg.norm(se3.log(se3.compose(se3.inverse(T), moved))[:3]))
    return f"turned by {turn:.0f}°" if turn > 45.0 else f"{np.linalg.norm(moved[4:] - T[4:]):.1f} m away"


def spread(pairs: list[tuple[int, int]], count: int) -> list[tuple[int, int]]:
    """So many of them at most, from the first to the last."""
    return [pairs[k] for k in np.unique(np.linspace(0, len(pairs) - 1, count).round().astype(int))] if pairs else []


def _cloud(places: Places, T: Floats) -> NDArray[np.float32]:
    """Points (N, 3) of a session in its frame moved by T (7,), about as many of each local map."""
    maps = places.session.maps
    step = max(sum(len(local_map.points) for local_map in maps) // _POINTS, 1)
    parts = [
        se3.act(se3.compose(T, pose), local_map.points[::step].astype(np.float64)).reshape(-1, 3)
        for local_map, pose in zip(maps, places.session.T_session_map, strict=True)
    ]
    return np.concatenate(parts).astype(np.float32)


def nearest_pairs(place: Places, query: Places, T_place_query: Floats, config: SessionsConfig) -> list[tuple[int, int]]:
    """For each local map of the query session the one of the other that lies nearest under an alignment, and near."""
    positions = place.session.T_session_map[:, 4:]
    found = []
    for number, p in enumerate(se3.act(T_place_query, query.session.T_session_map[:, 4:]).reshape(-1, 3)):
        distance = np.linalg.norm(positions - p, axis=1)
        nearest = int(np.argmin(distance))
        if distance[nearest] <= config.nearby:
            found.append((number, nearest))
    return found


def laid_over(place: Places, query: Places, pair: tuple[int, int], T_place_query: Floats) -> Floats:
    """(7,) where an alignment of two sessions puts a local map of the query session in the frame of one of the other's."""
    number, where = pair
    T_place, T_query = place.session.T_session_map[where], query.session.T_session_map[number]
    return se3.compose(se3.inverse(T_place), se3.compose(T_place_query, T_query))


class _AsFound:
    """How well local maps of the query session lie where the alignment that was found has them; each looked at once.

    Attributes:
        T_place_query: (7,) that alignment. places: the local map that each of the query session's lies over, where one is near.
    """

    def __init__(self, place: Places, query: Places, T_place_query: Floats, config: SessionsConfig) -> None:
        self.T_place_query = T_place_query
        self.places = dict(nearest_pairs(place, query, T_place_query, config))
        self._sessions, self._config = (place, query), config.slam.registration
        self._share: dict[int, tuple[float, float]] = {}

    def share(self, number: int) -> tuple[float, float]:
        """Of the points of a local map, those within a tolerance of a plane, and that tolerance [m]; none where none is near."""
        if number not in self._share:
            self._share[number] = self._measured(number)
        return self._share[number]

    def _measured(self, number: int) -> tuple[float, float]:
        place, query = self._sessions
        where = self.places.get(number)
        if where is None or not (len(query.session.maps[number].points) and len(place.session.maps[where].points)):
            return 0.0, _TOLERANCE * _RMS_FLOOR
        own, there = query.surface(number), place.surface(where)
        found = register(own, there, laid_over(place, query, (number, where), self.T_place_query), self._config)
        if found is None:
            return 0.0, _TOLERANCE * _RMS_FLOOR
        tolerance = _TOLERANCE * max(found.rms, _RMS_FLOOR)
        return fitting_share(own, there, found.T_target_source, tolerance, self._config), tolerance


def is_same(xi: Floats, config: SessionsConfig) -> bool:
    """Whether a registration from elsewhere came back to where a pair was found, xi (6,) away from there."""
    return bool(np.linalg.norm(xi[:3]) < _SAME_TURN and np.linalg.norm(xi[3:]) < config.slam.rival_distance)


def _fits(
    place: Places, query: Places, pair: tuple[int, int], T_other: Floats, as_found: _AsFound, config: SessionsConfig
) -> bool:
    """Whether two local maps overlap as they should where another alignment puts them, stay there, and fit as well as found.

    Streets cross at right angles, and the ground is the ground: half of a city's points lie on surfaces of another street of it.
    """
    number, where = pair
    if not (len(query.session.maps[number].points) and len(place.session.maps[where].points)):
        return False
    start, first = (laid_over(place, query, pair, A) for A in (T_other, as_found.T_place_query))
    own, there = query.surface(number), place.surface(where)
    found = register(own, there, start, config.slam.registration)
    if found is None:
        return False
    from_other, from_first = (se3.log(se3.compose(se3.inverse(A), found.T_target_source)) for A in (start, first))
    if np.linalg.norm(from_other[3:]) > config.nearby or is_same(from_first, config):
        return False
    bound = config.slam.largest_rms * max(query.rms(number), place.rms(where), _RMS_FLOOR)
    if min(found.overlap) < config.slam.least_overlap or found.rms > bound:
        return False
    share, tolerance = as_found.share(number)
    here = fitting_share(own, there, found.T_target_source, tolerance, config.slam.registration)
    return here >= config.slam.rival_fit * share
