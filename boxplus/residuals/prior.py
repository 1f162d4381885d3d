"""What is known about a variable beforehand, on any manifold."""

from __future__ import annotations

from numpy.typing import ArrayLike

from boxplus._arguments import require
from boxplus.manifolds.manifold import Manifold
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.whitening import Whitening


class Prior(Residual):
    """r = x ⊟ mean, in the tangent of `manifold`; its Jacobian is `manifold.boxminus_jacobian(x, mean)`.

    Args:
        manifold: of the variable, such as `SE3` or `Euclidean(3)`; its side decides what sigma means: for `SE3` the
            tangent is seen in the body, for `SE3Left` in the world.
        mean: (N, size), or (size,) for a single one.
        sigma, covariance, information: noise in tangent units, as for `Whitening.of`.

    Raises:
        InputError: a mean that is not on the manifold, noise that is not positive.

    Example:
        >>> bp.residuals.Prior(bp.SE2, [0.0, 1.0, 0.0], sigma=[0.01, 0.1, 0.1]).evaluate([0.1, 1.0, 0.0]).round(3)
        array([[0.1, 0. , 0. ]])
    """

    def __init__(
        self,
        manifold: Manifold,
        mean: ArrayLike,
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
    ) -> None:
        require(manifold, Manifold, "a manifold", "give one such as boxplus.SE3 or boxplus.Euclidean(3)")
        self.mean = manifold.check("mean", mean)
        count = len(self.mean)
        super().__init__(
            dim=manifold.dof,
            count=count,
            manifolds=(manifold,),
            roles=("x",),
            whitening=Whitening.of(manifold.dof, count, sigma=sigma, covariance=covariance, information=information),
        )

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        self.evaluate_into(begin, end, x, index, r, valid)
        jacobians[0][begin:end] = self.manifolds[0].boxminus_jacobian(x[0][index[0][begin:end]], self.mean[begin:end])

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        r[begin:end] = self.manifolds[0].boxminus(x[0][index[0][begin:end]], self.mean[begin:end])
        valid[begin:end] = True
