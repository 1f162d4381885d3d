"""The compiled operations on a leaf against their plain Python counterparts, to the last bit."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.maps.ikd_tree.inner import INNER, boxes_sq
from boxplus.maps.ikd_tree.leaf import BUCKET, LEAF, count_bits, lanes_in_box, lanes_within, trailing_zeros


@kernel
def compiled_bits(bits: np.uint32) -> tuple[np.uint32, np.uint32]:
    """Index of the lowest bit set, number of bits set."""
    return trailing_zeros(bits), count_bits(bits)


@kernel
def compiled_lanes(
    leaf: NDArray[np.void], index: np.uint32, query: NDArray[np.float32], box: NDArray[np.float32]
) -> tuple[np.uint32, np.uint32]:
    """Lanes in a ball (x, y, z, squared radius) and in a box."""
    return lanes_within(leaf, index, query[0], query[1], query[2], query[3]), lanes_in_box(leaf, index, box)


@given(st.integers(1, 2**32 - 1))
@settings(max_examples=100)
def test_bits_are_counted(bits: int) -> None:
    expected = (next(i for i in range(32) if bits >> i & 1), f"{bits:b}".count("1"))
    assert compiled_bits(np.uint32(bits)) == expected
    assert (trailing_zeros(np.uint32(bits)), count_bits(np.uint32(bits))) == expected


@given(st.integers(0, 10_000), st.sampled_from((0.1, 1.0, 1e4)))
@settings(max_examples=100)
def test_lanes_are_the_same_compiled_and_not(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    leaf = np.zeros(3, LEAF)
    for name in "xyz":
        leaf[name] = np.round(rng.normal(0.0, scale, (3, BUCKET)), 1)  # many equal coordinates
        leaf[name][:, 5] = rng.choice([np.nan, np.inf, 0.0])
    index = np.uint32(rng.integers(3))
    query = np.append(leaf["x"][index, 0], rng.normal(0.0, scale, 3)).astype(np.float32)
    query[3] = np.float32(query[3] ** 2)
    x, y, z = leaf[index]["x"][7], leaf[index]["y"][9], leaf[index]["z"][11]
    box = np.array([x, y, z, x + scale, y + scale, z + scale], np.float32)
    expected = lanes_within(leaf, index, *query), lanes_in_box(leaf, index, box)
    assert compiled_lanes(leaf, index, query, box) == expected
    point = np.array([leaf[index][name][3] for name in "xyz"])
    offset = point - query[:3]
    assert bool(int(expected[0]) >> 3 & 1) == (offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2 <= query[3])
    assert bool(int(expected[1]) >> 3 & 1) == bool(((point >= box[:3]) & (point < box[3:])).all())


@kernel
def compiled_boxes(inner: NDArray[np.void], index: np.uint32, query: NDArray[np.float32]) -> tuple[np.float32, np.float32]:
    """Squared distances to the boxes of both children."""
    return boxes_sq(inner, index, query[0], query[1], query[2])


@given(st.integers(0, 10_000), st.sampled_from((1e-3, 1.0, 1e4)))
@settings(max_examples=100)
def test_distances_to_boxes_are_the_same_compiled_and_not(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    inner = np.zeros(3, INNER)
    corners = np.sort(rng.normal(0.0, scale, (3, 2, 2, 3)), axis=2)
    inner["box"] = corners.reshape(3, 2, 6)
    inner["box"][0, 1] = [np.inf] * 3 + [-np.inf] * 3  # an empty slot
    query = rng.normal(0.0, 2.0 * scale, 3).astype(np.float32)
    for index in np.arange(3, dtype=np.uint32):
        distances = boxes_sq(inner, index, *query)
        assert compiled_boxes(inner, index, query) == distances
        for side in range(2):
            low, high = inner[index]["box"][side, :3], inner[index]["box"][side, 3:]
            if not np.isfinite(low).all():
                assert distances[side] == np.inf
                continue
            for share in (0.0, 0.3, 1.0):  # never more than to a point in the box, not even by rounding
                offset = np.clip(low + np.float32(share) * (high - low), low, high) - query
                assert distances[side] <= offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2]
