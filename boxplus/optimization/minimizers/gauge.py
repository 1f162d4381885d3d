"""Motions of the whole world that no residual sees, taken away from how far variables moved.

Where nothing holds the world, variables are known only up to such a motion, and a step moves them by any. What the poses have in
common of it is nobody's way: with it taken away from the step and from the covariance alike, what is left is how the poses lie to
each other (an S-transform, Baarda 1973), and how the rest lies to them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.linear_systems.least_squares import LeastSquares
from boxplus.optimization.observability.world_motions import DOF, POSE_KINDS, kinds_of, motions_of

_UNSEEN = 1e-10  # share of a motion's squares that residuals see, to rounding
_DISTINCT = 1e-12  # share of the squares of all motions, from where one is not among the others
_READINGS = ("point", "line", "direction")  # of what is no pose


@dataclass(frozen=True, slots=True)
class Gauge:
    """Motions G (dof, m) that no residual sees, and how much (m, dof) of each the poses have in common."""

    motions: NDArray[np.float64]
    share: NDArray[np.float64]

    def remove(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """S x (dof,): without what the poses have in common."""
        return np.asarray(x - np.einsum("km,m->k", self.motions, np.einsum("mk,k->m", self.share, x)))

    def transposed(self, e: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sᵀ e (dof,)."""
        return np.asarray(e - np.einsum("mk,m->k", self.share, np.einsum("km,k->m", self.motions, e)))

    def kept(self, places: slice, dof: int) -> NDArray[np.float64]:
        """(n, dof, dof) blocks of S on its diagonal, of the variables of `dof` degrees of freedom at these places."""
        n, m = (places.stop - places.start) // dof, len(self.share)
        motions, share = self.motions[places].reshape(n, dof, m), self.share[:, places].reshape(m, n, dof)
        return np.asarray(np.eye(dof) - np.einsum("nim,mnj->nij", motions, share))


def find_gauge(problem: LeastSquares, curvatures: list[NDArray[np.float64]]) -> Gauge:
    """Of the problem as it is linearised; without motions where something holds the world, or where there are no poses.

    Args:
        curvatures: `own_curvatures` of the problem.
    """
    found = [_gauge(problem, kind, curvatures) for kind in POSE_KINDS]
    return max(found, key=lambda gauge: gauge.motions.shape[1])


def _gauge(problem: LeastSquares, kind: str, curvatures: list[NDArray[np.float64]]) -> Gauge:
    layout = problem.layout
    G, WG = np.zeros((layout.dof, DOF)), np.zeros((layout.dof, DOF))
    for block, tangents, number, x, H in zip(
        layout.blocks, layout.tangents, layout.number, problem.values, curvatures, strict=True
    ):
        free = np.flatnonzero(number >= 0)
        kinds = kinds_of(block.manifold)
        reading = kind if kind in kinds else next((one for one in _READINGS if one in kinds), "constant")
        if not len(free) or reading == "constant":
            continue
        rows = slice(int(layout.start[number[free[0]]]), int(layout.start[number[free[0]]]) + len(free) * block.manifold.dof)
        motions = motions_of(tangents, reading, np.ascontiguousarray(x[free]))
        G[rows] = motions.reshape(-1, DOF)
        if reading == kind:  # a pose that is seen by little has little to say about the common motion
            WG[rows] = (H @ motions).reshape(-1, DOF)
    basis = _basis(np.einsum("ki,k,kj->ij", G, problem.system.diagonal, G))
    seen = np.stack([problem.product(G @ one) for one in basis.T], axis=1) if basis.shape[1] else np.zeros((0, 0))
    weight, axes = np.linalg.eigh(np.einsum("ki,kj->ij", seen, seen))
    basis = basis @ axes[:, weight < _UNSEEN]
    G, WG = G @ basis, WG @ basis
    basis = _basis(np.einsum("ki,kj->ij", G, WG))  # poses in one place do not tell how large the world is
    return Gauge(G @ basis, (WG @ basis).T)


def _basis(squares: NDArray[np.float64]) -> NDArray[np.float64]:
    """(m, k) by which positive semidefinite (m, m) becomes the identity, without directions that it does not have."""
    scale = np.sqrt(np.diag(squares))
    inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0.0)
    weight, axes = np.linalg.eigh(squares * inverse[:, None] * inverse)
    kept = weight > _DISTINCT * float(weight.max(initial=0.0))
    return np.asarray(inverse[:, None] * axes[:, kept] / np.sqrt(weight[kept]))
