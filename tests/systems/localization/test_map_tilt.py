"""From where on a map that leans is a doubt."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.systems.localization.map_tilt import MOST_TILT, MapTilt


def seen(count: int, lean: float, towards: float = 0.0, length: float = 9.81) -> MapTilt:
    tilt = MapTilt()
    for _ in range(count):
        tilt.see(length * np.array([np.sin(lean) * np.cos(towards), np.sin(lean) * np.sin(towards), np.cos(lean)]))
    return tilt


@given(st.floats(0.0, np.pi), st.floats(0.0, 2.0 * np.pi), st.floats(0.1, 20.0))
def test_the_angle_is_that_of_up_whatever_its_length(lean: float, towards: float, length: float) -> None:
    assert seen(5, lean, towards, length).angle == pytest.approx(lean, abs=1e-7)


def test_a_doubt_takes_five_scans_and_more_than_the_limit() -> None:
    assert MapTilt().doubt is None and MapTilt().angle == 0.0
    assert seen(4, 0.1).doubt is None and seen(5, 0.99 * MOST_TILT).doubt is None
    text = seen(5, 1.01 * MOST_TILT).doubt
    assert text is not None and text.startswith("up in the map is 1.52° off where the IMU has it")
    assert "heights and slopes are those of a map that leans" in text


def test_what_sways_about_upright_is_no_lean() -> None:
    tilt = MapTilt()
    for k in range(20):
        tilt.see(np.array([np.sin(0.1), 0.0, np.cos(0.1)]) * np.array([(-1.0) ** k, 1.0, 1.0]))
    assert tilt.angle < 1e-9 and tilt.doubt is None


def test_places_lean_by_themselves_and_the_doubt_of_one_stays() -> None:
    tilt = seen(30, 0.07)
    tilt.begin()
    assert tilt.angle == 0.0 and "4.01°" in str(tilt.doubt)
    upright = seen(30, 0.02)
    upright.begin()
    for _ in range(45):
        upright.see(np.array([0.0, 0.0, 9.8]))
    assert upright.angle == 0.0 and upright.doubt is None
