"""Which sessions are looked at: those that share a place, whatever all places have in common."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.maps.descriptors.features import Features
from boxplus.systems.sessions.candidates import Looks


def place(random: np.random.Generator, count: int = 60) -> Features:
    return Features(random.uniform(-40, 40, (count, 2)), random.integers(0, 2**63, (count, 4)).astype(np.uint64))


def road(count: int, seed: int = 1) -> list[list[Features]]:
    """Sessions along a road, each of which shares a place with the next one."""
    random = np.random.default_rng(seed)
    places = [place(random) for _ in range(count + 1)]
    return [[places[k], places[k + 1]] for k in range(count)]


def chain(count: int) -> list[tuple[int, int]]:
    return [(k, k + 1) for k in range(count - 1)]


def alike_everywhere(sessions: list[list[Features]], count: int, seed: int = 2) -> list[list[Features]]:
    """The same patterns in every place, each time elsewhere in it: windows, trees, parked cars."""
    random = np.random.default_rng(seed)
    common = random.integers(0, 2**63, (count, 4)).astype(np.uint64)
    return [
        [
            Features(np.concatenate([own.xy, random.uniform(-40, 40, (count, 2))]), np.concatenate([own.bits, common]))
            for own in session
        ]
        for session in sessions
    ]


@pytest.mark.parametrize("count", [5, 40])
def test_sessions_that_share_a_place_are_looked_at(count: int) -> None:
    assert Looks(road(count)).pairs(3) == chain(count)


def test_pairs_grow_with_the_number_of_sessions_not_its_square() -> None:
    assert len(Looks([road(1)[0]] * 12).pairs(2)) <= 24


@pytest.mark.parametrize("seed", range(4))
def test_what_is_seen_everywhere_hides_no_place(seed: int) -> None:
    """Three times as many features in common with every other session as with the one that was at the same place."""
    sessions = [[Features(own.xy[:15], own.bits[:15]) for own in session] for session in road(30, seed)]
    found = Looks(alike_everywhere(sessions, 45, seed)).pairs(2)
    assert set(chain(30)) <= set(found)
    assert len(found) <= 60


def test_worlds_apart_are_looked_at_again_and_no_pair_twice() -> None:
    """Two roads that nothing joins, and one road that is known in two halves."""
    looks = Looks(road(10))
    first = looks.pairs(1)
    halves = [[0, 1, 2, 3, 4, 5], [6, 7, 8, 9]]
    assert looks.pairs_between(halves, (), 3) == [(5, 6)]
    assert looks.pairs_between(halves, {(5, 6)}, 3) == []
    assert looks.pairs_between([[k] for k in range(10)], set(first), 9) == sorted(set(chain(10)) - set(first))
    strangers = Looks([*road(3, 1), *road(3, 2)])
    assert strangers.pairs_between([[0, 1, 2], [3, 4, 5]], (), 6) == []


def test_sessions_without_likeness_have_no_pairs() -> None:
    random = np.random.default_rng(3)
    none = Features(np.zeros((0, 2)), np.zeros((0, 4), np.uint64))
    assert Looks([[place(random)], [none], [], [place(random)]]).pairs() == []
