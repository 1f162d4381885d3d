"""How many residuals a robust loss has silenced: what a converged solution does not say by itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.losses import SQUARED
from boxplus.optimization.terms.group import Group

FADED = 0.1
"""A residual whose weight ρ′ is below this hardly counts."""
_LARGE = 0.05  # share of a group that makes a sentence


def faded_shares(groups: Sequence[Group], values: Sequence[NDArray[np.float64]] | None) -> dict[str, float]:
    """For every group with a robust loss, by name, the share of its valid residuals whose weight is below `FADED`.

    Args:
        values: the point; None where the groups are linearised at it.
    """
    shares = {}
    for group in groups:
        if group.loss.code == SQUARED:
            continue
        weights = group.loss_weights(values)
        valid = int(np.count_nonzero(group.valid))
        shares[group.name] = float(np.count_nonzero((weights < FADED) & group.valid)) / max(valid, 1)
    return shares


def faded_notes(groups: Sequence[Group], shares: dict[str, float]) -> tuple[str, ...]:
    """A sentence for every group of which a large share hardly counts."""
    return tuple(
        f"{100.0 * shares[group.name]:.2g} % of the residuals of {group.name} have weight below {FADED:g} under {group.loss!r} "
        "and hardly count: right if so many are outliers; else the start was too far off, or the sigmas are too small"
        for group in groups
        if shares.get(group.name, 0.0) > _LARGE
    )
