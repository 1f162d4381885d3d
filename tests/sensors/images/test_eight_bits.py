"""Grey values in 8 bits, by one scale for a whole recording."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.sensors.images.eight_bits import EightBits


def test_eight_bits_stay_and_sixteen_lose_their_lower_half() -> None:
    grey = np.arange(256, dtype=np.uint8)[None]
    assert np.array_equal(EightBits()(grey), grey)
    assert EightBits()(np.array([[0, 256, 65535]], np.uint16)).tolist() == [[0, 1, 255]]


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_the_range_is_that_of_the_sensor_not_of_its_container(bits: int) -> None:
    full = 2**bits - 1
    converted = EightBits()(np.linspace(0, full, 256).astype(np.uint16)[None])
    assert np.abs(converted[0].astype(int) - np.arange(256)).max() <= 1


def test_floats_from_zero_to_one_are_taken_as_such() -> None:
    assert EightBits()(np.array([[0.0, 0.5, 1.0, -2.0]], np.float32)).tolist() == [[0, 128, 255, 0]]
    assert EightBits()(np.zeros((2, 2), np.float32)).max() == 0


@given(st.lists(st.integers(0, 65535), min_size=1, max_size=8))
def test_the_range_never_shrinks_and_holds_what_was_seen(largest: list[int]) -> None:
    """So that dark images after bright ones are dark."""
    to_8_bits = EightBits()
    for k, value in enumerate(largest):
        before = to_8_bits.full
        converted = to_8_bits(np.array([[value, 0]], np.uint16))
        assert to_8_bits.full >= max(*largest[: k + 1], before)
        assert abs(int(converted[0, 0]) - 255.0 * value / max(to_8_bits.full, 1.0)) <= 0.51
