"""What a solution says of its Jacobians: which are differences, and which jump where it began or ended."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.terms.group import Group

_LISTED = 5


def jacobian_notes(
    groups: Sequence[Group], start: Sequence[NDArray[np.float64]], end: Sequence[NDArray[np.float64]]
) -> tuple[str, ...]:
    """Sentences on the Jacobians of each group, between values of all blocks at the start and at the end."""
    notes = [f"{group.name}: {group.residual.jacobian_note}" for group in groups if group.residual.jacobian_note]
    for group in groups:
        for values, where, advice in (
            (start, "began", "which way they turned back was arbitrary: another start may end elsewhere"),
            (end, "ended", "their gradient jumps there: wrong measurements, or a start that was too far off"),
        ):
            rows = np.flatnonzero(group.half_turned(values))
            if len(rows):
                listed = ", ".join(map(str, rows[:_LISTED])) + (" …" if len(rows) > _LISTED else "")
                notes.append(f"{len(rows)} of the residuals of {group.name} ({listed}) {where} half a turn off, {advice}")
    return tuple(notes)
