"""A plane seen in a scan by a cluster of points, whatever their number (docs/residuals/plane_cluster.md).

All that a sum of squared distances from a plane needs of points ℓ (LiDAR frame) is the 4 × 4 matrix C = Σ [ℓ; 1][ℓ; 1]ᵀ = M Mᵀ,
which is computed once. With the pose (R, p) of the IMU in the world, that (R_L, p_L) of the LiDAR in the IMU frame, and the plane
nᵀ(x − c) + d = 0, c a point that is given, the residual is

    e = Mᵀ [ y; s ],    a = Rᵀ n,    y = R_Lᵀ a,    s = nᵀ(R p_L + p − c) + d,    ‖e‖² = Σ (yᵀ ℓ + s)²

Rotations move on the right, positions are added, n moves on S² by its basis B:

    ∂[y; s]/∂[θ, p] = [R_Lᵀ [a]×  0; (p_L × a)ᵀ  nᵀ],    ∂[y; s]/∂[θ_L, p_L] = [[y]×  0; 0  aᵀ],
    ∂[y; s]/∂[δ, d] = [R_Lᵀ Rᵀ B  0; (R p_L + p − c)ᵀ B  1]

Source: Liu, Liu and Zhang, BALM2, TRO 2023 (point clusters); Ferrer, Eigen-Factors, IROS 2019; Zhou et al., π-LSAM, ICRA 2021.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.manifolds.body_pose import BodyPose
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import rotation_entries
from boxplus.manifolds.sphere import S2, basis_scalars
from boxplus.residuals.matrix3 import apply, multiply, transposed
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.whitening import Whitening

Plane: Manifold = Product(S2, Euclidean(1))
"""A plane (4,): unit normal n and offset d [m] of nᵀ(x − c) + d = 0, c a point beside it."""

_ROOT_TOLERANCE = 1e-12  # of the largest eigenvalue: smaller ones are rounding
_NO_JACOBIANS = np.zeros((0, 4, 6)), np.zeros((0, 4, 6)), np.zeros((0, 4, 3))


@kernel
def _plane_cluster(
    begin: int,
    end: int,
    poses: NDArray[np.float64],
    mountings: NDArray[np.float64],
    planes: NDArray[np.float64],
    pose_of: NDArray[np.uint32],
    mounting_of: NDArray[np.uint32],
    plane_of: NDArray[np.uint32],
    roots: NDArray[np.float64],
    centres: NDArray[np.float64],
    r: NDArray[np.float64],
    J_pose: NDArray[np.float64],
    J_mounting: NDArray[np.float64],
    J_plane: NDArray[np.float64],
    valid: NDArray[np.bool_],
    with_jacobians: bool,
) -> None:
    G = np.zeros((4, 15))  # ∂[y; s] by the three variables
    for k in range(np.uint64(begin), np.uint64(end)):
        T, L, plane = poses[pose_of[k]], mountings[mounting_of[k]], planes[plane_of[k]]
        R, R_L = rotation_entries(T[0], T[1], T[2], T[3]), rotation_entries(L[0], L[1], L[2], L[3])
        nx, ny, nz = plane[0], plane[1], plane[2]
        ax, ay, az = apply(transposed(R), nx, ny, nz)
        yx, yy, yz = apply(transposed(R_L), ax, ay, az)
        # Where the LiDAR is from c.
        qx, qy, qz = apply(R, L[4], L[5], L[6])
        qx, qy, qz = qx + (T[4] - centres[k, 0]), qy + (T[5] - centres[k, 1]), qz + (T[6] - centres[k, 2])
        s = nx * qx + ny * qy + nz * qz + plane[3]
        M = roots[k]
        for i in range(4):
            r[k, i] = M[0, i] * yx + M[1, i] * yy + M[2, i] * yz + M[3, i] * s
        valid[k] = True
        if not with_jacobians:
            continue
        # θ: R_Lᵀ [a]×, and (p_L × a)ᵀ.
        H = multiply(transposed(R_L), (0.0, -az, ay, az, 0.0, -ax, -ay, ax, 0.0))
        for i in range(3):
            for j in range(3):
                G[i, j] = H[3 * i + j]
        G[3, 0], G[3, 1], G[3, 2] = L[5] * az - L[6] * ay, L[6] * ax - L[4] * az, L[4] * ay - L[5] * ax
        G[3, 3], G[3, 4], G[3, 5] = nx, ny, nz
        # θ_L: [y]×; p_L: aᵀ.
        G[0, 7], G[0, 8], G[1, 6], G[1, 8], G[2, 6], G[2, 7] = -yz, yy, yz, -yx, -yy, yx
        G[3, 9], G[3, 10], G[3, 11] = ax, ay, az
        # The plane.
        B = basis_scalars(nx, ny, nz)
        for j in range(2):
            bx, by, bz = B[3 * j], B[3 * j + 1], B[3 * j + 2]
            cx, cy, cz = apply(transposed(R), bx, by, bz)
            G[0, 12 + j], G[1, 12 + j], G[2, 12 + j] = apply(transposed(R_L), cx, cy, cz)
            G[3, 12 + j] = bx * qx + by * qy + bz * qz
        G[3, 14] = 1.0
        for i in range(4):
            for j in range(6):
                J_pose[k, i, j] = M[0, i] * G[0, j] + M[1, i] * G[1, j] + M[2, i] * G[2, j] + M[3, i] * G[3, j]
                J_mounting[k, i, j] = (
                    M[0, i] * G[0, 6 + j] + M[1, i] * G[1, 6 + j] + M[2, i] * G[2, 6 + j] + M[3, i] * G[3, 6 + j]
                )
            for j in range(3):
                J_plane[k, i, j] = (
                    M[0, i] * G[0, 12 + j] + M[1, i] * G[1, 12 + j] + M[2, i] * G[2, 12 + j] + M[3, i] * G[3, 12 + j]
                )


class PlaneCluster(Residual):
    """Distances of clusters of points from planes, as derived in the head of this file.

    Rows: four numbers whose sum of squares is that of the distances [m]. Variables: `T_world_imu` and `T_imu_lidar` (7,), wxyz
    and xyz, on `BodyPose`; `plane_world` (4,) on `Plane`: n and d. The sign of (n, d) is irrelevant.

    Args:
        clusters: (N, 4, 4) Σ [ℓ; 1][ℓ; 1]ᵀ over the points of each cluster, in the LiDAR frame [m], each summand multiplied by
            its weight where points do not count alike.
        centres_world: (N, 3) or (3,) the point c of each plane, near it [m]: the nearer, the better n and d are told apart.
        sigma, covariance, information: of a distance [m], as in `Whitening.of`.

    Raises:
        InputError: arrays of another shape or not finite, a cluster that is not positive semi-definite, noise that
            `Whitening.of` refuses.

    Example:
        >>> points = np.column_stack([np.random.default_rng(0).uniform(-1.0, 1.0, (50, 2)), np.full(50, 2.0)])  # on z = 2
        >>> ones = np.column_stack([points, np.ones(50)])
        >>> cluster = bp.residuals.PlaneCluster([ones.T @ ones])
        >>> still = bp.BodyPose.identity()
        >>> bool(np.abs(cluster.evaluate(still, still, [0.0, 0.0, 1.0, -2.0])).max() < 1e-9)
        True
    """

    def __init__(
        self,
        clusters: ArrayLike,
        centres_world: ArrayLike = (0.0, 0.0, 0.0),
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
    ) -> None:
        C = as_floats(clusters, "clusters")
        if C.ndim != 3 or C.shape[1:] != (4, 4) or not np.isfinite(C).all():
            raise InputError("clusters (N, 4, 4), finite", f"shape {C.shape}", "sum [x, y, z, 1] with itself over the points")
        count = len(C)
        given = as_floats(centres_world, "centres_world")
        if given.shape not in ((3,), (count, 3)) or not np.isfinite(given).all():
            raise InputError(f"centres_world ({count}, 3) or (3,), finite", f"shape {given.shape}", "give one for each plane")
        self.centres_world = np.ascontiguousarray(np.broadcast_to(given, (count, 3)))
        self._roots = _square_roots(C)
        super().__init__(
            dim=4,
            count=count,
            manifolds=(BodyPose, BodyPose, Plane),
            roles=("T_world_imu", "T_imu_lidar", "plane_world"),
            whitening=Whitening.of(4, count, sigma=sigma, covariance=covariance, information=information),
        )

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """See `Residual.linearize_into`."""
        _plane_cluster(begin, end, *x, *index, self._roots, self.centres_world, r, *jacobians, valid, True)

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """See `Residual.evaluate_into`."""
        _plane_cluster(begin, end, *x, *index, self._roots, self.centres_world, r, *_NO_JACOBIANS, valid, False)


def _square_roots(clusters: NDArray[np.float64]) -> NDArray[np.float64]:
    """M (N, 4, 4) with C = M Mᵀ; by eigenvectors, as points on one plane or line make C singular."""
    values, vectors = np.linalg.eigh(0.5 * (clusters + np.swapaxes(clusters, 1, 2)))
    floor = _ROOT_TOLERANCE * np.abs(values).max(axis=1, initial=0.0)
    negative = values[:, 0] < -1e3 * floor
    if negative.any():
        row = int(np.argmax(negative))
        raise InputError(
            "clusters that are positive semi-definite", f"an eigenvalue of {values[row, 0]:.3g} in row {row}", "sum [x, y, z, 1]"
        )
    return np.ascontiguousarray(vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])
