"""Runs of one recording: they agree wherever they are looked at, and count as if it had been made twice."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from boxplus.errors import InputError
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.runs.lidar_inertial.summary import RunSummary

_FEWEST_POINTS = 100  # of a local map that only a copy has; fewer may be alike by chance
_WAY_SHARE, _WAY_M = 0.02, 0.05  # ways of two runs of one recording with other settings differ by less

_Facts = tuple[str, int, float, int]


@dataclass(frozen=True, slots=True)
class RecordingIdentity:
    """What tells the recording of a run from others, wherever it lies and whatever the settings were.

    Attributes:
        facts: topic, number of messages, length [s] and time of the last scan [ns]; None where the run does not know them.
        first_points: digests of the points of the first scan, by shells of distance: simulated ones have the rest in common,
            as their clocks begin alike and their ways may be as long as each other. None where an older run did not keep them.
        way_m: length of the way that was found [m].
        maps: of the points of each local map; a copied folder has the same.
    """

    facts: _Facts | None
    first_points: tuple[str | None, ...] | None
    way_m: float
    maps: frozenset[bytes]

    @classmethod
    def of(cls, odometry: RunSummary, maps: Iterable[LocalMap]) -> RecordingIdentity:
        """Of a finished run and its local maps."""
        recording = odometry.recording
        facts = None
        if odometry.last_time_ns is not None:
            facts = (recording.lidar_topic, recording.messages, recording.duration_s, odometry.last_time_ns)
        digests = (
            hashlib.blake2b(np.ascontiguousarray(own.points).tobytes(), digest_size=16).digest()
            for own in maps
            if len(own.points) >= _FEWEST_POINTS
        )
        return cls(facts, recording.first_points, odometry.path_length_m, frozenset(digests))

    def begins_like(self, other: RecordingIdentity) -> bool:
        """Whether two with the same facts begin with the same points; where one does not know, whether they go equally far."""
        shells = zip(self.first_points or (), other.first_points or (), strict=False)
        told = [own == others for own, others in shells if own is not None and others is not None]
        if told:
            return any(told)
        return abs(self.way_m - other.way_m) <= _WAY_M + _WAY_SHARE * max(self.way_m, other.way_m)


def repeated(identities: Mapping[str, RecordingIdentity]) -> dict[str, str]:
    """Runs that are of the recording of an earlier one: their names, with that one's.

    The time is linear in their number, but for those with the same facts.
    """
    owner: dict[bytes, str] = {}
    same_facts: dict[_Facts, list[str]] = {}
    found: dict[str, str] = {}
    for name, own in identities.items():
        alike = [owner[key] for key in own.maps if key in owner]
        if own.facts is not None:
            alike += [other for other in same_facts.get(own.facts, []) if identities[other].begins_like(own)]
        if alike:
            found[name] = alike[0]
            continue
        owner |= dict.fromkeys(own.maps, name)
        if own.facts is not None:
            same_facts.setdefault(own.facts, []).append(name)
    return found


def refuse_repeated(identities: Mapping[str, RecordingIdentity]) -> None:
    """Refuse runs of one recording.

    Raises:
        InputError: a copied folder, or one recording run again, with other settings or not.
    """
    for again, first in repeated(identities).items():
        raise InputError(
            "runs of different recordings",
            f"{first} and {again}, which are of one recording: it was run twice, or a folder was copied",
            "leave one of them out",
        )
