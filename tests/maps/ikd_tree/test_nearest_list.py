"""The list of the nearest, compiled and not, against sorting."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.maps.ikd_tree.nearest_list import LANES, entry, list_of, take_in, ties
from boxplus.maps.ikd_tree.pool import NIL
from boxplus.maps.ikd_tree.search import pack

# Few distances and few points, so that many are equally far; the largest of both, whose bits a signed number would misread.
distances = st.sampled_from([0.0, 1e-30, 0.25, 1.0, 2.0, 3.4e38])
points = st.sampled_from([0, 1, 7, 2**31, int(NIL) - 1])


@kernel
def compiled_list(first: np.uint64, numbers: NDArray[np.uint64], found: NDArray[np.uint64]) -> np.uint32:
    """What is in a list after all numbers; returns its ties."""
    nearest = list_of(first)
    for number in numbers:
        take_in(nearest, number)
    for place in range(LANES):
        found[place] = entry(nearest, np.uint32(place))
    return ties(nearest)


@given(st.lists(st.tuples(distances, points), max_size=40))
@settings(max_examples=200)
def test_the_smallest_stay_in_order(chosen: list[tuple[float, int]]) -> None:
    first = pack(np.float32(5.0), np.uint32(NIL))
    numbers = np.array([pack(np.float32(sq), np.uint32(point)) for sq, point in chosen], np.uint64)
    expected = np.sort(np.concatenate([numbers, np.full(LANES, first, np.uint64)]))[:LANES]
    found, plain = np.empty(LANES, np.uint64), list_of(first)
    tied = compiled_list(first, numbers, found)
    for number in numbers:
        take_in(plain, number)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(plain, expected)
    assert [entry(plain, np.uint32(place)) for place in range(LANES)] == expected.tolist()
    sq, point = expected >> np.uint64(32), expected & np.uint64(0xFFFFFFFF)
    after = [bool(sq[i] == sq[i + 1] and point[i + 1] != NIL) for i in range(LANES - 1)]
    assert [bool(int(tied) >> i & 1) for i in range(LANES)] == [*after, False]
    assert ties(plain) == tied
