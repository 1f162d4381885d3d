"""What queries in a row say of a place: believed, told from its kind, or in doubt."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.systems.localization.kind import Kind, same_place

HERE = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
ELSEWHERE = HERE + np.array([0.0, 0.0, 0.0, 0.0, 3.0, 0.0, 0.0])
T_ODO = np.array([1.0, 0.0, 0.0, 0.0, 30.0, 5.0, 1.0])
LEAST, MARGIN, LEAST_FIT = 0.23, 0.06, 0.65


def seen(*leads: float, follow: bool = True, fit: float = 0.9) -> Kind:
    kind = Kind(LEAST, MARGIN, LEAST_FIT)
    for lead in leads:
        kind.see(lead, fit, HERE, T_ODO)
    if follow:
        kind.follow()
    return kind


@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=12))
def test_the_mean_is_believed_from_the_limit_and_told_a_margin_above(leads: list[float]) -> None:
    kind = seen(*leads)
    mean = float(np.mean(leads))
    assert kind.mean == pytest.approx(mean)
    assert (kind.refusal is None) == (kind.mean >= LEAST)
    assert kind.is_told == (kind.mean >= LEAST + MARGIN / math.sqrt(len(leads)))
    assert (kind.doubt is None) == kind.is_told
    assert seen(*leads, follow=False).doubt is None  # no pose was given out


def test_the_same_lead_tells_after_more_queries() -> None:
    assert not seen(0.26).is_told and not seen(0.26, 0.26).is_told and seen(*[0.26] * 5).is_told
    text = seen(0.25, 0.25).doubt
    assert text is not None and "over 2 queries what stands lies 25 % nearer" in text and "come to 23 %" in text
    assert "perhaps another one: what stands lies 20 % nearer" in str(seen(0.2).refusal)


def test_a_place_half_beyond_the_map_is_not_told_by_any_lead() -> None:
    """Its rivals lie farther beyond the map's end: that is no evidence."""
    kind = seen(0.6, 0.6, fit=0.6)
    assert kind.refusal is None and not kind.is_told and "40 % of it is nowhere in the map" in str(kind.doubt)
    for _ in range(2):
        kind.see(0.6, 0.8, HERE, T_ODO)
    assert kind.is_told and kind.doubt is None  # once the way led into it


def test_another_place_begins_anew_and_the_doubt_of_the_first_stays() -> None:
    kind = seen(0.25, 0.25)
    kind.see(0.5, 0.9, ELSEWHERE, T_ODO)
    kind.follow()
    assert kind.is_told and kind.mean == 0.5 and "over 2 queries" in str(kind.doubt)
    told = seen(0.5)
    told.see(0.1, 0.9, ELSEWHERE, T_ODO)
    assert told.mean == 0.1 and told.doubt is None
    told.forget()
    assert told.mean == 0.0 and told.doubt is None and not told.is_told


def test_a_place_is_the_same_where_the_odometry_is_and_not_at_its_origin() -> None:
    turn = math.radians(3.0)
    turned = np.array([math.cos(0.5 * turn), 0.0, 0.0, math.sin(0.5 * turn), 0.0, 0.0, 0.0])
    assert same_place(HERE, turned, HERE) and not same_place(HERE, turned, T_ODO)
    assert same_place(HERE, HERE, T_ODO) and not same_place(HERE, ELSEWHERE, HERE)


def test_an_odometry_that_drifts_is_still_in_the_place_that_is_followed() -> None:
    kind = seen(0.25, 0.25)
    for step in range(1, 8):
        kind.see_again(0.5, 0.9, HERE + step * np.array([0.0, 0.0, 0.0, 0.0, 1.2, 0.0, 0.0]), T_ODO)
    assert kind.is_told and kind.doubt is None


def test_a_doubt_ends_where_the_place_is_found_again_and_told() -> None:
    kind = seen(0.25, 0.25)
    kind.forget()
    assert "over 2 queries" in str(kind.doubt)
    kind.see(0.5, 0.9, ELSEWHERE, T_ODO)
    assert kind.is_told and kind.doubt is not None
    kind.see(0.5, 0.9, HERE, T_ODO)
    assert kind.is_told and kind.doubt is None
