"""Errors that a run could not see stay in all later poses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.systems.refinement.unshown import after_unshown, is_mostly_unshown, moved_unshown

STATUS = st.lists(st.sampled_from(["ok", "weak", "lost"]), min_size=1, max_size=30)


@given(STATUS)
def test_from_the_first_one_on(status: list[str]) -> None:
    found = after_unshown(status)
    for k in range(len(status)):
        assert found[k] == any(own != "ok" for own in status[: k + 1])


@pytest.mark.parametrize(("weak", "mostly"), [(0, False), (5, False), (6, True), (10, True)])
def test_more_than_half(weak: int, mostly: bool) -> None:
    assert is_mostly_unshown(np.array(["weak"] * weak + ["ok"] * (10 - weak))) is mostly


def spell(moved_m: float, status: list[str], turned: float = 0.0) -> str | None:
    """Twenty scans, of which the last ten are weak and know less and less of one direction, along which they were moved."""
    axis, grown = np.array([np.cos(turned), np.sin(turned), 0.0]), np.linspace(0.0, 0.2, 10)
    P = np.zeros((20, 6, 6))
    P[:, 3:, 3:] = 0.005**2 * np.eye(3)
    P[10:, 3:, 3:] += grown[:, None, None] ** 2 * np.outer(axis, axis)
    after = np.zeros((20, 3))
    after[10:] = moved_m * grown[:, None] / 0.2 * axis
    return moved_unshown(status, np.zeros((20, 3)), after, P)


@pytest.mark.parametrize("turned", [0.0, 0.7, 2.0])
def test_a_path_moved_along_what_nothing_showed_by_more_than_was_open_before(turned: float) -> None:
    status = ["ok"] * 10 + ["weak"] * 10
    assert spell(0.01, status, turned) is None
    found = spell(0.2, status, turned)
    assert found is not None and found.startswith("over 10 scans that were weak or lost, from number 10 on, it moved the path by")
    assert spell(0.2, ["ok"] * 20, turned) is None


def test_what_moves_across_the_open_direction_is_shown() -> None:
    P = np.tile(np.diag([0.0, 0.0, 0.0, 1e-4, 1e-6, 1e-6]), (4, 1, 1))
    P[2:, 3, 3] = 0.04
    after = np.zeros((4, 3))
    after[2:, 1] = 0.5
    assert moved_unshown(["ok", "ok", "weak", "lost"], np.zeros((4, 3)), after, P) is None
