"""Names of variables for messages: short, however many there are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.terms.layout import Layout

_LISTED = 4  # ranges named before the rest is counted


def variable_names(layout: Layout, numbers: NDArray[np.int64]) -> str:
    """`poses[0…11], points[3], points[7…9]` for numbers of free variables; what is left of a long list is counted."""
    named: list[str] = []
    left = 0
    for block, own, ids in zip(layout.blocks, layout.number, layout.ids, strict=True):
        rows = np.flatnonzero((own >= 0) & np.isin(own, numbers))
        if not len(rows):
            continue
        # A range goes over fixed variables between free ones: they are not meant, and saying so would not help.
        place = np.cumsum(own >= 0)[rows]
        for part in np.split(ids[rows], np.flatnonzero(np.diff(place) > 1) + 1):
            if len(named) >= _LISTED:
                left += len(part)
            elif len(part) == 1:
                named.append(f"{block.name}[{part[0]}]")
            elif len(part) == 2:
                named.append(f"{block.name}[{part[0]}, {part[1]}]")
            else:
                named.append(f"{block.name}[{part[0]}…{part[-1]}]")
    text = ", ".join(named)
    return f"{text} and {left} more" if left else text
