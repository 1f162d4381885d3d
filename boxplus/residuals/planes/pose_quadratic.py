"""Many residuals of one pose as one: those that are linear in the entries of its rotation and its position.

Distances of points from planes and from points that are held are linear in m = [vec R; p − p₀; 1] (13, R row by row), so that the
sum of their squares is mᵀ Q m whatever their number. With Q = Sᵀ S the residual is

    e = S m,    ∂e/∂θ_k = S [vec(R [e_k]×); 0; 0],    ∂e/∂p = S [0; I; 0],

exact at every pose, not only near the one where Q was summed. `add_plane_forms` sums it for clusters on planes.

Source: Olsson, Kahl and Oskarsson, Branch-and-bound methods for Euclidean registration problems, TPAMI 2009; Briales and
Gonzalez-Jimenez, Convex global 3D registration with Lagrangian duality, CVPR 2017.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.manifolds import quaternion, so3
from boxplus.manifolds.body_pose import BodyPose
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.whitening import Whitening

_BASIS = so3.hat(np.eye(3))  # (3, 3, 3) [e_k]×


class PoseQuadratic(Residual):
    """mᵀ Q m of a pose, as derived in the head of this file.

    Rows: 13 numbers whose sum of squares it is, in units of their noise, as Q is given in. Variable: `T_world_body` (7,), wxyz
    and xyz, on `BodyPose`.

    Args:
        forms: (N, 13, 13) Q, symmetric and positive semi-definite.
        origins_world: (N, 3) p₀, near the positions: the nearer, the less is lost to rounding [m].

    Raises:
        InputError: arrays of another shape or not finite.

    Example:
        >>> form = np.zeros((13, 13))
        >>> origin = np.diag([0.0, 0.0, 0.0, 1.0])  # a point there, 0.1 m above the plane
        >>> bp.residuals.add_plane_forms([origin], [[0.0, 0.0, 1.0]], [0.1], form)
        >>> held = bp.residuals.PoseQuadratic(form[None], [[0.0, 0.0, 0.0]])
        >>> float(np.linalg.norm(held.evaluate(bp.BodyPose.identity())).round(6))
        0.1
    """

    def __init__(self, forms: ArrayLike, origins_world: ArrayLike) -> None:
        Q, origins = as_floats(forms, "forms"), as_floats(origins_world, "origins_world")
        if Q.ndim != 3 or Q.shape[1:] != (13, 13) or not np.isfinite(Q).all():
            raise InputError("forms (N, 13, 13), finite", f"shape {Q.shape}", "sum them with add_plane_forms")
        if origins.shape != (len(Q), 3) or not np.isfinite(origins).all():
            raise InputError(f"origins_world ({len(Q)}, 3), finite", f"shape {origins.shape}", "give one for each form")
        values, vectors = np.linalg.eigh(0.5 * (Q + np.swapaxes(Q, 1, 2)))
        self._roots = np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)
        self.origins_world = np.array(origins)
        super().__init__(
            dim=13,
            count=len(Q),
            manifolds=(BodyPose,),
            roles=("T_world_body",),
            whitening=Whitening.of(13, len(Q)),
        )

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """See `Residual.linearize_into`."""
        R = self._evaluate(begin, end, x, index, r, valid)
        S = self._roots[begin:end]
        turned = np.einsum("nab,kbc->nack", R, _BASIS).reshape(end - begin, 9, 3)
        jacobians[0][begin:end, :, :3] = S[:, :, :9] @ turned
        jacobians[0][begin:end, :, 3:] = S[:, :, 9:12]

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """See `Residual.evaluate_into`."""
        self._evaluate(begin, end, x, index, r, valid)

    def _evaluate(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> Array:
        T = x[0][index[0][begin:end]]
        R = quaternion.to_matrix(T[:, :4])
        m = np.concatenate(
            [R.reshape(-1, 9), T[:, 4:] - self.origins_world[begin:end], np.ones((end - begin, 1))], axis=1
        )  # fmt: skip
        r[begin:end] = np.einsum("nab,nb->na", self._roots[begin:end], m)
        valid[begin:end] = True
        return R


def add_plane_forms(clusters: ArrayLike, planes: ArrayLike, offsets: ArrayLike, form: NDArray[np.float64]) -> None:
    """Add to Q (13, 13) of one pose the squared distances of clusters of points from planes that are held.

    Args:
        clusters: (k, 4, 4) Σ [x; 1][x; 1]ᵀ in the body's frame, divided by the variance of a distance [m²].
        planes: (k, 3) unit normals n in the world; offsets: (k,) nᵀ(p₀ − c) + d of each plane nᵀ(x − c) + d = 0 [m].
        form: Q, which is added to.

    Example:
        >>> form = np.zeros((13, 13))
        >>> bp.residuals.add_plane_forms([np.diag([0.0, 0.0, 0.0, 1.0])], [[0.0, 0.0, 1.0]], [0.1], form)
        >>> float(form[12, 12].round(6))  # 0.1 squared
        0.01
    """
    _add_plane_forms(as_floats(clusters, "clusters"), as_floats(planes, "planes"), as_floats(offsets, "offsets"), form)


@kernel
def _add_plane_forms(
    clusters: NDArray[np.float64], normals: NDArray[np.float64], offsets: NDArray[np.float64], form: NDArray[np.float64]
) -> None:
    """With [y; s] = A m, y_j = Σ_i n_i R_ij and s = nᵀ(p − p₀) + offset:  Q += Aᵀ C A."""
    last = np.empty(4)  # s by p − p₀ and by 1
    for k in range(clusters.shape[0]):
        C, n = clusters[k], normals[k]
        last[0], last[1], last[2], last[3] = n[0], n[1], n[2], offsets[k]
        for i in range(3):
            for j in range(3):
                row = form[3 * i + j]
                for a in range(3):
                    both = n[i] * n[a]
                    for b in range(3):
                        row[3 * a + b] += both * C[j, b]
                for a in range(4):
                    value = n[i] * C[j, 3] * last[a]
                    row[9 + a] += value
                    form[9 + a, 3 * i + j] += value
        for a in range(4):
            for b in range(4):
                form[9 + a, 9 + b] += C[3, 3] * last[a] * last[b]
