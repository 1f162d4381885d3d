"""Whether a minimum of the chordal objective is the global one: the dual of SE-Sync (Rosen et al., IJRR 2019).

With all rotations and translations side by side in X (d × (d + 1) n), the chordal objective is f = tr(X M Xᵀ), M positive
semi-definite. For any symmetric Λ_i, one for each rotation, R_iᵀ R_i = I gives f(X) − tr Λ = tr(X S Xᵀ) with
S = M − diag(Λ_i, 0): where S is positive semi-definite, no poses cost less than tr Λ. At a minimum Λ_i = sym(R_iᵀ (X M)_{R_i})
makes tr Λ = f, so that S alone decides (their theorem 7, with the translations not eliminated). Here S + η I on the rotations is
factorised for growing η: the first that is positive definite proves f* ≥ tr Λ − η d n, rigorous but for rounding, whatever the
poses.

What is certified is that objective alone, with isotropic weights κ and τ: of the logarithmic error nothing is said.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.manifolds import quaternion
from boxplus.residuals.chordal_pose import chordal_weights
from boxplus.sparse.block_matrix import BlockPattern
from boxplus.sparse.cholesky import NotPositiveDefinite, SparseCholesky
from boxplus.systems.pose_graph.start import components, held_poses

_CERTIFIED = 1e-6  # largest gap, as a share of the objective
_ROUNDING = 1e-12  # or of the trace of M, where the objective vanishes
_FIRST, _LAST = -14, 1  # decades of η, in units of the largest diagonal entry of M


@dataclass(frozen=True, slots=True)
class Certificate:
    """A lower bound of the chordal objective over all poses.

    Attributes:
        objective: at the poses, Σ κ ‖R_j − R_i R_ij‖² + τ ‖t_j − t_i − R_i t_ij‖².
        lower_bound: no poses cost less.
        least_eigenvalue: the smallest eigenvalue of S, restricted to the rotations, is no less than this; 0 at a global minimum.
        is_certified: the gap is a millionth of the objective at most, or rounding.
    """

    objective: float
    lower_bound: float
    least_eigenvalue: float
    is_certified: bool

    @property
    def gap(self) -> float:
        """By how much the objective may be above the global minimum, at most."""
        return self.objective - self.lower_bound

    @property
    def sentence(self) -> str:
        """What was found."""
        told = f"chordal objective {self.objective:.9g}, no poses below {self.lower_bound:.9g} (gap {self.gap:.2g})"
        if self.is_certified:
            return f"certified: the global minimum of SE-Sync's objective; {told}"
        return (
            f"not certified: a better minimum of SE-Sync's objective may exist, or the measurements are too noisy to tell; {told}"
        )


def certify(graph: PoseGraph) -> Certificate:
    """Judge the poses of a graph, a minimum of the chordal objective for the certificate to be of use.

    Raises:
        InputError: no poses; more than one held pose in a piece of the graph, which the dual does not know of; information
            without an isotropic weight.
    """
    if graph.poses is None:
        raise InputError("a graph with poses", f"none ({graph.source})", "optimise it first")
    label = components(graph)
    if len(held_poses(graph)) > len(np.unique(label)):
        raise InputError(
            "one held pose in every piece of the graph", f"{len(graph.fixed)} fixed poses", "certify without the further ones"
        )
    kappa, tau = chordal_weights(graph.information)
    R, t = _matrices(graph.poses)
    Z, z = _matrices(graph.measurements)
    d, n = R.shape[1], len(R)
    i, j = graph.edges.T
    # Gradient of the objective in the rotations, halved: (X M)_{R_i}, d × d each.
    E, e = R[j] - R[i] @ Z, t[j] - t[i] - np.einsum("nab,nb->na", R[i], z)
    XM = np.zeros((n, d, d))
    np.add.at(XM, j, kappa[:, None, None] * E)
    np.add.at(XM, i, -kappa[:, None, None] * E @ np.swapaxes(Z, 1, 2) - tau[:, None, None] * e[:, :, None] * z[:, None, :])
    Lambda = np.swapaxes(R, 1, 2) @ XM
    Lambda = 0.5 * (Lambda + np.swapaxes(Lambda, 1, 2))
    objective = float((kappa * (E * E).sum(axis=(1, 2)) + tau * (e * e).sum(axis=1)).sum())
    dual = float(np.einsum("naa->", Lambda))
    pattern, values, scale = _dual_matrix(i, j, Z, z, kappa, tau, Lambda, np.unique(label, return_index=True)[1])
    cholesky = SparseCholesky(pattern)
    shift = np.zeros(n * (d + 1)).reshape(n, d + 1)
    shift[:, :d] = scale
    for decade in range(_FIRST, _LAST + 1):
        for mantissa in (1.0, 3.0):
            eta = mantissa * 10.0**decade
            try:
                cholesky.factorize(values, diagonal=(eta * shift).reshape(-1))
            except NotPositiveDefinite:
                continue
            bound = dual - eta * scale * d * n
            return Certificate(
                objective, bound, -eta * scale, objective - bound <= max(_CERTIFIED * objective, _ROUNDING * scale * d * n)
            )
    return Certificate(objective, 0.0, -np.inf, False)  # the objective is a sum of squares


def _matrices(poses: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotations (n, d, d) and translations (n, d)."""
    if poses.shape[1] == 7:
        return quaternion.to_matrix(poses[:, :4]), poses[:, 4:]
    c, s = np.cos(poses[:, 0]), np.sin(poses[:, 0])
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2), poses[:, 1:]


def _dual_matrix(
    i: NDArray[np.int64],
    j: NDArray[np.int64],
    Z: NDArray[np.float64],
    z: NDArray[np.float64],
    kappa: NDArray[np.float64],
    tau: NDArray[np.float64],
    Lambda: NDArray[np.float64],
    pinned: NDArray[np.int64],
) -> tuple[BlockPattern, NDArray[np.float64], float]:
    """S in blocks of (rotation, translation) of a pose, with the translation of one pose a piece pinned, and the scale of M.

    A common translation costs nothing and mixes with nothing: pinning it changes no sign.
    """
    n, d = len(Lambda), Z.shape[1]
    pattern, pairs = BlockPattern.from_pairs(np.full(n, d + 1), j, i)
    blocks = np.zeros((len(pattern.row), d + 1, d + 1))
    # An edge costs κ ‖X a‖² + τ ‖X b‖² with a = (−R_ij at i, I at j) and b = −(t_ij, 1) at i, (0, 1) at j.
    coupling = np.zeros((len(i), d + 1, d + 1))
    coupling[:, :d, :d] = -kappa[:, None, None] * np.swapaxes(Z, 1, 2)
    coupling[:, d, :d], coupling[:, d, d] = -tau[:, None] * z, -tau
    np.add.at(blocks, pairs.block, np.where(pairs.transposed[:, None, None], np.swapaxes(coupling, 1, 2), coupling))
    own = np.zeros((n, d + 1, d + 1))
    lever = np.concatenate([z, np.ones((len(z), 1))], axis=1)
    np.add.at(own, i, tau[:, None, None] * lever[:, :, None] * lever[:, None, :])
    degree = np.bincount(i, kappa, n) + np.bincount(j, kappa, n)
    own[:, :d, :d] += degree[:, None, None] * np.eye(d)
    own[:, d, d] += np.bincount(j, tau, n)
    scale = float(np.einsum("naa->na", own).max())
    own[:, :d, :d] -= Lambda
    own[pinned, d, d] += scale
    blocks[pattern.col_start[:-1]] += own
    return pattern, blocks.reshape(-1), scale
