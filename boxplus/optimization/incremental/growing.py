"""Arrays that grow at their end, with room to spare: appending costs a constant time on average."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_FIRST = 64


def grown(array: NDArray[Any], needed: int, fill: float = 0) -> NDArray[Any]:
    """The array itself where it has `needed` rows, else a longer one with its rows and `fill` behind them."""
    if needed <= len(array):
        return array
    longer = np.full((max(2 * len(array), needed, _FIRST), *array.shape[1:]), fill, array.dtype)
    longer[: len(array)] = array
    return longer
