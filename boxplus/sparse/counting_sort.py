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


def gather_by(
    key: NDArray[np.int64], size: int, items: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint32]]:
    """The items of every key that has some, keys ascending and items in their order.

    Args:
        key: (n,) from 0 to size − 1, of each item.
        items: (n,) below 2³².

    Returns:
        (m,) the keys, (m + 1,) where the items of each begin, and (n,) the items.
    """
    keys, begin = np.empty(min(size, len(key)), dtype=np.int64), np.empty(min(size, len(key)) + 1, dtype=np.int64)
    ordered = np.empty(len(key), dtype=np.uint32)
    count = _gather(key, items, np.zeros(size, dtype=np.int64), keys, begin, ordered)
    return keys[:count], begin[: count + 1], ordered


@kernel
def _gather(
    key: NDArray[np.int64],
    items: NDArray[np.int64],
    at: NDArray[np.int64],
    keys: NDArray[np.int64],
    begin: NDArray[np.int64],
    ordered: NDArray[np.uint32],
) -> int:
    """`gather_by`; `at` (size,) is zero. The number of keys."""
    for n in range(key.shape[0]):
        at[key[n]] += 1
    count, end = 0, 0
    for k in range(at.shape[0]):
        if at[k] > 0:
            keys[count], begin[count] = k, end
            end, at[k] = end + at[k], end
            count += 1
    begin[count] = end
    for n in range(key.shape[0]):
        ordered[at[key[n]]] = items[n]
        at[key[n]] += 1
    return count
