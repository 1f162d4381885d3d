"""The chordal error of a relative pose: differences of matrices instead of a logarithm (Rosen et al., SE-Sync, IJRR 2019).

Residual of a measured pose Z_ij = (R_ij, t_ij) of j in i, the columns of the matrix one after the other:

    e = [vec(R_j − R_i R_ij), t_j − t_i − R_i t_ij]

weighed by √κ and √τ, so that Σ‖W e‖² is the objective of SE-Sync (its problem 1): no ½, no coupling of rotation and translation.

Jacobians on the right side, T ← T Exp([w, v]), with e_k the axes and R_ij e_k the columns of R_ij:

    ∂/∂[w, v]_j: column k of R_j: −R_j [e_k]×, 0;         translation: 0, R_j
    ∂/∂[w, v]_i: column k:         R_i [R_ij e_k]×, 0;     translation: R_i [t_ij]×, −R_i

Smooth everywhere, also at half a turn. Source: SE-Sync, eq. (10), for the objective and the weights.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.manifolds.quaternion import rotation_entries
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.whitening import Whitening

_NO_JACOBIANS_3D = (np.zeros((0, 12, 6)), np.zeros((0, 12, 6)))
_NO_JACOBIANS_2D = (np.zeros((0, 6, 3)), np.zeros((0, 6, 3)))


def chordal_weights(information: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """κ and τ (N,) that SE-Sync gives to information matrices, from the blocks of rotation and of translation alone.

    κ = 3 / (2 tr Ω_R⁻¹) in 3D and Ω_θ in 2D, τ = d / tr Ω_t⁻¹.

    Args:
        information: (N, 6, 6) of [w, v], or (N, 3, 3) of [w, vx, vy].

    Raises:
        InputError: another shape, or a block that is singular.

    Example:
        >>> kappa, tau = bp.residuals.chordal_weights(np.diag([400.0, 400.0, 400.0, 100.0, 100.0, 100.0])[None])
        >>> kappa.round(3), tau.round(3)
        (array([200.]), array([100.]))
    """
    Omega = as_floats(information, "information")
    if Omega.ndim != 3 or Omega.shape[1:] not in ((6, 6), (3, 3)):
        raise InputError("information of shape (N, 6, 6) or (N, 3, 3)", f"{Omega.shape}", "give one matrix for each pose")
    spatial = Omega.shape[1] == 6
    split, d = (3, 3) if spatial else (1, 2)
    try:
        spread_R = np.trace(np.linalg.inv(Omega[:, :split, :split]), axis1=1, axis2=2)
        spread_t = np.trace(np.linalg.inv(Omega[:, split:, split:]), axis1=1, axis2=2)
    except np.linalg.LinAlgError:
        spread_R = spread_t = np.zeros(len(Omega))
    if not (np.isfinite(spread_R) & (spread_R > 0.0) & np.isfinite(spread_t) & (spread_t > 0.0)).all():
        raise InputError(
            "information on all axes of rotation and translation",
            "a matrix with a singular block",
            "remove that edge, or use the logarithmic error",
        )
    return (1.5 if spatial else 1.0) / spread_R, d / spread_t


@kernel
def _chordal_3d(
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
    with_jacobians: bool,
) -> None:
    for n in range(np.uint64(begin), np.uint64(end)):
        a, b, z = T_i[index_i[n]], T_j[index_j[n]], Z[n]
        A = rotation_entries(a[0], a[1], a[2], a[3])
        B = rotation_entries(b[0], b[1], b[2], b[3])
        M = rotation_entries(z[0], z[1], z[2], z[3])
        valid[n] = True
        for row in range(3):
            A0, A1, A2 = A[3 * row], A[3 * row + 1], A[3 * row + 2]
            B0, B1, B2 = B[3 * row], B[3 * row + 1], B[3 * row + 2]
            for k in range(3):
                r[n, 3 * k + row] = B[3 * row + k] - (A0 * M[k] + A1 * M[3 + k] + A2 * M[6 + k])
            r[n, 9 + row] = b[4 + row] - a[4 + row] - (A0 * z[4] + A1 * z[5] + A2 * z[6])
            if not with_jacobians:
                continue
            # A row (A0, A1, A2) of R_i times [u]x is (A0, A1, A2) × u.
            for k in range(4):
                u0, u1, u2 = (M[k], M[3 + k], M[6 + k]) if k < 3 else (z[4], z[5], z[6])
                J_i[n, 3 * k + row, 0] = A1 * u2 - A2 * u1
                J_i[n, 3 * k + row, 1] = A2 * u0 - A0 * u2
                J_i[n, 3 * k + row, 2] = A0 * u1 - A1 * u0
                J_i[n, 3 * k + row, 3:] = 0.0
                J_j[n, 3 * k + row] = 0.0
            J_i[n, 9 + row, 3], J_i[n, 9 + row, 4], J_i[n, 9 + row, 5] = -A0, -A1, -A2
            J_j[n, 9 + row, 3], J_j[n, 9 + row, 4], J_j[n, 9 + row, 5] = B0, B1, B2
            # −(B0, B1, B2) × e_k
            J_j[n, row, 1], J_j[n, row, 2] = -B2, B1
            J_j[n, 3 + row, 0], J_j[n, 3 + row, 2] = B2, -B0
            J_j[n, 6 + row, 0], J_j[n, 6 + row, 1] = -B1, B0


@kernel
def _chordal_2d(
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
    with_jacobians: bool,
) -> None:
    for n in range(np.uint64(begin), np.uint64(end)):
        a, b, z = T_i[index_i[n]], T_j[index_j[n]], Z[n]
        ca, sa = math.cos(a[0]), math.sin(a[0])
        cb, sb = math.cos(b[0]), math.sin(b[0])
        cm, sm = math.cos(a[0] + z[0]), math.sin(a[0] + z[0])
        tx, ty = ca * z[1] - sa * z[2], sa * z[1] + ca * z[2]
        valid[n] = True
        r[n, 0], r[n, 1], r[n, 2], r[n, 3] = cb - cm, sb - sm, sm - sb, cb - cm
        r[n, 4], r[n, 5] = b[1] - a[1] - tx, b[2] - a[2] - ty
        if with_jacobians:
            J_i[n], J_j[n] = 0.0, 0.0
            J_i[n, 0, 0], J_i[n, 1, 0], J_i[n, 2, 0], J_i[n, 3, 0] = sm, -cm, cm, sm
            J_j[n, 0, 0], J_j[n, 1, 0], J_j[n, 2, 0], J_j[n, 3, 0] = -sb, cb, -cb, -sb
            J_i[n, 4, 0], J_i[n, 5, 0] = ty, -tx
            J_i[n, 4, 1], J_i[n, 4, 2], J_i[n, 5, 1], J_i[n, 5, 2] = -ca, sa, -sa, -ca
            J_j[n, 4, 1], J_j[n, 4, 2], J_j[n, 5, 1], J_j[n, 5, 2] = cb, -sb, sb, cb


class _Chordal(Residual):
    """What both dimensions share: weights, and one kernel."""

    measured: NDArray[np.float64]

    def _prepare(self, kappa: ArrayLike, tau: ArrayLike) -> Whitening:
        count, d = len(self.measured), 3 if self.measured.shape[1] == 7 else 2
        sigma = np.ones((count, d * d + d))
        for name, weight, columns in (("kappa", kappa, slice(0, d * d)), ("tau", tau, slice(d * d, None))):
            array = as_floats(weight, "weight")
            if array.shape not in ((), (count,)) or not (np.isfinite(array) & (array > 0.0)).all():
                raise InputError(
                    f"{name} as positive finite numbers, one for all or ({count},)",
                    f"shape {array.shape}, smallest {array.min(initial=np.inf):g}",
                    "take them from `chordal_weights`",
                )
            sigma[:, columns] = 1.0 / np.sqrt(np.broadcast_to(array, (count,)))[:, None]
        return Whitening.of(sigma.shape[1], count, sigma=sigma)

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """See `Residual.linearize_into`."""
        run = _chordal_3d if self.dim == 12 else _chordal_2d
        run(begin, end, x[0], x[1], index[0], index[1], self.measured, r, jacobians[0], jacobians[1], valid, True)

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """See `Residual.evaluate_into`."""
        run, none = (_chordal_3d, _NO_JACOBIANS_3D) if self.dim == 12 else (_chordal_2d, _NO_JACOBIANS_2D)
        run(begin, end, x[0], x[1], index[0], index[1], self.measured, r, none[0], none[1], valid, False)


class ChordalPose(_Chordal):
    """e = [vec(R_j − R_i R_ij), t_j − t_i − R_i t_ij] (12 rows) of measured poses Z_ij of j in i, as derived above.

    Args:
        measured: Z_ij (N, 7) [qw, qx, qy, qz, x, y, z], mapping coordinates in j to coordinates in i.
        kappa, tau: weights of rotation and translation [1/rad², 1/m²], a number or (N,); see `chordal_weights`.

    Raises:
        InputError: wrong shapes, quaternions not of unit length, weights that are not positive.

    Example:
        >>> T = bp.SE3.boxplus(bp.SE3.identity(), [0, 0, 0.1, 1.0, 0, 0])
        >>> edge = bp.residuals.ChordalPose([T], kappa=100.0, tau=10.0)
        >>> edge.evaluate(bp.SE3.identity(), T).shape, bool(np.allclose(edge.evaluate(bp.SE3.identity(), T), 0.0))
        ((1, 12), True)
    """

    def __init__(self, measured: ArrayLike, *, kappa: ArrayLike = 1.0, tau: ArrayLike = 1.0) -> None:
        self.measured = SE3.check("measured", measured)
        super().__init__(
            dim=12,
            count=len(self.measured),
            manifolds=(SE3, SE3),
            roles=("T_world_i", "T_world_j"),
            whitening=self._prepare(kappa, tau),
        )


class ChordalPose2D(_Chordal):
    """The same in the plane, with 6 rows.

    Args:
        measured: Z_ij (N, 3) [theta, x, y].
        kappa, tau: as for `ChordalPose`.

    Raises:
        InputError: wrong shapes, not finite, weights that are not positive.

    Example:
        >>> edge = bp.residuals.ChordalPose2D([[0.0, 1.0, 0.0]], kappa=100.0, tau=10.0)
        >>> edge.evaluate([0.0, 0.0, 0.0], [0.0, 1.0, 0.0])
        array([[0., 0., 0., 0., 0., 0.]])
    """

    def __init__(self, measured: ArrayLike, *, kappa: ArrayLike = 1.0, tau: ArrayLike = 1.0) -> None:
        self.measured = SE2.check("measured", measured)
        super().__init__(
            dim=6,
            count=len(self.measured),
            manifolds=(SE2, SE2),
            roles=("T_world_i", "T_world_j"),
            whitening=self._prepare(kappa, tau),
        )
