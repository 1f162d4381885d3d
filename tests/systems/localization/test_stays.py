"""What places of one run that are lost and found again say of each other."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.systems.localization.stays import Stays

HERE = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
ODOMETRY = np.array([1.0, 0.0, 0.0, 0.0, 30.0, 5.0, 1.0])


def shifted(metres: float) -> np.ndarray:
    return np.asarray(HERE + np.array([0.0, 0.0, 0.0, 0.0, metres, 0.0, 0.0]))


def lost(*, is_contradicted: bool, is_confirmed: bool = False) -> Stays:
    stays = Stays()
    stays.begin(0, HERE, ODOMETRY)
    assert stays.doubt is None
    stays.is_confirmed = is_confirmed
    stays.end(4_000_000_000, HERE, "it fits no more", is_contradicted=is_contradicted)
    return stays


def test_a_place_that_nothing_confirmed_is_doubted_when_it_is_contradicted() -> None:
    doubt = lost(is_contradicted=True).doubt
    assert doubt is not None and "followed for 4.0 s may be a wrong one: it was lost (it fits no more)" in doubt


def test_a_place_that_was_confirmed_and_one_beyond_the_map_are_not() -> None:
    assert lost(is_contradicted=True, is_confirmed=True).doubt is None
    assert lost(is_contradicted=False).doubt is None


@pytest.mark.parametrize("is_confirmed", [False, True])
def test_what_is_found_again_where_the_odometry_has_it_was_right(is_confirmed: bool) -> None:
    stays = lost(is_contradicted=True, is_confirmed=is_confirmed)
    stays.walk(100.0)
    stays.begin(9_000_000_000, shifted(2.5), ODOMETRY)  # 1 m and 2 % of the way
    assert stays.doubt is None


@pytest.mark.parametrize("is_confirmed", [False, True])
def test_what_is_found_again_elsewhere_is_doubted_to_the_end(is_confirmed: bool) -> None:
    stays = lost(is_contradicted=True, is_confirmed=is_confirmed)
    stays.begin(9_000_000_000, shifted(2.5), ODOMETRY)
    assert stays.doubt is not None and "found again 2.5 m from where the odometry has it" in stays.doubt
    stays.end(20_000_000_000, shifted(2.5), "no scan for 3 s", is_contradicted=False)
    stays.begin(30_000_000_000, HERE, ODOMETRY)
    assert stays.doubt is not None


def test_where_scans_were_missing_the_odometry_says_nothing() -> None:
    stays = lost(is_contradicted=False)
    stays.begin(9_000_000_000, shifted(50.0), ODOMETRY)
    assert stays.doubt is None


def test_where_the_odometry_was_lost_after_the_place_it_says_nothing() -> None:
    stays = lost(is_contradicted=True, is_confirmed=True)
    stays.jump()
    stays.begin(9_000_000_000, shifted(3.0), ODOMETRY)
    assert stays.doubt is None
