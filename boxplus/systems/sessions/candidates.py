"""Which of many sessions may have met: by one index over the descriptors of all local maps, before any two are compared.

Every session keeps the few others that its local maps look most like, so that the number of pairs grows with the number of
sessions and not with its square.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from boxplus.maps.descriptors.config import DescriptorConfig
from boxplus.maps.descriptors.features import Features
from boxplus.maps.descriptors.place_index import PlaceIndex

_LEAST_VOTES = 4  # features of a local map that one of another session shares


def candidate_pairs(
    descriptions: Sequence[Sequence[Features]], config: DescriptorConfig | None = None, *, per_session: int = 6
) -> list[tuple[int, int]]:
    """Pairs (a, b), a < b, of sessions to look at, in order.

    Args:
        descriptions: of the local maps of each session.
        per_session: others that each session keeps, the most alike first; sessions without any likeness have none.

    Example:
        >>> import numpy as np
        >>> from boxplus.maps.descriptors.features import Features
        >>> random = np.random.default_rng(0)
        >>> seen = Features(random.uniform(-40, 40, (50, 2)), random.integers(0, 2**63, (50, 4)).astype(np.uint64))
        >>> other = Features(seen.xy, ~seen.bits)
        >>> candidate_pairs([[seen], [other], [other, seen]])
        [(0, 2), (1, 2)]
    """
    index = PlaceIndex(config)
    owner = np.repeat(np.arange(len(descriptions)), [len(own) for own in descriptions])
    score = np.zeros(len(descriptions), dtype=np.int64)  # of the session at hand; few entries are touched
    for own in descriptions:
        for features in own:
            index.add(features)
    found: set[tuple[int, int]] = set()
    for number, own in enumerate(descriptions):
        alike = []
        for features in own:
            places, votes = index.votes(features)
            many = votes >= _LEAST_VOTES
            others, first = np.unique(owner[places[many]], return_index=True)  # places of a session follow each other
            if len(others):
                score[others] += np.maximum.reduceat(votes[many], first)
                alike.append(others)
        if not alike:
            continue
        score[number] = 0
        others = np.unique(np.concatenate(alike))
        for other in others[np.argsort(-score[others], kind="stable")[:per_session]].tolist():
            if score[other] > 0:
                found.add((min(number, other), max(number, other)))
        score[others] = 0
    return sorted(found)
