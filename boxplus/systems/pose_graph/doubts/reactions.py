"""With what force the edges pull at every fixed pose, held against what noise alone would do.

What one pose far away says of another is known badly, what the fixed poses next to it say of it well. So each is let go alone
while all others hold: along the edges these then put it elsewhere, with a covariance of their own. It takes no solve for each:
where fixed poses are springs of stiffness W, stiff against the edges, the covariance P of all poses at once contains that of
each without its own spring, C = (P⁻¹ − W)⁻¹, and the force is P⁻¹ times the distance by which its spring gave way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.optimization.losses import Loss
from boxplus.optimization.minimizers.minimize import Callback
from boxplus.optimization.solver_options import SolverOptions
from boxplus.residuals.prior import Prior
from boxplus.systems.pose_graph.problem import edge_parts, manifold_of, pose_graph_problem, residual_of
from boxplus.systems.pose_graph.start import components

_STIFF = 30.0  # times all that the edges of a pose say of it
_FREE = 1e-10  # share of the stiffness below which nothing holds a direction, to rounding
_FEWEST = 3  # fixed poses of a piece; of two, each says of the other what that says of it


@dataclass(frozen=True, slots=True)
class Reactions:
    """What the other fixed poses say of each of these.

    Attributes:
        rows: (k,) fixed poses, of pieces with three and more.
        off: (k, d) from where each is fixed to where the others put it, in its tangent.
        squared: (k,) the same in standard deviations, squared; of `directions` (k,) of d that the others determine.
        turn: (k,) [rad] largest standard deviation of a rotation that the others put it with.
    """

    rows: NDArray[np.int64]
    off: NDArray[np.float64]
    squared: NDArray[np.float64]
    directions: NDArray[np.int64]
    turn: NDArray[np.float64]

    @classmethod
    def of(
        cls, graph: PoseGraph, options: SolverOptions, loss: Loss | None = None, callback: Callback | None = None
    ) -> Reactions | None:
        """Of the fixed poses of a graph; None where there are too few, or no minimum was reached.

        Args:
            graph: every piece of it with a fixed pose, its poses a minimum with these held.

        Raises:
            SingularProblemError: see `Problem.solve`.
        """
        label = components(graph)
        rows = graph.fixed[np.bincount(label[graph.fixed], minlength=len(graph.ids))[label[graph.fixed]] >= _FEWEST]
        if graph.poses is None or not len(rows):
            return None
        manifold = manifold_of(graph)
        W = _STIFF * _stiffness(graph, graph.poses)[rows]
        problem, poses = pose_graph_problem(graph, held=np.setdiff1d(graph.fixed, rows), loss=loss)
        springs = W[:, :, None] * np.eye(W.shape[1])
        problem.add_residuals(Prior(manifold, graph.poses[rows], information=springs), poses[rows], name="fixed poses")
        found = problem.solve(options, start=[graph.poses], callback=callback)
        if found.is_broken_off or found.unconverged() is not None:
            return None
        # Scaled by the springs, all directions are alike: I where a spring alone holds, less where the edges do, too.
        size = np.sqrt(W)
        P = found.covariance(poses[rows]) * size[:, :, None] * size[:, None, :]
        force = np.linalg.solve(P, (manifold.boxminus(found.values[0][rows], graph.poses[rows]) * size)[:, :, None])[:, :, 0]
        held, axes = np.linalg.eigh(np.linalg.inv(0.5 * (P + np.swapaxes(P, 1, 2))) - np.eye(W.shape[1]))
        is_held = held > _FREE
        loose = np.where(is_held, 1.0 / np.where(is_held, held, 1.0), 0.0)
        along = np.einsum("nba,nb->na", axes, force)
        off = np.einsum("nab,nb->na", axes, loose * along) / size
        variances = np.einsum("nab,nb,nab->na", axes, loose, axes) / W
        turn = np.sqrt(variances[:, edge_parts(W.shape[1])[0]].max(axis=1))
        return cls(rows, off, (loose * along**2).sum(axis=1), is_held.sum(axis=1), turn)


def _stiffness(graph: PoseGraph, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, d) information of each coordinate of a pose were all its neighbours known; a trace of it where there is none."""
    (i, j), m, n = graph.edges.T, len(graph.edges), len(graph.ids)
    residual = residual_of(graph)
    d = residual.dim
    r, J, valid = np.zeros((m, d)), (np.zeros((m, d, d)), np.zeros((m, d, d))), np.ones(m, dtype=np.bool_)
    residual.linearize_into(0, m, (x, x), (i.astype(np.uint32), j.astype(np.uint32)), r, J, valid)
    W, total = np.broadcast_to(residual.whitening.factors, (m, d, d)), np.zeros((n, d))
    for rows, jacobian in ((i, J[0]), (j, J[1])):
        np.add.at(total, rows, ((W @ jacobian) ** 2).sum(axis=1))
    return np.asarray(np.maximum(total, math.sqrt(_FREE) * total.max(axis=0)))
