"""The problem as the solvers see it: values, groups and one linear system, at one point at a time."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError, NotFiniteError
from boxplus.manifolds.manifold import Manifold
from boxplus.optimization.linear_systems.linear_system import LinearSystem
from boxplus.optimization.terms.group import Group, GroupCost
from boxplus.optimization.terms.layout import Layout
from boxplus.optimization.terms.tangents import best_tangents
from boxplus.optimization.terms.weighting import (
    add_own_curvature,
    add_product_with_jacobian,
    add_product_with_transposed_jacobian,
)

Values = Sequence[NDArray[np.float64]]


def inner(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """aᵀb, summed pairwise: BLAS would wake its threads for it, and let the bits depend on their number."""
    return float((a * b).sum())


@kernel
def _steepest(gradient: NDArray[np.float64], diagonal: NDArray[np.float64], length: float) -> float:
    """Largest |gᵢ| / (‖r‖ √Hᵢᵢ)."""
    steepest = 0.0
    for k in range(np.uint64(len(gradient))):
        # Roots before products: sigmas far from 1 overflow the product, and everything would seem to be at a right angle.
        reach = length * math.sqrt(diagonal[k]) if diagonal[k] > 0.0 else 0.0
        if reach > 0.0:
            steepest = max(steepest, abs(gradient[k]) / reach)
    return steepest


class LeastSquares:
    """Cost, linearisation and linear system of residual groups over a layout.

    Args:
        keeps_tangents: poses are moved by the ⊞ they were given, whether another were better conditioned or not.

    Attributes:
        values: of every block, at the accepted point.
        cost: at the accepted point.
        factorization: another number for every factorisation and accepted point; what was factorised is there while it stays.
        timing_s: seconds spent by stage.
    """

    def __init__(
        self, layout: Layout, groups: Sequence[Group], system: LinearSystem, threads: int, *, keeps_tangents: bool = False
    ) -> None:
        self.layout, self.groups, self.system = layout, tuple(groups), system
        self.values: Values = [block.values for block in layout.blocks]
        self.cost = GroupCost(0.0, 0.0, 0, 0)
        self.timing_s = {"residuals and Jacobians": 0.0, "normal equations": 0.0, "linear solve": 0.0}
        self.factorization = 0
        self._threads = threads
        self._revisions = tuple(group.revision for group in self.groups)
        self._linearized: Values = ()
        self._tangents: tuple[Manifold, ...] | None = None  # where they are not the blocks' own
        self._has_tangents = keeps_tangents

    def start(self, values: Values) -> None:
        """Linearise at `values` and accept them.

        Raises:
            InputError: variables or residuals were removed since the problem was analysed; no residual can be evaluated.
            NotFiniteError: a residual or a Jacobian is NaN or infinite there.
        """
        self.require_current()
        for group in self.groups:
            group.counted[:] = False
        cost = self.linearize(values)
        if not np.isfinite(cost.cost):
            self._explain_not_finite(values)
        if cost.valid == 0 and any(group.residual.count for group in self.groups):
            raise InputError(
                "a start where residuals can be evaluated",
                "none that can",
                "start from values where points lie before their cameras",
            )
        if not self._has_tangents:
            self._has_tangents = True
            best = best_tangents(self.layout, self.groups, values)
            if best != self.layout.tangents:
                self.layout.tangents = self._tangents = best
                cost = self.linearize(values)
        self.accept(values, cost)

    @property
    def is_linearized(self) -> bool:
        """Whether the groups are linearised at the accepted point; not so after a rejected step."""
        return self._linearized is self.values

    def require_current(self) -> None:
        """Raises InputError where variables or residuals were removed since the problem was analysed."""
        revisions = tuple(group.revision for group in self.groups)
        if not self.layout.is_current or revisions != self._revisions:
            raise InputError(
                "a problem that is as it was when it was solved",
                "one from which variables or residuals were removed since",
                "ask a solution about covariances before that, or solve again",
            )

    def linearize(self, values: Values) -> GroupCost:
        """Linearise every group at `values`, without accepting them: the linear system keeps the accepted point."""
        begin = time.perf_counter()
        self._linearized = values
        total = GroupCost(0.0, 0.0, 0, 0)
        for group in self.groups:
            total = total + group.linearize(values, self._threads, self._tangents)
        self.timing_s["residuals and Jacobians"] += time.perf_counter() - begin
        return total

    def accept(self, values: Values, cost: GroupCost) -> None:
        """Take the point just linearised: assemble the linear system there.

        Raises:
            NotFiniteError: a Jacobian is NaN or infinite there.
        """
        begin = time.perf_counter()
        for group in self.groups:
            group.accept()
        self.values, self.cost = values, cost
        self.factorization += 1
        self.system.assemble()
        if not (np.isfinite(self.system.gradient).all() and np.isfinite(self.system.diagonal).all()):
            self._explain_not_finite(values)
        self.timing_s["normal equations"] += time.perf_counter() - begin

    def factorize(self, damping: NDArray[np.float64] | None) -> None:
        """Factorise H + diag(damping) at the accepted point.

        Raises:
            NotPositiveDefinite: see `LinearSystem.factorize`.
        """
        if self.system.reads_jacobians and not self.is_linearized:
            self.linearize(self.values)  # after a rejected step
        self.factorization += 1
        self.system.factorize(damping)

    def solve(self, damping: NDArray[np.float64] | None) -> NDArray[np.float64]:
        """δ (dof,) with (H + diag(damping)) δ = −g.

        Raises:
            NotPositiveDefinite: see `LinearSystem.factorize`.
        """
        begin = time.perf_counter()
        try:
            self.factorize(damping)
            return self.system.solve(-self.system.gradient)
        finally:
            self.timing_s["linear solve"] += time.perf_counter() - begin

    def slope(self) -> float:
        """Largest |cos| of the angle between the residuals and a column of the Jacobian: zero at a minimum, free of units."""
        return float(_steepest(self.system.gradient, self.system.diagonal, float(np.sqrt(2.0 * self.cost.cost))))

    def moved(self, delta: NDArray[np.float64]) -> Values:
        """The accepted point moved by δ."""
        return self.layout.boxplus(self.values, delta)

    def product(self, delta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Jδ, all groups one after the other; only while the accepted point is the one linearised last."""
        parts = []
        for group in self.groups:
            product = np.zeros_like(group.r)
            for connection, J in zip(group.connections, group.jacobians, strict=True):
                add_product_with_jacobian(J, self.layout.starts(connection), delta, product)
            parts.append(product.reshape(-1))
        return np.concatenate(parts)

    def transposed_product(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Jᵀz (dof,) of z (rows of all groups,); see `product`."""
        product, begin = np.zeros(self.layout.dof), 0
        for group in self.groups:
            mine = z[begin : begin + group.r.size].reshape(group.r.shape)
            for connection, J in zip(group.connections, group.jacobians, strict=True):
                add_product_with_transposed_jacobian(J, self.layout.starts(connection), mine, product)
            begin += group.r.size
        return product

    def own_curvatures(self) -> list[NDArray[np.float64]]:
        """For every block the diagonal blocks of H (free variables, dof, dof); see `product`."""
        own = []
        for block, number in zip(self.layout.blocks, self.layout.number, strict=True):
            of = np.where(number >= 0, np.cumsum(number >= 0) - 1, -1)
            mine = np.zeros((int(np.count_nonzero(number >= 0)), block.manifold.dof, block.manifold.dof))
            for group in self.groups:
                for connection, J in zip(group.connections, group.jacobians, strict=True):
                    if connection.block is block:
                        add_own_curvature(J, of[self.layout.rows(connection)], mine)
            own.append(mine)
        return own

    def curvature(self, delta: NDArray[np.float64]) -> float:
        """δᵀHδ = ‖Jδ‖²; see `product`."""
        product = self.product(delta)
        return inner(product, product)

    def _explain_not_finite(self, values: Values) -> None:
        for group in self.groups:
            found = group.find_not_finite()
            if found is None:
                continue
            row, what = found
            inputs = ", ".join(
                f"{role} = {c.block.name}[{c.ids[row]}] = {np.array2string(values[c.block.number][c.rows[row]], precision=6)}"
                for role, c in zip(group.residual.roles, group.connections, strict=True)
            )
            raise NotFiniteError(
                "finite residuals and Jacobians",
                f"NaN or infinity in the {what} of residual {row} of group {group!r}, at {inputs}",
                "repair that measurement, or the residual, or start elsewhere",
            )
        raise NotFiniteError("a finite cost", "an overflow in the sum", "scale the residuals by their standard deviations")
