"""Taking variables and residuals out of a problem, and what that does to the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals.marginal_prior import MarginalPrior

Masks = list[NDArray[np.bool_]]
"""For every block which of its variables, or for every group which of its residuals."""


def touching(groups: Sequence[Group], gone: Masks) -> Masks:
    """For every group (N,) which residuals are there and connected to one of the variables `gone`."""
    touched = []
    leaves = [bool(mask.any()) for mask in gone]
    for group in groups:
        hit = np.zeros(group.residual.count, dtype=np.bool_)
        for c in group.connections:
            if leaves[c.block.number]:
                hit |= gone[c.block.number][c.rows]
        touched.append(hit if group.removed is None else hit & ~group.removed)
    return touched


def require_forgettable(groups: Sequence[Group], gone: Masks, chosen: Masks) -> None:
    """Variables must not leave behind a marginal prior that knows them.

    Raises:
        InputError: one would.
    """
    for group, rows in zip(groups, chosen, strict=True):
        if isinstance(group.residual, MarginalPrior) and not rows.all():
            known = [f"{c.block.name}[{c.ids[0]}]" for c in group.connections if gone[c.block.number][c.rows[0]]]
            if known:
                raise InputError(
                    f"variables that {group.name!r} does not know",
                    ", ".join(known),
                    "marginalise them, or remove the prior as well",
                )


def take_out(
    blocks: Sequence[Variables], groups: Sequence[Group], gone: Masks, chosen: Masks
) -> tuple[list[Group], dict[str, int]]:
    """Remove variables and residuals; returns the groups that have some left, and for every group that lost some how many.

    `keep_first_estimates` has to follow.
    """
    counts: dict[str, int] = {}
    left = []
    for group, rows in zip(groups, chosen, strict=True):
        fresh = rows if group.removed is None else rows & ~group.removed
        if fresh.any():
            counts[group.name] = int(fresh.sum())
        if (rows if group.removed is None else rows | group.removed).all():
            continue
        group.remove(fresh)
        left.append(group)
    for block, mask in zip(blocks, gone, strict=True):
        block.drop(mask)
    return left, counts


def keep_first_estimates(blocks: Sequence[Variables], groups: Sequence[Group]) -> None:
    """Take Jacobians of the variables that marginal priors know at their first estimates, those of others where they are."""
    known = [np.zeros(len(block), dtype=np.bool_) for block in blocks]
    x0 = [block.values.copy() for block in blocks]
    for group in groups:
        prior = group.residual
        if isinstance(prior, MarginalPrior) and prior.keeps_first_estimates:
            for c, x in zip(group.connections, prior.x0, strict=True):
                number, row = c.block.number, c.rows[0]
                if not known[number][row]:  # the earlier prior has the first estimate
                    known[number][row], x0[number][row] = True, x
    for block, mask, points in zip(blocks, known, x0, strict=True):
        block.keep_first_estimates(mask, points)
    for group in groups:
        group.synchronize()
