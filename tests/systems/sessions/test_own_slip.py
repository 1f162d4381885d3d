"""Whether the odometry of a single run slipped: what it saw before and after is laid over each other as two sessions are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.simulation.drifting_drive import DriftConfig
from boxplus.simulation.worlds.worlds import city
from boxplus.systems.sessions import own_slip as module
from boxplus.systems.sessions.config import SessionsConfig
from boxplus.systems.sessions.encounter import Meeting
from boxplus.systems.sessions.own_slip import own_slip
from boxplus.systems.sessions.places import Places
from boxplus.systems.slam.loop import Loop
from boxplus.systems.slam.slam import Slam
from tests.systems.sessions.sessions import drawn, measured
from tests.systems.slam.drives import mapped_drive

Poses = NDArray[np.float64]

LAP = 10  # local maps of a lap, of which there are two
SLIP = np.array([1.0, 0.0, 0.0, 0.0, 9.0, 4.0, 0.0])
HERE = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def laps() -> list[LocalMap]:
    """Twice round a circle of 200 m; local maps without points."""
    angle = 2.0 * np.pi * np.arange(2 * LAP) / LAP
    yaw = 0.5 * (angle + 0.5 * np.pi)
    zero = np.zeros(2 * LAP)
    T = np.column_stack([np.cos(yaw), zero, zero, np.sin(yaw), 32.0 * np.cos(angle), 32.0 * np.sin(angle), zero])
    return list(drawn("laps", T).maps)


def far(maps: Sequence[LocalMap], queries: Sequence[int], off: Poses = SLIP) -> list[Loop]:
    """Loops a lap apart that say that the second lap lies off by as much, and were refused for it unlooked at."""
    loops = []
    for query in queries:
        place = maps[query - LAP].T_odo_map
        T = se3.compose(se3.inverse(place), se3.compose(off, maps[query].T_odo_map))
        loops.append(replace(measured(query - LAP, query, T), weight=0.0, refusal="looks alike, but far off"))
    return loops


def closed(queries: Sequence[int]) -> list[Loop]:
    """Loops a lap apart that agree with the odometry."""
    return [replace(measured(query - LAP, query, HERE), innovation=1.0, innovation_limit=4.7) for query in queries]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """What `meet` was asked: numbers of local maps of either stretch; it joins them where the second lap lies off by SLIP."""
    calls: list[tuple[int, int]] = []

    def joined(place: Places, query: Places, config: SessionsConfig) -> Meeting:
        del config
        calls.append((len(place), len(query)))
        pairs = [measured(k, k, HERE) for k in range(2, min(len(place), len(query)) - 2)]
        return Meeting(0, 1, pairs, SLIP, 1e-4 * np.eye(6))

    monkeypatch.setattr(module, "meet", joined)
    return calls


def test_far_loops_that_agree_and_stretches_that_met_are_a_slip(asked: list[tuple[int, int]]) -> None:
    maps = laps()
    text = own_slip(2 * LAP, maps.__getitem__, far(maps, [13, 14, 15, 16]))
    assert asked == [(8, 8)]
    assert text is not None and text.startswith(
        "the odometry slipped by 9.8 m between local maps 6 and 13, or two stretches of way"
    )
    assert "4 pairs of local maps, of 3 to 6 and 13 to 16, fit each other" in text and "boxplus map merge" in text


def test_single_far_loops_and_those_that_do_not_agree_are_places_that_look_alike(asked: list[tuple[int, int]]) -> None:
    maps = laps()
    others = [far(maps, [k], np.array([1.0, 0.0, 0.0, 0.0, 30.0 * k, 0.0, 0.0]))[0] for k in range(11, 18)]
    assert own_slip(2 * LAP, maps.__getitem__, [*far(maps, [13, 14]), *others]) is None
    assert own_slip(2 * LAP, maps.__getitem__, []) is None
    assert own_slip(0, maps.__getitem__, []) is None
    assert not asked


def test_loops_that_are_closed_across_the_same_way_bear_the_odometry_out(asked: list[tuple[int, int]]) -> None:
    maps, queries = laps(), [13, 14, 15, 16]
    assert own_slip(2 * LAP, maps.__getitem__, [*far(maps, queries), *closed(queries)]) is None
    assert not asked  # which costs seconds
    assert own_slip(2 * LAP, maps.__getitem__, [*far(maps, queries), *closed([15])]) is not None
    forced = [replace(loop, source="forced") for loop in closed(queries)]
    assert own_slip(2 * LAP, maps.__getitem__, [*far(maps, queries), *forced]) is not None


def test_stretches_that_did_not_meet_or_lie_where_the_odometry_has_them_are_none(monkeypatch: pytest.MonkeyPatch) -> None:
    maps = laps()
    pairs = [measured(k, k, HERE) for k in range(2, 6)]
    a_little = np.array([1.0, 0.0, 0.0, 0.0, 0.3, 0.0, 0.0])
    for meeting in (
        Meeting(0, 1, pairs, refusal="two places of a kind, perhaps"),
        Meeting(0, 1, pairs, HERE, 1e-4 * np.eye(6)),
        Meeting(0, 1, pairs, a_little, 1e-8 * np.eye(6)),
    ):
        monkeypatch.setattr(module, "meet", lambda *_, meeting=meeting: meeting)
        assert own_slip(2 * LAP, maps.__getitem__, far(maps, [13, 14, 15, 16])) is None


@pytest.mark.slow
@pytest.mark.parametrize("metres", [0.0, 12.0])
def test_a_drive_round_a_block_whose_odometry_slips_is_in_doubt_and_a_sound_one_is_not(metres: float) -> None:
    """By so much half way; no loop is within reach of the odometry any more, and none says a word by itself."""
    route = [[20.0, 0.0], [60.0, 0.0], [60.0, 60.0], [0.0, 60.0], [0.0, 0.0], [60.0, 0.0], [60.0, 25.0]]
    drive = mapped_drive(city(2, 2, seed=7003), route, DriftConfig(channels=24, azimuth_steps=240), seed=7003)
    jump = np.array([1.0, 0.0, 0.0, 0.0, 0.8 * metres, -0.6 * metres, 0.0])
    maps = [replace(m, T_odo_map=se3.compose(jump, m.T_odo_map)) if m.number >= 7 else m for m in drive.maps]
    slam = Slam()
    for local_map in maps:
        slam.add(local_map)
    assert slam.doubt is None
    text = own_slip(len(maps), maps.__getitem__, slam.loops)
    assert (text is not None) == (metres > 0.0)
    assert text is None or text.startswith(("the odometry slipped by 11.", "the odometry slipped by 12."))
