"""Components of variables that are held while the others move, such as the height of a pose: `Problem.fix(…, components=…)`.

The other groups have no Jacobian for them. A residual of their own, zero with the Jacobian 1, keeps the normal matrix regular:
their step is zero, exactly, and their covariance is taken out again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError
from boxplus.optimization.losses import Squared
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.whitening import Whitening


class HeldComponents(Residual):
    """r = 0 with a Jacobian of ones and zeros: 1 for every component (N, dof) that is held."""

    def __init__(self, block: Variables, is_held: NDArray[np.bool_]) -> None:
        dof, count = block.manifold.dof, len(is_held)
        self._jacobian = np.eye(dof) * is_held[:, None, :]
        whitening = Whitening.of(dof, count)
        super().__init__(dim=dof, count=count, manifolds=(block.manifold,), roles=(block.name,), whitening=whitening)

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """See `Residual.linearize_into`."""
        self.evaluate_into(begin, end, x, index, r, valid)
        jacobians[0][begin:end] = self._jacobian[begin:end]

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """See `Residual.evaluate_into`."""
        r[begin:end] = 0.0
        valid[begin:end] = True


def held_groups(blocks: list[Variables]) -> list[Group]:
    """A group for every block of which single components are held."""
    groups = []
    for block in blocks:
        if block.is_held is not None:
            rows = np.flatnonzero(block.is_held.any(axis=1) & ~block.is_fixed)
            if len(rows):
                residual = HeldComponents(block, block.is_held[rows])
                groups.append(
                    Group(residual, [block[block.ids[rows]]], Squared(), f"held components of {block.name}", holds=True)
                )
    return groups


def component_mask(block: Variables, components: ArrayLike) -> NDArray[np.bool_]:
    """(dof,) bool of components by their places in the tangent.

    Raises:
        InputError: a component that the manifold does not have.
    """
    given = np.atleast_1d(np.asarray(components))
    names = ", ".join(f"{k} {name}" for k, name in enumerate(block.manifold.tangent_names))
    if given.ndim != 1 or not np.issubdtype(given.dtype, np.integer) or not len(given):
        raise InputError(f"components of {block.name!r} ({names})", f"{components!r}", "give their places in the tangent")
    if given.min() < 0 or given.max() >= block.manifold.dof:
        raise InputError(f"components of {block.name!r} ({names})", f"{components!r}", "give their places in the tangent")
    mask = np.zeros(block.manifold.dof, dtype=np.bool_)
    mask[given] = True
    return mask
