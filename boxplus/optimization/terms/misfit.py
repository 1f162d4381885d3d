"""What speaks against a solution that converged: residuals that no noise explains, and standard deviations that promise less."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_exceeded, chi_square_quantile
from boxplus._words import either
from boxplus.optimization.losses import SQUARED
from boxplus.optimization.terms.group import Group

_STRANGE = 1e-6  # chance that a residual of a sound group, the worst of all, stands out
_GROSS = 4.0  # times as much, squared: twice the largest that noise comes to
_FEW = 10  # residuals of a group from which on there is a usual one
_PROMISED = 9.0  # times what the standard deviations promise of χ²: errors three times larger than these
_LISTED = 5


def misfit_notes(groups: Sequence[Group], values: Sequence[NDArray[np.float64]], dof: int) -> tuple[str, ...]:
    """Sentences on residuals that stand out and on χ², at values of all blocks.

    Args:
        dof: of the free variables.
    """
    notes, rows, chi2, is_known = [], 0, 0.0, True
    for group in groups:
        own = group.unweighed()
        squared = own.squares(values)
        counted = np.isfinite(squared)
        is_given = not own.is_white
        if group.loss.code == SQUARED and group.residual.dim:
            notes += _standing_out(group.name, group.residual.dim, squared, counted, is_given)
        is_known &= is_given and group.loss.code == SQUARED and not group.is_weighted
        rows += group.residual.dim * int(np.count_nonzero(counted))
        chi2 += float(squared[counted].sum())
    left = rows - dof
    if is_known and left > 0 and chi2 > _PROMISED * max(left, chi_square_quantile(0.999, left)):
        notes.append(
            f"χ² is {chi2 / left:.3g} times what the standard deviations promise ({chi2:.6g} for {left:,} degrees of freedom): "
            "wrong measurements, a wrong model or minimum, or standard deviations that are too small, with those of the result"
        )
    return tuple(notes)


def _standing_out(name: str, dim: int, squared: NDArray[np.float64], counted: NDArray[np.bool_], is_given: bool) -> list[str]:
    """By the usual residual of the group, or by its standard deviations where these are given and larger."""
    number = int(np.count_nonzero(counted))
    if number < _FEW:
        return []
    scale = float(np.median(squared[counted])) / chi_square_quantile(0.5, dim)
    scale = max(scale, 1.0) if is_given else scale
    limit = chi_square_exceeded(_STRANGE / number, dim)
    if not scale > 0.0:
        return []
    found = np.flatnonzero(counted & (squared > _GROSS * scale * limit))
    if not len(found):
        return []
    found = found[np.argsort(-squared[found], kind="stable")]
    listed = ", ".join(map(str, found[:_LISTED])) + (" …" if len(found) > _LISTED else "")
    times = float(np.sqrt(squared[found[0]] / scale / dim))
    are = either(len(found), "is", "are up to")
    return [
        f"{len(found)} of the {number} residuals of {name} ({listed}) {are} {times:.3g} times larger than usual ones, which no "
        "noise explains; least squares bends everything to them: wrong measurements (a robust loss, `graduate`), or a wrong "
        "minimum"
    ]
