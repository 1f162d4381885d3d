"""A direction that one scan misses is no weakness; one that most of them miss is."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.systems.lidar_inertial_odometry.weak_spell import WeakSpell

PERIOD_NS = 100_000_000


def statuses(is_open: list[bool], period_ns: int = PERIOD_NS) -> list[str]:
    spell = WeakSpell()

    def posterior(weak: bool) -> Any:
        return SimpleNamespace(last=SimpleNamespace(directions=SimpleNamespace(weak=np.array([False] * 5 + [weak]))))

    return [spell.status(number * period_ns, posterior(weak), True) for number, weak in enumerate(is_open)]


def test_single_scans_are_passed_over() -> None:
    assert set(statuses(([False] * 4 + [True]) * 10)) == {"ok"}


@pytest.mark.parametrize("period_ns", [20_000_000, 50_000_000, PERIOD_NS, 200_000_000])
def test_what_lasts_is_weak_within_half_a_second_and_ends_within_half_a_second(period_ns: int) -> None:
    each = 2_000_000_000 // period_ns
    half = 500_000_000 // period_ns
    found = statuses([False] * each + [True] * each + [False] * each, period_ns)
    assert set(found[:each]) == {"ok"} and set(found[each + half : 2 * each]) == {"weak"}
    assert set(found[2 * each + half :]) == {"ok"}


@given(st.lists(st.booleans(), min_size=1, max_size=60))
def test_a_run_that_begins_weak_says_so_and_every_second_scan_is_enough(is_open: list[bool]) -> None:
    found = statuses(is_open)
    assert (found[0] == "weak") == is_open[0]
    assert set(statuses([True, False] * 20)) == {"weak"}
    for number, status in enumerate(found):
        last = is_open[max(0, number - 5) : number + 1]
        assert (status == "weak") == (2 * sum(last) >= len(last))


def test_without_an_update_the_scan_is_lost() -> None:
    assert WeakSpell().status(0, None, False) == "lost"  # type: ignore[arg-type]
