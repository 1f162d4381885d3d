"""The relative pose error of a pose graph (docs/residuals/relative_pose.md)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.manifolds.quaternion import multiply_scalars, rotate, rotation_entries
from boxplus.manifolds.se3 import SE3, between_scalars, log_scalars
from boxplus.manifolds.se3_jacobians import dual_blocks_into, right_jacobian_inverse_into
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.whitening import Whitening


@kernel(inline=True)
def error_scalars(
    Z: NDArray[np.float64], qw: float, qx: float, qy: float, qz: float, x: float, y: float, z: float
) -> tuple[float, float, float, float, float, float]:
    """Log(Z⁻¹ M) as (w, v) of a measured pose Z (7,) and the predicted one M."""
    ew, ex, ey, ez = multiply_scalars(Z[0], -Z[1], -Z[2], -Z[3], qw, qx, qy, qz)
    tx, ty, tz = rotate(Z[0], -Z[1], -Z[2], -Z[3], x - Z[4], y - Z[5], z - Z[6])
    w0, w1, w2, v0, v1, v2 = log_scalars(ew, ex, ey, ez, tx, ty, tz)
    return w0, w1, w2, v0, v1, v2


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
        qw, qx, qy, qz, x, y, z = between_scalars(T_i[index_i[n]], T_j[index_j[n]])
        r[n, 0], r[n, 1], r[n, 2], r[n, 3], r[n, 4], r[n, 5] = error_scalars(Z[n], qw, qx, qy, qz, x, y, z)
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
    is_exact: bool,
    r: NDArray[np.float64],
    J_i: NDArray[np.float64],
    J_j: NDArray[np.float64],
    valid: NDArray[np.bool_],
) -> None:
    for n in range(np.uint64(begin), np.uint64(end)):
        qw, qx, qy, qz, x, y, z = between_scalars(T_i[index_i[n]], T_j[index_j[n]])
        w0, w1, w2, v0, v1, v2 = error_scalars(Z[n], qw, qx, qy, qz, x, y, z)
        r[n, 0], r[n, 1], r[n, 2], r[n, 3], r[n, 4], r[n, 5] = w0, w1, w2, v0, v1, v2
        valid[n] = True
        if is_exact:
            right_jacobian_inverse_into(w0, w1, w2, v0, v1, v2, J_j[n])
        else:
            dual_blocks_into(w0, w1, w2, v0, v1, v2, 0.5, 0.0, 0.0, 0.0, J_j[n])
        # J_i = −J_j Ad(M⁻¹) with Ad(M⁻¹) = [[Rᵀ, 0], [−Rᵀ [t]x, Rᵀ]]: a row a Rᵀ is the column R a, and a [t]x is a × t.
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_entries(qw, qx, qy, qz)
        for k in range(3):
            a0, a1, a2 = J_j[n, k, 0], J_j[n, k, 1], J_j[n, k, 2]
            b0, b1, b2 = J_j[n, k + 3, 0], J_j[n, k + 3, 1], J_j[n, k + 3, 2]
            c0, c1, c2 = r00 * a0 + r01 * a1 + r02 * a2, r10 * a0 + r11 * a1 + r12 * a2, r20 * a0 + r21 * a1 + r22 * a2
            J_i[n, k, 0], J_i[n, k, 1], J_i[n, k, 2] = -c0, -c1, -c2
            J_i[n, k, 3], J_i[n, k, 4], J_i[n, k, 5] = 0.0, 0.0, 0.0
            J_i[n, k + 3, 3], J_i[n, k + 3, 4], J_i[n, k + 3, 5] = -c0, -c1, -c2
            J_i[n, k + 3, 0] = c1 * z - c2 * y - (r00 * b0 + r01 * b1 + r02 * b2)
            J_i[n, k + 3, 1] = c2 * x - c0 * z - (r10 * b0 + r11 * b1 + r12 * b2)
            J_i[n, k + 3, 2] = c0 * y - c1 * x - (r20 * b0 + r21 * b1 + r22 * b2)


class RelativePose(Residual):
    """e = Log(Z_ij⁻¹ T_world_i⁻¹ T_world_j), [w, v] [rad, m], of measured poses Z_ij of j in i (docs/residuals/relative_pose.md).

    On the right side, e_i = −J_r⁻¹(e) Ad(T_j⁻¹ T_i) and e_j = J_r⁻¹(e). Where the rotation error is half a turn the
    sign of its axis is arbitrary and the Jacobian jumps: residual and Jacobians stay finite there, and `at_half_turn` tells.

    Args:
        measured: Z_ij (N, 7) [qw, qx, qy, qz, x, y, z], mapping coordinates in j to coordinates in i.
        sigma, covariance, information: noise of [w, v], as for `Whitening.of`. Information that stands in a file
            translation first has to be reordered.
        jacobian: "first_order" replaces J_r⁻¹(e) by I + ½ ad(e), whose error stays below ‖e‖²/6 (docs/manifolds.md).

    Raises:
        InputError: wrong shapes, quaternions not of unit length, noise that is not positive.

    Example:
        >>> edge = bp.residuals.RelativePose([[1.0, 0, 0, 0, 1.0, 0, 0]], sigma=[0.01] * 3 + [0.1] * 3)
        >>> edge.evaluate(bp.SE3.identity(), [1.0, 0, 0, 0, 1.5, 0, 0])
        array([[0. , 0. , 0. , 0.5, 0. , 0. ]])
    """

    rotation_rows = 3

    def __init__(
        self,
        measured: ArrayLike,
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
        jacobian: Literal["exact", "first_order"] = "exact",
    ) -> None:
        if jacobian not in ("exact", "first_order"):
            raise InputError(
                'jacobian "exact" or "first_order"', repr(jacobian), 'leave it at "exact" unless you measured a gain'
            )
        self.measured = SE3.check("measured", measured)
        self.jacobian = jacobian
        count = len(self.measured)
        super().__init__(
            dim=6,
            count=count,
            manifolds=(SE3, SE3),
            roles=("T_world_i", "T_world_j"),
            whitening=Whitening.of(6, count, sigma=sigma, covariance=covariance, information=information),
        )

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        is_exact = self.jacobian == "exact"
        linearize_rows(begin, end, x[0], x[1], index[0], index[1], self.measured, is_exact, r, jacobians[0], jacobians[1], valid)

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        evaluate_rows(begin, end, x[0], x[1], index[0], index[1], self.measured, r, valid)
