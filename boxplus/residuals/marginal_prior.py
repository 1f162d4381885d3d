"""What is left of variables that were marginalised out: a Gaussian on the variables they were measured against."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import numpy as np
from numpy.typing import ArrayLike

from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.manifolds.manifold import Manifold
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.whitening import Whitening


class MarginalPrior(Residual):
    """r(x) = r₀ + J (x ⊟ x₀), whitened, over several variables together; `boxplus.marginalize` makes it.

    One residual of d rows (docs/marginalization.md). J and x₀ stay as they were; only ∂(x ⊟ x₀)/∂x follows x (Jacobian
    J_k · `boxminus_jacobian(x_k, x₀_k)` for variable k). A problem takes the Jacobians of its variables, those of other residuals
    too, at x₀, unless `keeps_first_estimates` is off: where the two points differ, a direction that nothing measures would seem
    measured. As ½ ‖r‖² is a Gaussian already, it takes no robust loss.

    Args:
        manifolds: of the variables.
        x0: where they were, one (size,) for each.
        J: (d, sum of their degrees of freedom).
        r0: (d,).
        roles: names of the variables, for messages.
        fixes_gauge: whether the variables are tied to the world through what was marginalised.
        keeps_first_estimates: whether a problem takes all Jacobians of the variables at x0.

    Raises:
        InputError: shapes that do not fit each other, points that are not on their manifolds.

    Example:
        >>> prior = bp.residuals.MarginalPrior([bp.Euclidean(2)], [[1.0, 2.0]], 2.0 * np.eye(2), [0.0, 0.0])
        >>> prior.evaluate([1.5, 2.0])  # r0 + J (x - x0)
        array([[1., 0.]])
    """

    def __init__(
        self,
        manifolds: Sequence[Manifold],
        x0: Sequence[ArrayLike],
        J: ArrayLike,
        r0: ArrayLike,
        *,
        roles: Sequence[str] | None = None,
        fixes_gauge: bool = False,
        keeps_first_estimates: bool = True,
    ) -> None:
        self.J, self.r0 = np.array(as_floats(J, "J")), np.array(as_floats(r0, "r0"))
        dof = sum(manifold.dof for manifold in manifolds)
        if len(manifolds) != len(x0) or not manifolds:
            raise InputError(
                "a point x0 for each of the manifolds", f"{len(x0)} for {len(manifolds)}", "give one for each variable"
            )
        if self.J.ndim != 2 or self.J.shape[1] != dof or self.r0.shape != self.J.shape[:1] or not len(self.J):
            raise InputError(
                f"J (d, {dof}) and r0 (d,), d ≥ 1", f"shapes {self.J.shape} and {self.r0.shape}", "stack J over the variables"
            )
        if not (np.isfinite(self.J).all() and np.isfinite(self.r0).all()):
            raise InputError("finite J and r0", "NaN or infinity", "marginalise where all residuals can be evaluated")
        self.keeps_first_estimates = keeps_first_estimates
        ends = list(accumulate(m.dof for m in manifolds))
        self._J = tuple(self.J[:, end - m.dof : end].copy() for end, m in zip(ends, manifolds, strict=True))
        # Variables on one manifold are checked and compared with their points all at once.
        points: dict[int, Array] = {}
        self._alike = []
        for manifold in dict.fromkeys(manifolds):
            slots = [k for k, other in enumerate(manifolds) if other == manifold]
            checked = manifold.check("x0", np.array([x0[k] for k in slots]))
            points |= dict(zip(slots, checked, strict=True))
            columns = np.array([c for k in slots for c in range(ends[k] - manifold.dof, ends[k])])
            self._alike.append((manifold, slots, checked, columns))
        self.x0 = tuple(points[k] for k in range(len(manifolds)))
        rows = len(self.J)
        super().__init__(
            dim=rows,
            count=1,
            manifolds=tuple(manifolds),
            roles=tuple(roles) if roles is not None else tuple(f"x{k}" for k in range(len(manifolds))),
            whitening=Whitening(np.eye(rows)[None], True),
            fixes_gauge=fixes_gauge,
        )

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """See `Residual.linearize_into`."""
        has_moved = False
        for manifold, slots, x0, _ in self._alike:
            at = _points(slots, x, index)
            away = (at != x0).any(axis=1)
            has_moved |= bool(away.any())
            for n, k in enumerate(slots):
                J = self._J[k]
                jacobians[k][begin:end] = J @ manifold.boxminus_jacobian(at[n], x0[n]) if away[n] else J
        if has_moved:
            self.evaluate_into(begin, end, x, index, r, valid)
        else:  # as where first estimates are kept
            r[begin:end], valid[begin:end] = self.r0, True

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """See `Residual.evaluate_into`."""
        moved = np.empty(self.J.shape[1])
        for manifold, slots, x0, columns in self._alike:
            moved[columns] = manifold.boxminus(_points(slots, x, index), x0).reshape(-1)
        r[begin:end] = self.r0 + (self.J * moved).sum(axis=1)
        valid[begin:end] = True


def _points(slots: list[int], x: Arrays, index: Rows) -> Array:
    """(len(slots), size) of the variables in these slots."""
    if all(x[k] is x[slots[0]] for k in slots):
        return x[slots[0]][[int(index[k][0]) for k in slots]]
    return np.stack([x[k][index[k][0]] for k in slots])
