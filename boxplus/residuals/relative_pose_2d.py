"""The relative pose error of a pose graph in the plane (docs/residuals/relative_pose.md on SE(2))."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.manifolds.se2 import SE2, between_scalars, log_scalars
from boxplus.manifolds.so3 import inverse_jacobian_coefficient
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.whitening import Whitening


@kernel(inline=True)
def _error(Z: NDArray[np.float64], theta: float, x: float, y: float) -> tuple[float, float, float]:
    """Log(Z⁻¹ M) as (w, vx, vy) of a measured pose Z (3,) and the predicted one M."""
    theta_e, x_e, y_e = between_scalars(Z[0], Z[1], Z[2], theta, x, y)
    w, v0, v1 = log_scalars(theta_e, x_e, y_e)
    return w, v0, v1


@kernel
def evaluate_rows(
    begin: int,
    end: int,
    T_i: NDArray[np.float64],
    T_j: NDArray[np.float64],
    index_i: NDArray[np.uint32],
    index_j: NDArray[np.uint32],
    Z: NDArray[np.float64],
    r: NDArray[np.float64],
    valid: NDArray[np.bool_],
) -> None:
    for n in range(np.uint64(begin), np.uint64(end)):
        i, j = index_i[n], index_j[n]
        theta, x, y = between_scalars(T_i[i, 0], T_i[i, 1], T_i[i, 2], T_j[j, 0], T_j[j, 1], T_j[j, 2])
        r[n, 0], r[n, 1], r[n, 2] = _error(Z[n], theta, x, y)
        valid[n] = True


@kernel
def linearize_rows(
    begin: int,
    end: int,
    T_i: NDArray[np.float64],
    T_j: NDArray[np.float64],
    index_i: NDArray[np.uint32],
    index_j: NDArray[np.uint32],
    Z: NDArray[np.float64],
    r: NDArray[np.float64],
    J_i: NDArray[np.float64],
    J_j: NDArray[np.float64],
    valid: NDArray[np.bool_],
) -> None:
    for n in range(np.uint64(begin), np.uint64(end)):
        i, j = index_i[n], index_j[n]
        theta, x, y = between_scalars(T_i[i, 0], T_i[i, 1], T_i[i, 2], T_j[j, 0], T_j[j, 1], T_j[j, 2])
        w, v0, v1 = _error(Z[n], theta, x, y)
        r[n, 0], r[n, 1], r[n, 2] = w, v0, v1
        valid[n] = True
        # J_j = J_r⁻¹(e)
        d = inverse_jacobian_coefficient(w * w)
        a, h = 1.0 - w * w * d, 0.5 * w
        p, q = d * w * v0 + 0.5 * v1, d * w * v1 - 0.5 * v0
        J_j[n, 0, 0], J_j[n, 0, 1], J_j[n, 0, 2] = 1.0, 0.0, 0.0
        J_j[n, 1, 0], J_j[n, 1, 1], J_j[n, 1, 2] = p, a, -h
        J_j[n, 2, 0], J_j[n, 2, 1], J_j[n, 2, 2] = q, h, a
        # J_i = −J_j Ad(M⁻¹), where M⁻¹ turns by −theta and moves by (−c x − s y, s x − c y).
        c, s = math.cos(theta), math.sin(theta)
        ty, tx = s * x - c * y, c * x + s * y
        J_i[n, 0, 0], J_i[n, 0, 1], J_i[n, 0, 2] = -1.0, 0.0, 0.0
        J_i[n, 1, 0], J_i[n, 1, 1], J_i[n, 1, 2] = h * tx - a * ty - p, -a * c - h * s, h * c - a * s
        J_i[n, 2, 0], J_i[n, 2, 1], J_i[n, 2, 2] = -h * ty - a * tx - q, a * s - h * c, -h * s - a * c


class RelativePose2D(Residual):
    """e = Log(Z_ij⁻¹ T_world_i⁻¹ T_world_j), [w, vx, vy] [rad, m], of measured poses Z_ij of j in i.

    Jacobians on the right side as in space: −J_r⁻¹(e) Ad(T_j⁻¹ T_i) and J_r⁻¹(e) of SE(2). The rotation error is wrapped
    to [−π, π]; at half a turn its sign is arbitrary, residual and Jacobians stay finite.

    Args:
        measured: Z_ij (N, 3) [theta, x, y], mapping coordinates in j to coordinates in i.
        sigma, covariance, information: noise of [w, vx, vy], as for `Whitening.of`. Information that stands in a file
            translation first has to be reordered.

    Raises:
        InputError: wrong shapes, not finite, noise that is not positive.

    Example:
        >>> bp.residuals.RelativePose2D([[0.0, 1.0, 0.0]], sigma=0.1).evaluate([0.0, 0.0, 0.0], [0.0, 1.5, 0.0])
        array([[0. , 0.5, 0. ]])
    """

    rotation_rows = 1

    def __init__(
        self,
        measured: ArrayLike,
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
    ) -> None:
        self.measured = SE2.check("measured", measured)
        count = len(self.measured)
        super().__init__(
            dim=3,
            count=count,
            manifolds=(SE2, SE2),
            roles=("T_world_i", "T_world_j"),
            whitening=Whitening.of(3, count, sigma=sigma, covariance=covariance, information=information),
        )

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        linearize_rows(begin, end, x[0], x[1], index[0], index[1], self.measured, r, jacobians[0], jacobians[1], valid)

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        evaluate_rows(begin, end, x[0], x[1], index[0], index[1], self.measured, r, valid)
