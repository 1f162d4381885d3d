"""Which way is up, as a body measured it (docs/residuals/gravity_direction.md).

Residual, the sines of the angles between the vertical ẑ of the world and the direction û measured in the body, in a basis B (3 ×
2)
of the plane across û:

    e = Bᵀ Rᵀ ẑ,        R = R_world_body.

On the right, R ← R Exp(w), (Rᵀ ẑ) moves by Rᵀẑ × w, so that ∂e/∂[w, v] = [Bᵀ [Rᵀẑ]×  0]. Yaw and position are left alone exactly,
however far from the measurement, which a prior on a pose with information about two axes is not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.manifolds import quaternion, so3
from boxplus.manifolds.se3 import SE3
from boxplus.residuals.point_to_plane import checked_normals
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.whitening import Whitening


class GravityDirection(Residual):
    """Sines of the angles between the vertical and its measurements, as derived in the head of this file.

    Variable: `T_world_body` (7,) on `SE3`. Upside down, e is zero too: the start must be better than that.

    Args:
        up_body: (N, 3) unit vectors against gravity, in the body's frame.
        up_world: (3,) unit vector, of the world.
        sigma, covariance, information: of the two sines [rad], as in `Whitening.of`.

    Raises:
        InputError: directions of another shape or length, noise that `Whitening.of` refuses.

    Example:
        >>> up = bp.residuals.GravityDirection([[0.0, 0.0, 1.0]], sigma=0.01)
        >>> up.evaluate(bp.SE3.identity())
        array([[0., 0.]])
    """

    def __init__(
        self,
        up_body: ArrayLike,
        up_world: ArrayLike = (0.0, 0.0, 1.0),
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
    ) -> None:
        self.up_body = checked_normals("up_body", up_body)
        world = as_floats(up_world, "up_world")
        if world.shape != (3,):
            raise InputError("up_world of shape (3,)", f"shape {world.shape}", "give one direction for all")
        self.up_world = checked_normals("up_world", world[None])[0]
        count = len(self.up_body)
        super().__init__(
            dim=2,
            count=count,
            manifolds=(SE3,),
            roles=("T_world_body",),
            whitening=Whitening.of(2, count, sigma=sigma, covariance=covariance, information=information),
        )
        self._across = _basis_across(self.up_body)

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """See `Residual.linearize_into`."""
        up = self._up(begin, end, x, index, r, valid)
        jacobians[0][begin:end, :, :3] = self._across[begin:end] @ so3.hat(up)
        jacobians[0][begin:end, :, 3:] = 0.0

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """See `Residual.evaluate_into`."""
        self._up(begin, end, x, index, r, valid)

    def _up(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> Array:
        R = quaternion.to_matrix(x[0][index[0][begin:end], :4])
        up = self.up_world @ R
        r[begin:end] = np.einsum("nab,nb->na", self._across[begin:end], up)
        valid[begin:end] = True
        return np.asarray(up)


def _basis_across(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 2, 3): two unit vectors across each direction."""
    helper = np.zeros_like(directions)
    helper[np.arange(len(directions)), np.argmin(np.abs(directions), axis=1)] = 1.0
    first = np.cross(directions, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=1)
