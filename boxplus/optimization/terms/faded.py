"""How many residuals a robust loss has silenced: what a converged solution does not say by itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_exceeded
from boxplus.optimization.losses import SQUARED
from boxplus.optimization.terms.group import Group

FADED = 0.1
"""A residual whose weight ρ′ is below this hardly counts."""
_LARGE = 0.05  # share of a group that makes a sentence
_NOISE = 1e-3  # chance of noise as large as sigmas promise to be beyond; of many rows it often is where a narrow loss silences it


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


def faded_notes(
    groups: Sequence[Group], shares: dict[str, float], values: Sequence[NDArray[np.float64]], threads: int
) -> tuple[str, ...]:
    """A sentence for every group of which a large share hardly counts, and is larger than noise as sigmas promise it.

    Args:
        shares: as `faded_shares` has them.
        values: the point. threads: the result is the same for any number.
    """
    return tuple(
        f"{100.0 * shares[group.name]:.2g} % of the residuals of {group.name} have weight below {FADED:g} under {group.loss!r} "
        "and hardly count: right if so many are outliers; else the start was too far off, or the sigmas are too small"
        for group in groups
        if shares.get(group.name, 0.0) > _LARGE and _unexplained(group, values, threads) > _LARGE
    )


def _unexplained(group: Group, values: Sequence[NDArray[np.float64]], threads: int) -> float:
    """Share of the valid residuals that are larger than noise comes to, whatever the loss makes of them."""
    squares = group.unweighed().squares(values, threads)
    known = squares[np.isfinite(squares)]
    return float((known > chi_square_exceeded(_NOISE, group.residual.dim)).mean()) if len(known) else 0.0
