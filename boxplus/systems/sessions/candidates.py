"""Which of many sessions may have met: by one index over the descriptors of all local maps, before any two are compared.

1. *Votes*: the local maps of a session vote for local maps of others, by one index over the features of all.
2. *Alignment*: those that most votes are for are aligned with it, local map by local map. What looks alike everywhere, the
   windows of a street, gets votes; that many features lie alike as well is rare where it is not the same place.

Every session keeps the few others of which most features lie alike, so that the number of pairs grows with the number of
sessions and not with its square, and so does the time. Where those that met leave several worlds, each of them but the largest
may look at a few pairs more, with sessions of other worlds.
"""

from __future__ import annotations

from collections.abc import Container, Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.descriptors.config import DescriptorConfig
from boxplus.maps.descriptors.features import Features
from boxplus.maps.descriptors.place_index import PlaceIndex

Pair = tuple[int, int]

_LEAST_VOTES = 4  # features of a local map that one of another session shares
_ALIGNED = 10  # sessions that are aligned for each one that is kept


class Looks:
    """What the local maps of all sessions look like.

    Args:
        descriptions: of the local maps of each session.
        config: settings; each has a default.

    Example:
        >>> import numpy as np
        >>> from boxplus.maps.descriptors.features import Features
        >>> random = np.random.default_rng(0)
        >>> seen = Features(random.uniform(-40, 40, (50, 2)), random.integers(0, 2**63, (50, 4)).astype(np.uint64))
        >>> other = Features(seen.xy, ~seen.bits)
        >>> Looks([[seen], [other], [other, seen]]).pairs()
        [(0, 2), (1, 2)]
    """

    def __init__(self, descriptions: Sequence[Sequence[Features]], config: DescriptorConfig | None = None) -> None:
        self._descriptions, self._index = descriptions, PlaceIndex(config)
        self._owner = np.repeat(np.arange(len(descriptions)), [len(own) for own in descriptions])
        self._score = np.zeros(len(descriptions))  # of the session at hand; few entries are touched
        for own in descriptions:
            for features in own:
                self._index.add(features)

    def pairs(self, per_session: int = 6) -> list[Pair]:
        """Pairs (a, b), a < b, of sessions to look at, in order.

        Args:
            per_session: others that each session keeps, the most alike first; sessions without any likeness have none.
        """
        apart = np.arange(len(self._descriptions))
        return sorted({pair for number in apart.tolist() for _, pair in self._alike(number, per_session, apart, ())})

    def pairs_between(self, worlds: Sequence[Sequence[int]], known: Container[Pair], per_world: int = 6) -> list[Pair]:
        """More pairs, of sessions in different worlds, to find out whether these are one.

        Args:
            worlds: numbers of the sessions of each, all of them; known: pairs that were looked at.
            per_world: pairs that each world but the largest keeps, the most alike first.
        """
        world = np.empty(len(self._descriptions), dtype=np.int64)
        for number, members in enumerate(worlds):
            world[list(members)] = number
        largest = max(range(len(worlds)), key=lambda number: len(worlds[number]))
        found: set[Pair] = set()
        for number, members in enumerate(worlds):
            if number != largest:
                alike = [scored for k in members for scored in self._alike(k, per_world, world, known)]
                found.update(pair for _, pair in sorted(alike, key=lambda scored: -scored[0])[:per_world])
        return sorted(found)

    def _alike(self, number: int, count: int, world: NDArray[np.int64], known: Container[Pair]) -> list[tuple[int, Pair]]:
        """Inliers and pair with each of the sessions of other worlds that one looks most like, so many at most."""
        voted = self._voted(number, _ALIGNED * count, world, known)
        inliers = {other: self._inliers(number, matched) for other, matched in voted.items()}
        alike = sorted(voted, key=lambda other: -inliers[other])[:count]  # stable: of as many inliers, by votes
        return [(inliers[other], _pair(number, other)) for other in alike]

    def _voted(
        self, number: int, count: int, world: NDArray[np.int64], known: Container[Pair]
    ) -> dict[int, list[tuple[int, int]]]:
        """Sessions that most votes are for, the most first, and which local map of this one is for which place of theirs."""
        best: list[tuple[NDArray[np.int64], NDArray[np.int32]]] = []
        for features in self._descriptions[number]:
            votes = self._index.votes(features).of_at_least(_LEAST_VOTES)
            by_weight = np.lexsort((-votes.weight, self._owner[votes.places]))
            others, first = np.unique(self._owner[votes.places[by_weight]], return_index=True)
            self._score[others] += votes.weight[by_weight[first]]
            best.append((others, votes.places[by_weight[first]]))
        known_to = np.unique(np.concatenate([others for others, _ in best])) if best else np.zeros(0, dtype=np.int64)
        free = [k for k in known_to[world[known_to] != world[number]].tolist() if _pair(number, k) not in known]
        free.sort(key=lambda other: -self._score[other])
        self._score[known_to] = 0.0
        found: dict[int, list[tuple[int, int]]] = {other: [] for other in free[:count]}
        for own, (others, places) in enumerate(best):
            for other, place in zip(others.tolist(), places.tolist(), strict=True):
                if other in found:
                    found[other].append((own, place))
        return found

    def _inliers(self, number: int, matched: Sequence[tuple[int, int]]) -> int:
        """Features of a session that lie alike in places of another one."""
        aligned = [self._index.align(self._descriptions[number][own], place, seed=own) for own, place in matched]
        return sum(candidate.inliers for candidate in aligned if candidate is not None)


def _pair(a: int, b: int) -> Pair:
    return (a, b) if a < b else (b, a)
