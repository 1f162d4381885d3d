"""Half-open boxes `lo ≤ x < hi` in float32, as six numbers: low x, y, z, high x, y, z."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.maps.ikd_tree.leaf import lanes_in_box
from boxplus.maps.ikd_tree.pool import all_bits


@kernel(inline=True, borrow=True)
def in_box(leaf: NDArray[np.void], index: np.uint32, box: NDArray[np.float32]) -> np.uint32:
    """Which stored points of a leaf lie in a half-open box (as bits)."""
    return np.uint32(lanes_in_box(leaf, np.uint32(index), box) & all_bits(np.uint32(leaf[index]["count"])))


@kernel(inline=True, borrow=True)
def disjoint(slots: NDArray[np.float32], side: np.uint32, box: NDArray[np.float32]) -> bool:
    """Whether the box of a slot and a half-open box have no point in common."""
    return bool(
        (slots[side, 0] >= box[3])
        | (slots[side, 1] >= box[4])
        | (slots[side, 2] >= box[5])
        | (slots[side, 3] < box[0])
        | (slots[side, 4] < box[1])
        | (slots[side, 5] < box[2])
    )


@kernel(inline=True, borrow=True)
def contained(slots: NDArray[np.float32], side: np.uint32, box: NDArray[np.float32]) -> bool:
    """Whether the box of a slot lies in a half-open box."""
    return bool(
        (slots[side, 0] >= box[0])
        & (slots[side, 1] >= box[1])
        & (slots[side, 2] >= box[2])
        & (slots[side, 3] < box[3])
        & (slots[side, 4] < box[4])
        & (slots[side, 5] < box[5])
    )
