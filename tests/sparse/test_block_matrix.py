"""Patterns of block-sparse matrices."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import random_array

from boxplus.errors import InputError
from boxplus.sparse.block_matrix import BlockPattern, unique_keys


@given(seed=st.integers(0, 10**6), sizes=st.lists(st.integers(1, 4), min_size=1, max_size=8), pairs=st.integers(0, 20))
def test_pairs_become_the_blocks_of_a_matrix(seed: int, sizes: list[int], pairs: int) -> None:
    rng = np.random.default_rng(seed)
    i, j = rng.integers(0, len(sizes), (2, pairs))
    pattern, index = BlockPattern.from_pairs(sizes, i, j)
    start = np.concatenate([[0], np.cumsum(sizes)])
    values, dense = np.zeros(pattern.value_start[-1]), np.zeros((start[-1], start[-1]))
    for a, b, block, transposed in zip(i, j, index.block, index.transposed, strict=True):
        added = rng.normal(size=(sizes[a], sizes[b]))
        if a == b:
            added += added.T
        dense[start[a] : start[a + 1], start[b] : start[b + 1]] += added
        if a != b:
            dense[start[b] : start[b + 1], start[a] : start[a + 1]] += added.T
        values[pattern.value_start[block] : pattern.value_start[block + 1]] += (added.T if transposed else added).ravel()
    np.testing.assert_allclose(pattern.to_scipy(values).toarray(), dense, atol=1e-14)


@pytest.mark.parametrize("size", [1, 2, 70_000, 2**20, 10**9, 2**41 + 1])
@pytest.mark.parametrize("count", [0, 1, 500])
def test_keys_are_numbered_in_their_order(size: int, count: int) -> None:
    """By a table where they are dense, by two digits where not."""
    rng = np.random.default_rng(0)
    keys = rng.integers(0, size, count)
    keys[: count // 2] = rng.permutation(keys)[: count // 2]
    if count:
        keys[-1], keys[0] = size - 1, 0
    different, position = unique_keys(keys, size)
    expected, positions = np.unique(keys, return_inverse=True)
    np.testing.assert_array_equal(different, expected)
    np.testing.assert_array_equal(position, positions)


@pytest.mark.parametrize("sizes", [None, [2, 3, 1, 4]])
def test_scipy_matrices_make_the_round_trip(sizes: list[int] | None) -> None:
    matrix = random_array((10, 10), density=0.3, rng=np.random.default_rng(0))
    matrix = (matrix + matrix.T).tocsc()
    pattern, values = BlockPattern.from_scipy(matrix, sizes)
    np.testing.assert_array_equal(pattern.to_scipy(values).toarray(), matrix.toarray())


def test_refuses_what_is_no_pattern() -> None:
    with pytest.raises(InputError, match="variables from 0 to 2"):
        BlockPattern.from_pairs([1, 1, 1], [0], [3])
    with pytest.raises(InputError, match="as many first as second"):
        BlockPattern.from_pairs([1, 1, 1], [0, 1], [2])
    with pytest.raises(InputError, match="size of at least 1"):
        BlockPattern.from_pairs([1, 0, 1], [], [])
    with pytest.raises(InputError, match="diagonal and then ascending"):
        BlockPattern(np.array([1, 1]), np.array([0, 2, 3]), np.array([1, 0, 1]))
    with pytest.raises(InputError, match="ascending column starts"):
        BlockPattern(np.array([1, 1]), np.array([0, 2]), np.array([0, 1]))
    with pytest.raises(InputError, match="square matrix of 3 rows"):
        BlockPattern.from_scipy(np.eye(4), [1, 2])
    with pytest.raises(InputError, match="expected 3 values"):
        BlockPattern.from_pairs([1, 1, 1], [], [])[0].to_scipy([1.0])
