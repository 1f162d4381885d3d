"""Blocks of a long array that are taken and given back: the memory of a tree whose top is rebuilt with every update.

Sizes are rounded up to classes, four to an octave; blocks given back are kept by class, in a list that runs through the blocks.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

CLASSES = 160
_STEP = 8  # elements, a cache line


@kernel
def _class_of(size: int) -> tuple[int, int]:
    """Number of the size class and the size of its blocks."""
    lines = (size + _STEP - 1) // _STEP
    if lines <= 8:
        return max(lines, 1), max(lines, 1) * _STEP
    octave, top = 0, lines - 1
    while top >= 8:
        top >>= 1
        octave += 1
    # 4 ≤ top < 8: the quarter of the octave.
    return 8 + 4 * (octave - 1) + top - 3, (top + 1) << octave << 3


@kernel
def block_size(size: int) -> int:
    """Elements that `take` hands out for `size` of them."""
    return _class_of(size)[1]  # type: ignore[no-any-return]


@kernel
def take(arena: NDArray[Any], heads: NDArray[np.int64], top: NDArray[np.int64], size: int) -> int:
    """First element of a block of `size` elements.

    Args:
        heads: (CLASSES,) first free block of each class, −1 for none.
        top: (1,) elements used so far. The caller has made sure that `block_size` fits behind them.
    """
    number, whole = _class_of(size)
    at = heads[number]
    if at >= 0:
        heads[number] = np.int64(arena[at])
        return at  # type: ignore[no-any-return]
    at = top[0]
    top[0] += whole
    return at  # type: ignore[no-any-return]


@kernel
def give_back(arena: NDArray[Any], heads: NDArray[np.int64], at: int, size: int) -> None:
    """Return the block that `take` handed out for `size` elements."""
    number = _class_of(size)[0]
    arena[at] = heads[number]
    heads[number] = at
