"""What all other edges say of each one, and how well they can.

Least squares spreads what one edge is off by over all around it, so that errors look like noise. What an edge leaves of its
own error is known beforehand: whitened, e has the covariance S = I − J P Jᵀ, with J its Jacobian and P the covariance of the
poses. So eᵀ S⁻¹ e is how far the others contradict it, as if it had been left out, and the trace of S, its redundancy, how well
they could (Baarda, A testing procedure for use in geodetic networks, 1968). The same holds of any error with a known shape b
over all edges: its size is bᵀe / bᵀSb.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_exceeded
from boxplus.errors import SingularProblemError
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.optimization.solution import Solution
from boxplus.optimization.terms.variables import Variables
from boxplus.systems.pose_graph.doubts.contradiction import Contradiction
from boxplus.systems.pose_graph.problem import residual_of

Floats = NDArray[np.float64]

STRANGE = 1e-4  # chance that an edge of a sound graph, the worst of all, is told
_UNCHECKED = 1e-5  # share of an error that shows, below which nothing checks that direction
_ROUNDING = 1e-15  # of the covariances that such a share is a small difference of


@dataclass(frozen=True, slots=True)
class Reliability:
    """Errors of edges, and what is known of these beforehand.

    Attributes:
        graph: with these edges only.
        poses: the result.
        errors: (m, d) whitened.
        factors: (m, d, d) by which errors are whitened.
        jacobians: (m, d, d) whitened, by the first and by the second pose.
        predicted: (m, d, d) J P Jᵀ, the covariance of what the result says of an edge, in its standard deviations.
        deviations: (n, d) standard deviations of the poses.
        against: what all others say of each edge.
    """

    graph: PoseGraph
    poses: Floats
    errors: Floats
    factors: Floats
    jacobians: tuple[Floats, Floats]
    predicted: Floats
    deviations: Floats
    against: Contradiction

    @classmethod
    def of(cls, graph: PoseGraph, solution: Solution, variables: Variables) -> Reliability | None:
        """Of the edges that a solution rests on; None where these do not determine all poses.

        Args:
            graph: with these edges only.
            variables: the poses.
        """
        (i, j), m = graph.edges.T, len(graph.edges)
        residual, x = residual_of(graph), solution[variables]
        d = residual.dim
        r, J, valid = np.zeros((m, d)), (np.zeros((m, d, d)), np.zeros((m, d, d))), np.ones(m, dtype=np.bool_)
        residual.linearize_into(0, m, (x, x), (i.astype(np.uint32), j.astype(np.uint32)), r, J, valid)
        W = np.broadcast_to(residual.whitening.factors, (m, d, d))
        everyone = np.arange(len(x))
        try:
            first, second = (np.concatenate(rows) for rows in ((i, j, i, everyone), (i, j, j, everyone)))
            P = solution.covariance(variables[first], variables[second], is_determined=True)
        except SingularProblemError:
            return None
        e, Ji, Jj = (W @ r[:, :, None])[:, :, 0], W @ J[0], W @ J[1]
        across = Ji @ P[2 * m : 3 * m] @ np.swapaxes(Jj, 1, 2)
        own = [Ji @ P[:m] @ np.swapaxes(Ji, 1, 2), Jj @ P[m : 2 * m] @ np.swapaxes(Jj, 1, 2)]
        M = own[0] + own[1] + across + np.swapaxes(across, 1, 2)
        rounding = _ROUNDING * np.einsum("nii->n", own[0] + own[1])
        deviations = np.sqrt(np.maximum(np.einsum("nii->ni", P[3 * m :]), 0.0))
        predicted = 0.5 * (M + np.swapaxes(M, 1, 2))
        # What is left of the share of an error that shows when nothing checks it.
        least = np.maximum(_UNCHECKED, rounding)
        return cls(graph, x, e, W, (Ji, Jj), predicted, deviations, Contradiction.of(e, predicted, least))

    @property
    def redundancy(self) -> Floats:
        """(m,) sum of the shares of an edge's error that show, over its directions: the mean of its squared error."""
        d = self.errors.shape[1]
        return np.asarray(np.clip(d - np.einsum("nii->n", self.predicted), 0.0, d))

    @property
    def sentence(self) -> str:
        """How large an error of an edge has to be for all others to contradict it."""
        d, m = self.errors.shape[1], len(self.errors)
        directions = self.against.directions
        alone = int(np.count_nonzero(directions == 0))
        if alone == m:
            return "no edge is checked by others"
        share = self.redundancy[directions > 0] / d
        shows = math.sqrt(chi_square_exceeded(STRANGE / m, d) / float(np.median(share)))
        rest = f", and not at all in {alone}, which no other checks" if alone else ""
        return f"a wrong edge shows from {shows:.2g} of its standard deviations on in half of {m - alone} edges{rest}"
