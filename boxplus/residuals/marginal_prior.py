"""What is left of variables that were marginalised out: a Gaussian on the variables they were measured against."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.manifolds.manifold import Manifold
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.whitening import Whitening


class MarginalPrior(Residual):
    """r(x) = r₀ + J (x ⊟ x₀), whitened, over several variables together; `marginalize` makes it.

    The rows are d residuals of dimension 1 that share their variables. J and x₀ stay as they were where the variables were
    marginalised: only ∂(x ⊟ x₀)/∂x follows x (Jacobian J_k · `boxminus_jacobian(x_k, x₀_k)` for variable k). Other residuals
    take their Jacobians where x is now; where the two points drift apart, a direction that nothing measures may seem measured
    (first-estimates Jacobians would avoid it). As ½ ‖r‖² is a Gaussian already, it takes no robust loss: one would weigh each
    row alone.

    Args:
        manifolds: of the variables.
        x0: where they were, one (size,) for each.
        J: (d, sum of their degrees of freedom).
        r0: (d,).
        roles: names of the variables, for messages.
        fixes_gauge: whether the variables are tied to the world through what was marginalised.

    Raises:
        InputError: shapes that do not fit each other, points that are not on their manifolds.
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
        self.x0 = tuple(m.check(f"x0[{k}]", x)[0] for k, (m, x) in enumerate(zip(manifolds, x0, strict=True)))
        ends = np.cumsum([m.dof for m in manifolds])
        self._columns = tuple(slice(int(end) - m.dof, int(end)) for end, m in zip(ends, manifolds, strict=True))
        super().__init__(
            dim=1,
            count=len(self.J),
            manifolds=tuple(manifolds),
            roles=tuple(roles) if roles is not None else tuple(f"x{k}" for k in range(len(manifolds))),
            whitening=Whitening.of(1, len(self.J)),
            fixes_gauge=fixes_gauge,
        )

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        self.evaluate_into(begin, end, x, index, r, valid)
        for k, (manifold, columns) in enumerate(zip(self.manifolds, self._columns, strict=True)):
            at = x[k][index[k][begin:end]]
            # Every row is connected to the same variable, unless someone evaluates the rows apart.
            change = manifold.boxminus_jacobian(at[:1] if self._is_shared(at) else at, self.x0[k])
            jacobians[k][begin:end] = self.J[begin:end, None, columns] @ change

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        total = self.r0[begin:end].copy()
        for k, (manifold, columns) in enumerate(zip(self.manifolds, self._columns, strict=True)):
            at = x[k][index[k][begin:end]]
            moved = manifold.boxminus(at[:1] if self._is_shared(at) else at, self.x0[k])
            total += (self.J[begin:end, columns] * moved).sum(axis=1)
        r[begin:end, 0] = total
        valid[begin:end] = True

    @staticmethod
    def _is_shared(at: NDArray[np.float64]) -> bool:
        return bool((at == at[:1]).all())
