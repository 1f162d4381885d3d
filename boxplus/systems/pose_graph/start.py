"""Where the optimisation of a pose graph starts: along a spanning tree, or from the chordal relaxation.

Chordal initialisation (Martinec and Pajdla, CVPR 2007; Carlone et al., ICRA 2015): the rotations are first sought among all
matrices, where ‖R_j − R_i R_ij‖² is a linear least-squares problem, and then projected onto SO(d); the translations follow from
a second linear problem. Neither depends on a starting value, which is why it reaches basins that no local start finds.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.manifolds import quaternion
from boxplus.manifolds.se3 import compose_into, inverse_into
from boxplus.sparse.block_matrix import BlockPattern
from boxplus.sparse.cholesky import SparseCholesky
from boxplus.sparse.graphs.breadth_first import breadth_first_trees
from boxplus.sparse.graphs.components import connected_components

_POLAR_ITERATIONS = 30


def held_poses(graph: PoseGraph) -> NDArray[np.int64]:
    """(k,) the poses that hold the graph in the world: those the file fixes, and the first of every component without any."""
    label = components(graph)
    anchored = np.unique(label[graph.fixed])
    pieces, first = np.unique(label, return_index=True)
    return np.union1d(graph.fixed, first[~np.isin(pieces, anchored)]).astype(np.int64)


def components(graph: PoseGraph) -> NDArray[np.int64]:
    """(n,) number of the connected component of every pose."""
    return connected_components(len(graph.ids), *graph.edges.T)[1]


def spanning_tree_start(graph: PoseGraph) -> NDArray[np.float64]:
    """Poses, laid out as the measurements, composed along breadth-first trees from the first held pose of every component.

    Held poses stay where the graph has them, or are the identity. With breadth first, the chains of measurements that
    errors pile up along are as short as can be. Of parallel edges the last one stands.
    """
    held = held_poses(graph)
    poses = _at_held(graph, held)
    is_held = np.zeros(len(graph.ids), dtype=np.bool_)
    is_held[held] = True
    child, parent, edge = breadth_first_trees(graph.edges, is_held)
    forward = graph.edges[edge, 0] == parent
    follow = _follow_3d if graph.dimension == 3 else _follow_2d
    follow(child, parent, edge, forward, graph.measurements, poses)
    return poses


def chordal_start(graph: PoseGraph, order: NDArray[np.int64] | None = None) -> NDArray[np.float64]:
    """Poses, laid out as the measurements, from the chordal relaxation.

    Held poses stay where the graph has them, or are the identity. An edge weighs by the precision of its rotation and of
    its translation, each averaged over the axes.

    Args:
        order: (n − held,) in which a factorisation eliminates the poses that are not held, numbered from 0, where one is known:
            the graph is the same for every objective.
    """
    i = graph.edges[:, 0]
    roots = held_poses(graph)
    start = _at_held(graph, roots)
    kappa, tau = _weights(graph)
    relaxation = _Relaxation(len(graph.ids), graph.edges, roots, order)
    if graph.dimension == 3:
        Z = quaternion.to_matrix(graph.measurements[:, :4])
        # A row of R, as a column u: u_j = Zᵀ u_i. The three rows are three right-hand sides.
        known = np.swapaxes(quaternion.to_matrix(start[roots, :4]), 1, 2)
        rows = relaxation.minimum(np.swapaxes(Z, 1, 2), np.zeros((len(Z), 3, 3)), kappa, known)
        R = _nearest_rotations(np.swapaxes(rows, 1, 2))
        start[:, :4] = quaternion.from_matrix(R)
        measured, at = graph.measurements[:, 4:], slice(4, 7)
    else:
        c, s = np.cos(graph.measurements[:, 0]), np.sin(graph.measurements[:, 0])
        Z = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
        known = np.stack([np.cos(start[roots, 0]), np.sin(start[roots, 0])], -1)[:, :, None]
        u = relaxation.minimum(Z, np.zeros((len(Z), 2, 1)), kappa, known)[:, :, 0]
        start[:, 0] = np.arctan2(u[:, 1], u[:, 0])
        c, s = np.cos(start[:, 0]), np.sin(start[:, 0])
        R = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
        measured, at = graph.measurements[:, 1:], slice(1, 3)
    steps = np.einsum("nab,nb->na", R[i], measured)
    same = np.ones((len(steps), 1, 1))  # t_j − t_i is the step, on every axis alike
    start[:, at] = relaxation.minimum(same, steps[:, None], tau, start[roots, None, at])[:, 0]
    start[roots] = _at_held(graph, roots)[roots]  # to the last bit
    return start


def _at_held(graph: PoseGraph, held: NDArray[np.int64]) -> NDArray[np.float64]:
    """Identities, and the poses of the graph where they are held."""
    poses = np.zeros((len(graph.ids), 7 if graph.dimension == 3 else 3))
    if graph.dimension == 3:
        poses[:, 0] = 1.0
    if graph.poses is not None:
        poses[held] = graph.poses[held]
    return poses


def _weights(graph: PoseGraph) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Precision of rotation and of translation of every edge, averaged over the axes."""
    split = 3 if graph.dimension == 3 else 1
    diagonal = np.einsum("nii->ni", graph.information)
    kappa, tau = diagonal[:, :split].mean(axis=1), diagonal[:, split:].mean(axis=1)
    # An edge that says nothing of one of the two still must not leave the linear problem singular; nor must all of them.
    return np.maximum(kappa, 1e-9 * (kappa.max() or 1e9)), np.maximum(tau, 1e-9 * (tau.max() or 1e9))


class _Relaxation:
    """Σ weight ‖u_j − M u_i − step‖² over the edges of a graph, with u known at some poses; ordered once for all that is sought.

    Args:
        n: poses.
        edges: (m, 2) ends i and j.
        roots: (k,) poses where u is known.
        order: of the other poses, numbered from 0, in a factorisation; None where none is known yet.
    """

    def __init__(self, n: int, edges: NDArray[np.int64], roots: NDArray[np.int64], order: NDArray[np.int64] | None) -> None:
        self._edges, self._roots, self._order = edges, roots, order
        free = np.ones(n, dtype=np.bool_)
        free[roots] = False
        self._free = np.flatnonzero(free)
        self._number = np.where(free, np.cumsum(free) - 1, -1)
        ends = self._number[edges]
        inner = np.flatnonzero((ends >= 0).all(axis=1))
        self._pattern, pairs = BlockPattern.from_pairs(np.ones(len(self._free), dtype=np.int64), *ends[inner].T)
        self._block = np.full(len(edges), -1)
        self._block[inner] = pairs.block

    def minimum(
        self,
        M: NDArray[np.float64],
        step: NDArray[np.float64],
        weight: NDArray[np.float64],
        known: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """u (n, d, c), with u[roots] = known (k, d, c).

        Args:
            M: (m, d, d), orthogonal.
            step: (m, d, c).
            weight: (m,).
        """
        size, (d, c) = len(self._free), known.shape[1:]
        u = np.zeros((len(self._number), d, c))
        u[self._roots] = known
        if size == 0:
            return u
        pattern = BlockPattern(np.full(size, d), self._pattern.col_start, self._pattern.row)
        values, right = np.zeros((len(pattern.row), d, d)), np.zeros((size, d, c))
        _assemble(
            self._edges, self._number, self._block, pattern.col_start, np.ascontiguousarray(M), step, weight, u, values, right
        )
        cholesky = SparseCholesky(pattern, ordering="auto" if self._order is None else self._order)
        self._order = cholesky.permutation
        cholesky.factorize(values.reshape(-1))
        u[self._free] = cholesky.solve(right.reshape(size * d, c)).reshape(size, d, c)
        return u


@kernel
def _assemble(
    edges: NDArray[np.int64],
    number: NDArray[np.int64],
    block: NDArray[np.int64],
    diagonal: NDArray[np.int64],
    M: NDArray[np.float64],
    step: NDArray[np.float64],
    weight: NDArray[np.float64],
    u: NDArray[np.float64],
    values: NDArray[np.float64],
    right: NDArray[np.float64],
) -> None:
    """Add the normal equations of `_Relaxation` to values (blocks, d, d) and right (free poses, d, c).

    `number` is −1 where u is known, and u zero elsewhere; `block` that of an edge between
    free poses, `diagonal` that of a pose.
    """
    d, c = u.shape[1], u.shape[2]
    for e in range(edges.shape[0]):
        i, j, w = edges[e, 0], edges[e, 1], weight[e]
        a, b = number[i], number[j]
        for p in range(d):
            if a >= 0:
                values[diagonal[a], p, p] += w
            if b >= 0:
                values[diagonal[b], p, p] += w
            for q in range(d):
                if a >= 0 and b >= 0:
                    values[block[e], p, q] -= w * (M[e, p, q] if b > a else M[e, q, p])
            for k in range(c):
                pull = step[e, p, k] - u[j, p, k]
                for q in range(d):
                    pull += M[e, p, q] * u[i, q, k]
                if b >= 0:
                    right[b, p, k] += w * pull
                if a >= 0:
                    for q in range(d):
                        right[a, q, k] -= w * M[e, p, q] * pull


def _nearest_rotations(M: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation nearest to each matrix (n, 3, 3) in the Frobenius norm."""
    R = np.ascontiguousarray(M)
    failed = np.zeros(len(R), dtype=np.bool_)
    _polar(R, failed)
    if failed.any():
        U, _, Vt = np.linalg.svd(M[failed])
        U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
        R[failed] = U @ Vt
    return R


@kernel
def _polar(M: NDArray[np.float64], failed: NDArray[np.bool_]) -> None:
    """Replace matrices of positive determinant by their orthogonal polar factor (Newton's iteration, Higham 1986)."""
    for n in range(M.shape[0]):
        X = M[n]
        failed[n] = True
        for _ in range(_POLAR_ITERATIONS):
            c00 = X[1, 1] * X[2, 2] - X[1, 2] * X[2, 1]
            c01 = X[1, 2] * X[2, 0] - X[1, 0] * X[2, 2]
            c02 = X[1, 0] * X[2, 1] - X[1, 1] * X[2, 0]
            det = X[0, 0] * c00 + X[0, 1] * c01 + X[0, 2] * c02
            if not det > 1e-12:
                break
            c10 = X[0, 2] * X[2, 1] - X[0, 1] * X[2, 2]
            c11 = X[0, 0] * X[2, 2] - X[0, 2] * X[2, 0]
            c12 = X[0, 1] * X[2, 0] - X[0, 0] * X[2, 1]
            c20 = X[0, 1] * X[1, 2] - X[0, 2] * X[1, 1]
            c21 = X[0, 2] * X[1, 0] - X[0, 0] * X[1, 2]
            c22 = X[0, 0] * X[1, 1] - X[0, 1] * X[1, 0]
            scale = det ** (1.0 / 3.0) if det < 0.5 or det > 2.0 else 1.0
            a, b = 0.5 / scale, 0.5 * scale / det
            change = 0.0
            for row, (u, v, w) in enumerate(((c00, c01, c02), (c10, c11, c12), (c20, c21, c22))):
                x, y, z = a * X[row, 0] + b * u, a * X[row, 1] + b * v, a * X[row, 2] + b * w
                change = max(change, abs(x - X[row, 0]), abs(y - X[row, 1]), abs(z - X[row, 2]))
                X[row, 0], X[row, 1], X[row, 2] = x, y, z
            if change < 1e-14:
                failed[n] = False
                break


@kernel
def _follow_3d(
    children: NDArray[np.int64],
    parents: NDArray[np.int64],
    edge: NDArray[np.int64],
    forward: NDArray[np.bool_],
    measurements: NDArray[np.float64],
    poses: NDArray[np.float64],
) -> None:
    backward = np.empty(7)
    for k in range(children.shape[0]):
        step = measurements[edge[k]]
        if not forward[k]:
            inverse_into(step, backward)
            step = backward
        compose_into(poses[parents[k]], step, poses[children[k]])


@kernel
def _follow_2d(
    children: NDArray[np.int64],
    parents: NDArray[np.int64],
    edge: NDArray[np.int64],
    forward: NDArray[np.bool_],
    measurements: NDArray[np.float64],
    poses: NDArray[np.float64],
) -> None:
    for k in range(children.shape[0]):
        angle, x, y = measurements[edge[k], 0], measurements[edge[k], 1], measurements[edge[k], 2]
        if not forward[k]:
            c, s = math.cos(angle), math.sin(angle)
            angle, x, y = -angle, -c * x - s * y, s * x - c * y
        p = poses[parents[k]]
        c, s = math.cos(p[0]), math.sin(p[0])
        child = children[k]
        turned = p[0] + angle
        poses[child, 0] = turned - 2.0 * math.pi * math.floor((turned + math.pi) / (2.0 * math.pi))
        poses[child, 1] = p[1] + c * x - s * y
        poses[child, 2] = p[2] + s * x + c * y
