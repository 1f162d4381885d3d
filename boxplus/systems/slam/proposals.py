"""Where a local map may have been before: what looks like it, and what should be near it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.maps.descriptors.features import Features
from boxplus.maps.descriptors.place_index import Candidate, PlaceIndex
from boxplus.systems.slam.config import SlamConfig
from boxplus.systems.slam.loop import Source
from boxplus.systems.slam.odometry_chain import OdometryChain

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """A place to lay a query over, from T_start (7,) = T_place_query."""

    place: int
    T_start: Floats
    source: Source
    inliers: int = 0


def propose(
    query: int,
    features: Features | None,
    index: PlaceIndex,
    odometry: OdometryChain,
    before: int,
    T_map: Sequence[Floats],
    config: SlamConfig,
) -> list[Proposal]:
    """Places before number `before` for a query, each once for every start that differs.

    Args:
        features: of the query; None where density images are not used.
        T_map: (7,) of every local map up to the query, as estimated now.
    """
    if before <= 0:
        return []
    found = [] if features is None else [_seen(candidate) for candidate in index.candidates(features, before=before, seed=query)]
    return found + _near(query, odometry, before, T_map, config)


def _seen(candidate: Candidate) -> Proposal:
    yaw = candidate.motion.yaw
    T = np.array([np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw), *candidate.motion.t, 0.0])
    return Proposal(candidate.place, T, "appearance", candidate.inliers)


def _near(query: int, odometry: OdometryChain, before: int, T_map: Sequence[Floats], config: SlamConfig) -> list[Proposal]:
    """The nearest places, no two of them neighbours along the way, where one knows well enough where one is."""
    positions = np.stack(T_map[:before])[:, 4:]
    distance = np.linalg.norm(positions - T_map[query][4:], axis=1)
    found: list[Proposal] = []
    for place in np.argsort(distance, kind="stable").tolist():
        if len(found) >= config.nearby_count or distance[place] > config.nearby:
            break
        if any(abs(place - other.place) <= 1 for other in found):
            continue
        _, covariance = odometry.between(place, query)
        if np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]) > config.nearby_sigma:
            continue
        found.append(Proposal(place, se3.compose(se3.inverse(T_map[place]), T_map[query]), "nearby"))
    return found
