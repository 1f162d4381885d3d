"""What it means for a reconstruction that a limit ended its adjustment: whether cameras or many points have a way to go.

Points that are as good as infinitely far creep on for as long as one lets them, and change nothing but a distance that is not
determined anyway: they are counted, and speak against nothing. A few others that are still on their way are named.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._words import counted, either
from boxplus.optimization.minimizers.distances import AWAY
from boxplus.optimization.solution import Solution
from boxplus.optimization.terms.variables import VariableRows, Variables
from boxplus.systems.bundle_adjustment.sightings import names_text

_FEW = 0.005  # of the points, that may be on their way while the rest is to be trusted


def unconverged_findings(
    solution: Solution, points: Variables, vague: NDArray[np.int64], ids: NDArray[np.int64] | None
) -> tuple[str | None, list[str]]:
    """(doubt, notes).

    Args:
        vague: numbers of the points whose depth is not determined.
        ids: of the points, where they have any.
    """
    remainder = solution.remainder()
    if remainder is None:
        return None, []
    is_vague = np.zeros(len(points), dtype=np.bool_)
    is_vague[vague] = True
    creeping = np.flatnonzero((remainder.variables[points.number] > AWAY) & is_vague)
    remainder = solution.remainder(apart_from=_some(points, is_vague))
    is_late = np.zeros(len(points), dtype=np.bool_) if remainder is None else remainder.variables[points.number] > AWAY
    late = np.flatnonzero(is_late)
    few = len(late) <= _FEW * len(points)
    doubt = solution.unconverged(apart_from=_some(points, is_vague | is_late if few else is_vague))
    notes = []
    if len(creeping):
        notes.append(
            f"{counted(len(creeping), 'point')} whose depth is not determined {either(len(creeping), 'was', 'were')} still "
            f"moving when the adjustment ended ({solution.reason}), a matter of their distance alone: {names_text(creeping, ids)}"
        )
    if few and len(late) and doubt is None:
        notes.append(
            f"{counted(len(late), 'point')} of {len(points)} ended more than a standard deviation from where the images agree "
            f"best ({solution.reason}): {names_text(late, ids)}"
        )
    return doubt, notes


def _some(points: Variables, chosen: NDArray[np.bool_]) -> VariableRows | None:
    return points[chosen] if chosen.any() else None
