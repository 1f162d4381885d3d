"""Asking ahead for memory changes nothing, wherever it points to."""

from __future__ import annotations

import numpy as np

from boxplus._jit import kernel
from boxplus.sparse.prefetch import prefetch


@kernel
def _sum(array: np.ndarray) -> float:
    total = 0.0
    for k in range(np.uint64(len(array))):
        prefetch(array, k + np.uint64(10**6))
        total += array[k]
    return total


def test_prefetching_beyond_the_end_is_harmless() -> None:
    array = np.arange(50.0)
    assert _sum(array) == 1225.0
    np.testing.assert_array_equal(array, np.arange(50.0))
