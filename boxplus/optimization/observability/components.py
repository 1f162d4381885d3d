"""Which free variables hang together through residuals, and which of these islands are tied to the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.layout import Layout, connected_numbers
from boxplus.sparse.graphs.components import connected_components


@dataclass(frozen=True, slots=True)
class Components:
    """Connected components of the free variables.

    Attributes:
        count: components.
        label: (free variables,) component of each.
        touched: (free variables,) whether a residual is connected to it.
        anchored: (count,) whether a residual of it meets a fixed variable or holds the gauge by itself.
    """

    count: int
    label: NDArray[np.int64]
    touched: NDArray[np.bool_]
    anchored: NDArray[np.bool_]

    @classmethod
    def of(cls, layout: Layout, groups: Sequence[Group]) -> Components:
        """From the structure alone, whatever the values."""
        count = len(layout.sizes)
        touched, anchored = np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_)
        none = np.zeros(0, dtype=np.int64)
        rows, columns = [none], [none]
        for group in groups:
            numbers = connected_numbers(layout, group)
            any_fixed = np.any([number < 0 for number in numbers], axis=0)
            for number in numbers:
                free = number >= 0
                touched[number[free]] = True
                anchored[number[free & (any_fixed | group.residual.fixes_gauge)]] = True
            # A chain over the free variables of each residual; a fixed one in between is skipped.
            last = numbers[0].copy()
            for _, number in pairwise(numbers):
                both = (last >= 0) & (number >= 0)
                rows.append(last[both])
                columns.append(number[both])
                last = np.where(number >= 0, number, last)
        i, j = np.concatenate(rows), np.concatenate(columns)
        found, label = connected_components(count, i, j)
        holds = np.zeros(found, dtype=np.bool_)
        np.logical_or.at(holds, label, anchored)
        return cls(found, label, touched, holds)
