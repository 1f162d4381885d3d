"""Whether the odometry of a session slipped: encounters before it say one alignment, those after it another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.runs.sessions.joined import doubts_of_joining
from boxplus.simulation.worlds.worlds import city
from boxplus.systems.sessions.encounter import Meeting
from boxplus.systems.sessions.session import Session
from boxplus.systems.sessions.sessions import JointWorld, SessionAlignment, align_sessions
from boxplus.systems.sessions.slip import slip_of
from boxplus.systems.slam.loop import Loop
from tests.systems.sessions.sessions import drawn, driven, measured
from tests.systems.sessions.test_sessions import OUTDOORS, QUICK

WAY = np.array([[1.0, 0.0, 0.0, 0.0, 10.0 * k, 0.0, 0.0] for k in range(12)])
NAMES = "monday", "friday"


def slipped(metres: float, degrees: float = 0.0) -> NDArray[np.float64]:
    return se3.exp(np.array([0.0, 0.0, np.deg2rad(degrees), 0.0, metres, 0.0]))


def at(queries: list[int], off: NDArray[np.float64] | None = None) -> list[Loop]:
    """Encounters of the same numbers in both of two drives along one way, laid off from there."""
    here = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    return [measured(k, k, here if off is None else off) for k in queries]


@given(
    at_map=st.integers(3, 9),
    is_earlier=st.booleans(),
    metres=st.floats(0.6, 50.0),
    degrees=st.floats(-20.0, 20.0),
)
def test_those_from_somewhere_on_that_agree_on_another_place_are_a_slip(
    at_map: int, is_earlier: bool, metres: float, degrees: float
) -> None:
    first, last = list(range(at_map)), list(range(at_map, 12))
    kept, others = (last, first) if is_earlier else (first, last)
    text = slip_of(at(kept), at(others, slipped(metres, degrees)), NAMES, [WAY, WAY])
    assert text is not None and text.startswith("friday and monday lie over each other along a part of the way only")
    assert f"local maps {min(others)} to {max(others)} of monday agree" in text


@given(metres=st.floats(0.0, 0.49), degrees=st.floats(-1.9, 1.9))
def test_a_little_more_drift_than_was_claimed_is_none(metres: float, degrees: float) -> None:
    off = np.array([*slipped(0.0, degrees)[:4], 0.0, metres, 0.0])
    assert slip_of(at([0, 1, 2, 3]), at([5, 6], off), NAMES, [WAY, WAY]) is None


def test_what_lies_among_true_ones_or_is_of_one_local_map_is_another_thing() -> None:
    off = slipped(3.0)
    assert slip_of(at([0, 1, 2, 5, 6]), at([3, 4], off), NAMES, [WAY, WAY]) is None
    assert slip_of(at([0, 1, 2]), [*at([7], off), *at([7], off)], NAMES, [WAY, WAY]) is None
    assert slip_of(at([0, 1, 2]), at([7], off), NAMES, [WAY, WAY]) is None
    assert slip_of(at([0, 1, 2]), [], NAMES, [WAY, WAY]) is None


def test_the_session_is_named_in_whose_order_they_part() -> None:
    """The query session drove the other way round and back: its numbers are mixed, those of the place session are not."""
    off = slipped(2.0)
    kept = [replace(loop, query=k) for loop, k in zip(at([0, 1, 2, 3]), [0, 9, 1, 8], strict=True)]
    others = [replace(loop, query=k) for loop, k in zip(at([6, 7], off), [4, 5], strict=True)]
    text = slip_of(kept, others, NAMES, [WAY, WAY])
    assert text is not None and "local maps 6 to 7 of monday" in text


def test_a_slip_is_a_doubt_of_the_joint_map_unless_both_were_in_it() -> None:
    sessions = tuple(drawn(name, WAY) for name in ("monday", "friday", "sunday"))
    world = JointWorld((0, 1, 2), WAY[:3], np.zeros((3, 6, 6)), [WAY] * 3, [], np.tile([1.0, 0.01], (3, 1)))
    meetings = [Meeting(0, 1, [], slip="friday slipped"), Meeting(0, 2, []), Meeting(1, 2, [])]
    alignment = SessionAlignment(sessions, [world], meetings)
    assert doubts_of_joining(alignment, [None] * 3) == ["friday slipped"]  # although sunday bears friday out
    assert doubts_of_joining(alignment, [None] * 3, held=1) == ["friday slipped"]
    assert doubts_of_joining(alignment, [None] * 3, held=2) == []
    apart = SessionAlignment(sessions, [world], [replace(meetings[0], refusal="another place"), *meetings[1:]])
    assert doubts_of_joining(apart, [None] * 3) == []


@pytest.mark.slow
def test_a_session_that_slipped_is_joined_with_a_doubt_and_a_sound_one_without() -> None:
    """By 3 m, before the last two of its eight local maps; the joint map has twice what is there."""
    world = city(2, 2, seed=5)
    monday, _ = driven("monday", world, [[0.0, 0.0], [60.0, 0.0], [60.0, 60.0], [0.0, 60.0]], OUTDOORS, 5)
    friday, _ = driven("friday", world, [[10.0, 60.0], [60.0, 60.0], [60.0, 0.0], [0.0, 0.0]], OUTDOORS, 6)
    jump, from_there = np.array([1.0, 0.0, 0.0, 0.0, 3.0, 0.0, 0.0]), len(friday.maps) - 2
    moved = [replace(m, T_odo_map=se3.compose(jump, m.T_odo_map)) if m.number >= from_there else m for m in friday.maps]
    for own, is_doubted in ((friday, False), (Session.of("friday", moved), True)):
        found = align_sessions([monday, own], QUICK)
        assert len(found.worlds) == 1
        texts = found.slips(0)
        assert bool(texts) == is_doubted
        assert all("friday and monday lie over each other along a part of the way only" in text for text in texts)
