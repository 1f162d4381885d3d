"""Stable sort by small integers, in linear time: how residuals are gathered by the variable or the block they touch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel


def order_by(key: NDArray[np.int64], size: int) -> tuple[NDArray[np.uint32], NDArray[np.int64]]:
    """Positions sorted by their key, ties in their order, and where each key begins among them.

    Args:
        key: (n,) from 0 to size − 1.

    Returns:
        (n,) positions and (size + 1,) where the positions of each key begin.
    """
    order, begin = np.empty(len(key), dtype=np.uint32), np.zeros(size + 1, dtype=np.int64)
    _count(np.ascontiguousarray(key, dtype=np.int64), order, begin)
    return order, begin


@kernel
def _count(key: NDArray[np.int64], order: NDArray[np.uint32], begin: NDArray[np.int64]) -> None:
    for n in range(key.shape[0]):
        begin[key[n] + 1] += 1
    for k in range(begin.shape[0] - 1):
        begin[k + 1] += begin[k]
    at = begin.copy()
    for n in range(key.shape[0]):
        order[at[key[n]]] = n
        at[key[n]] += 1
