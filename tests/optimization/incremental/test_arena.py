"""Blocks of an arena: none overlaps another, and what is given back is used again."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from boxplus.optimization.incremental.arena import CLASSES, block_size, give_back, take


@given(st.lists(st.tuples(st.booleans(), st.integers(1, 5000)), max_size=60), st.booleans())
def test_blocks_never_overlap(steps: list[tuple[bool, int]], is_float: bool) -> None:
    arena = np.zeros(60 * 6400, np.float64 if is_float else np.int64)
    heads, top = np.full(CLASSES, -1), np.zeros(1, np.int64)
    held: list[tuple[int, int]] = []
    for returns, size in steps:
        if returns and held:
            at, length = held.pop(size % len(held))
            give_back(arena, heads, at, length)
            continue
        at = take(arena, heads, top, size)
        assert all(at + size <= other or other + length <= at for other, length in held)
        assert at + size <= top[0]
        arena[at : at + size] = np.nan if is_float else -7
        held.append((at, size))
    for at, size in held:
        assert (np.isnan(arena[at : at + size]) if is_float else arena[at : at + size] == -7).all()


@given(st.integers(1, 10**9))
def test_a_block_is_at_most_a_quarter_larger_than_asked_for(size: int) -> None:
    whole = block_size(size)
    assert size <= whole <= max(size + 8, 1.25 * size + 8)
    assert block_size(whole) == whole


def test_a_block_given_back_is_taken_again() -> None:
    arena, heads, top = np.zeros(1000), np.full(CLASSES, -1), np.zeros(1, np.int64)
    first, _second = take(arena, heads, top, 100), take(arena, heads, top, 100)
    give_back(arena, heads, first, 100)
    assert take(arena, heads, top, 97) == first
    assert take(arena, heads, top, 100) == top[0] - block_size(100)
