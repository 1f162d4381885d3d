"""A direction that one scan misses is no weakness; one that most of them miss is."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.systems.lidar_inertial_odometry.watches.weak_spell import WeakSpell

PERIOD_NS = 100_000_000


THRESHOLD = 1.3


def statuses(
    is_open: list[bool], period_ns: int = PERIOD_NS, known_ns: int | None = None, shown: float = 1.5, standing: int = 0
) -> list[str]:
    """What a spell says scan by scan, the first one at 0; `shown` is the ratio of the weakest direction where none is open, and
    during the first `standing` scans the platform stands."""
    spell = WeakSpell(THRESHOLD, known_ns)

    def directions(weak: bool) -> Any:
        ratios = np.array([9.0] * 5 + [1.0 if weak else shown])
        return SimpleNamespace(weak=ratios < THRESHOLD, ratios=ratios)

    return [
        spell.status(number * period_ns, directions(weak), True, stands=number < standing) for number, weak in enumerate(is_open)
    ]


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


@given(st.lists(st.booleans(), min_size=1, max_size=60))
def test_a_scan_that_measures_every_direction_clearly_is_not_weak(is_open: list[bool]) -> None:
    barely, clearly = statuses(is_open, shown=1.99 * THRESHOLD), statuses(is_open, shown=2.01 * THRESHOLD)
    for weak, before, now in zip(is_open, barely, clearly, strict=True):
        assert now == (before if weak else "ok")


@pytest.mark.parametrize("period_ns", [20_000_000, 50_000_000, PERIOD_NS])
def test_the_time_before_a_known_pose_counts_as_seen(period_ns: int) -> None:
    window = 500_000_000 // period_ns
    begins_open = [True] * window + [False] * 2 * window
    known = statuses(begins_open, period_ns, known_ns=-period_ns)
    half = (window + 1) // 2
    assert set(known[: half - 1]) == {"ok"} and set(known[half:window]) == {"weak"}
    # A spell that ends within the first half of that time is none.
    assert set(statuses([True] * (half - 1) + [False] * window, period_ns, known_ns=-period_ns)) == {"ok"}
    # Later on it is as if nothing had been known.
    assert known[window:] == statuses(begins_open, period_ns)[window:]


@given(st.lists(st.booleans(), min_size=1, max_size=60), st.integers(1, 60))
def test_a_platform_that_stands_is_where_it_is_and_moves_off_from_a_known_pose(is_open: list[bool], standing: int) -> None:
    found = statuses([True] * standing + is_open, standing=standing)
    assert found == ["ok"] * standing + statuses(is_open, known_ns=-PERIOD_NS)


def test_without_an_update_the_scan_is_lost_standing_or_not() -> None:
    for stands in (False, True):
        assert WeakSpell(THRESHOLD).status(0, None, False, stands=stands) == "lost"  # type: ignore[arg-type]
