"""Which of many places looks like this one: an index over the binary features of all local maps.

Locality-sensitive hashing: each table keys a descriptor by some of its bits, so that descriptors that differ little meet in a
bucket of one table or another, and a query looks at a few hundred thousandths of all. The number of key bits grows with the
number of features, which keeps buckets short. A place gets a vote for every query feature that has a match in it. What is seen in
many places tells little of where one is: a vote weighs the less, the more places a feature votes for. The places of most weight
are matched feature by feature and aligned by a rigid motion of the ground.

Sources: Indyk and Motwani, Approximate Nearest Neighbors, STOC 1998 (bit sampling for the Hamming distance); Sparck Jones, A
Statistical Interpretation of Term Specificity and its Application in Retrieval, Journal of Documentation 28(1), 1972 (weights).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_settings
from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.maps.descriptors.config import DescriptorConfig
from boxplus.maps.descriptors.features import WORDS, Features, hamming, match_features
from boxplus.maps.descriptors.rigid_2d import RigidMotion2D, find_rigid_motion

_TABLES = 8
_LEAST_BITS, _MOST_BITS = 10, 24  # of a key
_WALK = 16  # entries of a bucket looked at, the newest first: fuller buckets are of patterns that tell nothing
_LEAST_VOTES = 2
_FIRST = 4096  # features that there is room for in the beginning
_END = -1


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A place that looks like the query.

    Attributes:
        place: number of the place.
        motion: T_place_query on the ground: takes the query's x, y to the place's.
        inliers: matches that the motion explains; matches: of how many.
        seen_at: (inliers, 2) where they lie in the place [m].
    """

    place: int
    motion: RigidMotion2D
    inliers: int
    matches: int
    seen_at: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Votes:
    """Places that have features of a query.

    Attributes:
        places: (n,) int32 their numbers, ascending.
        count: (n,) int32 features of the query that have a match there.
        weight: (n,) sum of what each of these tells: log(1 + N/m) of one that has a match in m of N places.
    """

    places: NDArray[np.int32]
    count: NDArray[np.int32]
    weight: NDArray[np.float64]

    def of_at_least(self, count: int) -> Votes:
        """Those places that have so many features of the query."""
        many = self.count >= count
        return Votes(self.places[many], self.count[many], self.weight[many])


class PlaceIndex:
    """Features of places, numbered 0, 1, … as they are added.

    Example:
        >>> import numpy as np
        >>> from boxplus.maps.descriptors.features import Features
        >>> random = np.random.default_rng(0)
        >>> place = Features(random.uniform(-40, 40, (50, 2)), random.integers(0, 2**63, (50, 4)).astype(np.uint64))
        >>> index = PlaceIndex()
        >>> index.add(place)
        >>> [(c.place, c.inliers) for c in index.candidates(place)]
        [(0, 50)]
    """

    def __init__(self, config: DescriptorConfig | None = None) -> None:
        self.config = as_settings(DescriptorConfig, config)
        self._places: list[Features] = []
        self._count = 0
        self._bits = np.zeros((_FIRST, WORDS), dtype=np.uint64)
        self._place_of = np.zeros(_FIRST, dtype=np.int32)
        # Scratch of a query, which leaves it as it was: a query looks at few places, however many there are.
        self._voted, self._votes = np.full(_FIRST, _END, dtype=np.int32), np.zeros(_FIRST, dtype=np.int32)
        self._weights = np.zeros(_FIRST)
        self._touched, self._here = np.zeros(_FIRST, dtype=np.int32), np.zeros(_FIRST, dtype=np.int32)
        # Bits that key a table, fixed once: as many as a key may ever have.
        random = np.random.Generator(np.random.PCG64(20240514))
        self._sampled = np.stack([random.permutation(64 * WORDS)[:_MOST_BITS] for _ in range(_TABLES)]).astype(np.uint64)
        self._new_tables()

    def __len__(self) -> int:
        return len(self._places)

    def add(self, place: Features) -> None:
        """Add the next place."""
        more = len(place.bits)
        if self._count + more > len(self._bits):
            capacity = len(self._bits)
            while capacity < self._count + more:
                capacity *= 2
            self._bits = np.concatenate([self._bits, np.zeros((capacity - len(self._bits), WORDS), dtype=np.uint64)])
            self._place_of = np.concatenate([self._place_of, np.zeros(capacity - len(self._place_of), dtype=np.int32)])
            self._new_tables()
        self._bits[self._count : self._count + more] = place.bits
        self._place_of[self._count : self._count + more] = len(self._places)
        _file(self._bits, self._count, self._count + more, self._sampled, self._key_bits, self._head, self._next)
        self._count += more
        self._places.append(place)
        if len(self._places) > len(self._voted):
            size = 2 * len(self._voted)
            self._voted, self._votes = np.full(size, _END, dtype=np.int32), np.zeros(size, dtype=np.int32)
            self._weights = np.zeros(size)
            self._touched, self._here = np.zeros(size, dtype=np.int32), np.zeros(size, dtype=np.int32)

    def votes(self, query: Features, before: int | None = None) -> Votes:
        """What the features of a query say of where it is; nothing of places from `before` on."""
        last = len(self._places) if before is None else min(before, len(self._places))
        if last <= 0 or not len(query.bits):
            return Votes(np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.int32), np.zeros(0))
        count = _vote(
            query.bits, self._bits, self._place_of, self._sampled, self._key_bits, self._head, self._next,
            np.uint64(self.config.max_distance), np.int32(last),
            self._voted, self._votes, self._weights, self._touched, self._here,
        )  # fmt: skip
        places = np.sort(self._touched[:count])
        found = Votes(places, self._votes[places], self._weights[places])
        self._voted[places], self._votes[places], self._weights[places] = _END, 0, 0.0
        return found

    def candidates(self, query: Features, *, before: int | None = None, seed: int = 0) -> list[Candidate]:
        """Places that look like the query, the most inliers first.

        Args:
            query: its features.
            before: only places of smaller numbers.
            seed: of the sampling of matches.
        """
        votes = self.votes(query, before).of_at_least(_LEAST_VOTES)
        best = np.argsort(-votes.weight, kind="stable")[: self.config.candidates]
        found = []
        for place in votes.places[best].tolist():
            candidate = self.align(query, place, seed)
            if candidate is not None:
                found.append(candidate)
        return sorted(found, key=lambda candidate: -candidate.inliers)

    def align(self, query: Features, place: int, seed: int = 0) -> Candidate | None:
        """The query against one place; None where fewer matches agree than the settings ask for.

        Raises:
            InputError: no such place.
        """
        if not 0 <= place < len(self._places):
            raise InputError(f"a place from 0 to {len(self._places) - 1}", f"{place}", "add it first")
        there = self._places[place]
        matches = match_features(query, there, self.config.max_distance)
        p, q = query.xy[matches[:, 0]], there.xy[matches[:, 1]]
        motion = find_rigid_motion(p, q, self.config.inlier_distance, seed)
        if motion is None or int(motion.inliers.sum()) < self.config.least_inliers:
            return None
        return Candidate(place, motion, int(motion.inliers.sum()), len(matches), q[motion.inliers])

    def _new_tables(self) -> None:
        """Empty tables for all the features there is room for, in four times as many buckets, and those known filed in them."""
        self._key_bits = min(max(int(np.log2(len(self._bits))) + 2, _LEAST_BITS), _MOST_BITS)
        self._head = np.full((_TABLES, 2**self._key_bits), _END, dtype=np.int32)
        self._next = np.full((_TABLES, len(self._bits)), _END, dtype=np.int32)
        _file(self._bits, 0, self._count, self._sampled, self._key_bits, self._head, self._next)


@kernel(inline=True)
def _key(bits: NDArray[np.uint64], i: int, sampled: NDArray[np.uint64], table: int, key_bits: int) -> np.uint64:
    key = np.uint64(0)
    for k in range(np.uint64(key_bits)):
        bit = sampled[table, k]
        key = (key << np.uint64(1)) | ((bits[i, bit >> np.uint64(6)] >> (bit & np.uint64(63))) & np.uint64(1))
    return key


@kernel
def _file(
    bits: NDArray[np.uint64],
    begin: int,
    end: int,
    sampled: NDArray[np.uint64],
    key_bits: int,
    head: NDArray[np.int32],
    following: NDArray[np.int32],
) -> None:
    """Put features [begin, end) in front of the chains of their buckets."""
    for table in range(np.uint64(len(head))):
        for i in range(np.uint64(begin), np.uint64(end)):
            key = _key(bits, i, sampled, table, key_bits)
            following[table, i] = head[table, key]
            head[table, key] = np.int32(i)


@kernel
def _vote(
    query: NDArray[np.uint64],
    bits: NDArray[np.uint64],
    place_of: NDArray[np.int32],
    sampled: NDArray[np.uint64],
    key_bits: int,
    head: NDArray[np.int32],
    following: NDArray[np.int32],
    max_distance: np.uint64,
    last: np.int32,
    voted: NDArray[np.int32],
    votes: NDArray[np.int32],
    weights: NDArray[np.float64],
    touched: NDArray[np.int32],
    here: NDArray[np.int32],
) -> np.int64:
    """One vote of every query feature for every place below `last` with a feature near it; returns how many places have one.

    These are written to `touched`; `voted`, filled with −1, `votes` and `weights`, with zeros, are left as they are for no other
    place. `here` is room for the places that one feature votes for.
    """
    count = np.uint64(0)
    for i in range(np.uint64(len(query))):
        matched = np.uint64(0)
        for table in range(np.uint64(len(head))):
            found = head[table, _key(query, i, sampled, table, key_bits)]
            for _ in range(_WALK):
                if found < 0:
                    break
                place = place_of[found]
                if place < last and voted[place] != np.int32(i) and hamming(query, i, bits, np.uint64(found)) <= max_distance:
                    if voted[place] < 0:
                        touched[count] = place
                        count += np.uint64(1)
                    voted[place] = np.int32(i)
                    here[matched] = place
                    matched += np.uint64(1)
                found = following[table, found]
        weight = math.log(1.0 + last / max(matched, np.uint64(1)))
        for k in range(matched):
            votes[here[k]] += np.int32(1)
            weights[here[k]] += weight
    return np.int64(count)
