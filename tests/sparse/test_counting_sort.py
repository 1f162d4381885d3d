"""The counting sort equals NumPy's stable one; product tiles equal einsum."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.sparse.counting_sort import order_by
from boxplus.sparse.product_tiles import LOOPS, SIZES, add_sums, tile_of


@given(st.lists(st.integers(0, 8), max_size=60))
def test_order_by_is_a_stable_sort(keys):
    key = np.array(keys, dtype=np.int64)
    order, begin = order_by(key, 9)
    np.testing.assert_array_equal(order, np.argsort(key, kind="stable"))
    np.testing.assert_array_equal(np.diff(begin), np.bincount(key, minlength=9))


@pytest.mark.parametrize("sizes", [*SIZES, (4, 5, 7), (1, 6, 1)])
def test_sums_of_products(sizes):
    rng = np.random.default_rng(0)
    depth, rows, columns = sizes
    a, b = rng.standard_normal((20, depth, rows)), rng.standard_normal((15, depth, columns))
    begin = np.array([0, 4, 4, 9, 30])
    entry_a, entry_b = rng.integers(0, 20, 30).astype(np.uint32), rng.integers(0, 15, 30).astype(np.uint32)
    entry_a[0], entry_b[0] = 19, 14  # the last ones, whose rows end with the array
    start = rng.standard_normal((4, rows, columns))
    for tile in {tile_of(*sizes), LOOPS}:
        values = start.copy()
        add_sums(tile, -1.0, 1, 4, np.arange(4) * rows * columns, begin, entry_a, entry_b, a, b, values.reshape(-1))
        expected = start.copy()
        for k in range(1, 4):
            chosen = slice(begin[k], begin[k + 1])
            expected[k] -= np.einsum("nip,niq->pq", a[entry_a[chosen]], b[entry_b[chosen]])
        np.testing.assert_allclose(values, expected, rtol=1e-12, atol=1e-12)
