"""Where a local map may have been before: what looks like it, and what should be near it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._extras import require
from boxplus.manifolds import se3
from boxplus.maps.descriptors.features import WORDS, Features, describe
from boxplus.maps.descriptors.place_index import Candidate, PlaceIndex
from boxplus.maps.descriptors.scan_context import ScanContextIndex, scan_context
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.systems.slam.config import SlamConfig
from boxplus.systems.slam.loop import Source
from boxplus.systems.slam.odometry_chain import OdometryChain
from boxplus.systems.slam.rivals import best_shift

Floats = NDArray[np.float64]
Maps = Callable[[int], LocalMap]

_CONTEXTS = 3  # places looked at that have a similar scan context
_CONTEXT_REACH = 8.0  # m, from which a place still has a similar one


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """A place to lay a query over, from T_start (7,) = T_place_query."""

    place: int
    T_start: Floats
    source: Source
    inliers: int = 0


class Proposer:
    """Knows what all local maps so far look like.

    Raises:
        InputError: OpenCV, the extra `vision`, is not installed and density images are wanted.
    """

    def __init__(self, config: SlamConfig) -> None:
        self._config = config
        self._densities = PlaceIndex(config.descriptor)
        self._contexts = ScanContextIndex()
        if config.appearance == "density":
            require("cv2", "which describes density images")  # now, not after the first local map

    def propose(self, query: int, maps: Maps, before: int, odometry: OdometryChain, T_map: Floats) -> list[Proposal]:
        """Places before number `before` for the newest map, number `query`, which is remembered for later ones.

        Args:
            maps: gives a map by its number; T_map: (query + 1, 7) of each, as estimated now.
        """
        found: list[Proposal] = []
        if self._config.appearance == "density":
            features = described(maps(query), self._config)
            found = [seen(candidate) for candidate in self._densities.candidates(features, before=before, seed=query)]
            self._densities.add(features)
        if self._config.appearance != "none":
            context = scan_context(maps(query).points, self._config.context_range)
            if not found:
                alike = self._contexts.candidates(context, before=before, count=_CONTEXTS)
                found = [
                    turned(maps(query), maps(place), place, yaw, self._config)
                    for place, far, yaw in alike
                    if far <= self._config.context_distance
                ]
            self._contexts.add(context)
        return found + (_near(query, odometry, before, T_map, self._config) if before > 0 else [])


def described(local_map: LocalMap, config: SlamConfig) -> Features:
    """The features of a local map; none of one without points."""
    if not len(local_map.points):  # of lost scans only: nothing to be recognised by, but the index counts on
        return Features(np.zeros((0, 2)), np.zeros((0, WORDS), np.uint64))
    return describe(local_map.points, config.descriptor)


def turned(query: LocalMap, place: LocalMap, number: int, yaw: float, config: SlamConfig) -> Proposal:
    """A scan context tells the yaw; where the query is in the place, the correlation of the density images does."""
    T = np.array([np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw), 0.0, 0.0, 0.0])
    T[4:6] = best_shift(query.points, place.points, T, config.descriptor.cell, _CONTEXT_REACH)
    return Proposal(number, T, "scan context")


def seen(candidate: Candidate) -> Proposal:
    """A place whose density image looks like the query's."""
    yaw = candidate.motion.yaw
    T = np.array([np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw), *candidate.motion.t, 0.0])
    return Proposal(candidate.place, T, "appearance", candidate.inliers)


def _near(query: int, odometry: OdometryChain, before: int, T_map: Floats, config: SlamConfig) -> list[Proposal]:
    """The nearest places, no two of them neighbours along the way, where one knows well enough where one is."""
    distance = np.linalg.norm(T_map[:before, 4:] - T_map[query, 4:], axis=1)
    near = np.flatnonzero(distance <= config.nearby)
    found: list[Proposal] = []
    for place in near[np.argsort(distance[near], kind="stable")].tolist():
        if len(found) >= config.nearby_count:
            break
        if any(abs(place - other.place) <= 1 for other in found):
            continue
        _, covariance = odometry.between(place, query)
        if np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]) > config.nearby_sigma:
            continue
        found.append(Proposal(place, se3.compose(se3.inverse(T_map[place]), T_map[query]), "nearby"))
    return found
