"""The relative pose of two bodies of two sessions, each session with an anchor (docs/residuals/anchored_pose.md).

A session's poses T_session_body stand in a frame of its own, which an anchor T_world_session places in the world. What was
measured between body i of one session and body j of another is

    e = Log(Z_ij⁻¹ X_i⁻¹ X_j),        X = T_world_session T_session_body,

with the Jacobians of `RelativePose` for X, carried on: a body's step moves X on its right, and an anchor's is
A Exp(ξ) T = A T Exp(Ad(T⁻¹) ξ).

Source: Kim, Kaess, Fletcher, Leonard, Bachrach, Roy and Teller, Multiple Relative Pose Graphs for Robust Cooperative Mapping,
ICRA 2010 ("encounters").
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.manifolds import se3
from boxplus.manifolds.se3 import SE3
from boxplus.residuals.relative_pose import evaluate_rows, linearize_rows
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.whitening import Whitening


class AnchoredRelativePose(Residual):
    """e = Log(Z_ij⁻¹ (A_i T_i)⁻¹ (A_j T_j)), [w, v] [rad, m], on the right side of all four poses.

    Args:
        measured: Z_ij (N, 7) [qw, qx, qy, qz, x, y, z], mapping coordinates in j to coordinates in i.
        sigma, covariance, information: noise of [w, v], as for `Whitening.of`.

    Raises:
        InputError: wrong shapes, quaternions not of unit length, noise that is not positive.

    Example:
        >>> identity = bp.SE3.identity()
        >>> edge = bp.residuals.AnchoredRelativePose([[1.0, 0, 0, 0, 1.0, 0, 0]], sigma=0.1)
        >>> there = bp.SE3.boxplus(identity, [0, 0, 0, 1.0, 0, 0])
        >>> edge.evaluate(identity, identity, there, identity)  # anchor and pose of each session
        array([[0., 0., 0., 0., 0., 0.]])
    """

    rotation_rows = 3

    def __init__(
        self,
        measured: ArrayLike,
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
    ) -> None:
        self.measured = SE3.check("measured", measured)
        count = len(self.measured)
        super().__init__(
            dim=6,
            count=count,
            manifolds=(SE3, SE3, SE3, SE3),
            roles=("T_world_session_i", "T_session_i", "T_world_session_j", "T_session_j"),
            whitening=Whitening.of(6, count, sigma=sigma, covariance=covariance, information=information),
            fixes_gauge=False,
        )

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """See `Residual.linearize_into`."""
        X_i, X_j, rows = _placed(begin, end, x, index)
        Z, n = self.measured[begin:end], end - begin
        J_i, J_j = np.zeros((n, 6, 6)), np.zeros((n, 6, 6))
        linearize_rows(0, n, X_i, X_j, rows, rows, Z, True, r[begin:end], J_i, J_j, valid[begin:end])
        for side, J in ((0, J_i), (2, J_j)):
            T = x[side + 1][index[side + 1][begin:end]]
            jacobians[side][begin:end] = J @ se3.adjoint(se3.inverse(T))
            jacobians[side + 1][begin:end] = J

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """See `Residual.evaluate_into`."""
        X_i, X_j, rows = _placed(begin, end, x, index)
        evaluate_rows(0, end - begin, X_i, X_j, rows, rows, self.measured[begin:end], r[begin:end], valid[begin:end])


def _placed(begin: int, end: int, x: Arrays, index: Rows) -> tuple[Array, Array, NDArray[np.uint32]]:
    """Bodies i and j of rows [begin, end) in the world."""
    A_i, T_i, A_j, T_j = (np.ascontiguousarray(x[s][index[s][begin:end]]) for s in range(4))
    return se3.compose(A_i, T_i), se3.compose(A_j, T_j), np.arange(end - begin, dtype=np.uint32)
