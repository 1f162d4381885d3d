"""The least-squares problem of a pose graph, and what its edges add to the objective."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3
from boxplus.optimization.losses import Loss
from boxplus.optimization.problem import Problem
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals.chordal_pose import ChordalPose, ChordalPose2D, chordal_weights
from boxplus.residuals.relative_pose import RelativePose
from boxplus.residuals.relative_pose_2d import RelativePose2D
from boxplus.residuals.residual import Residual
from boxplus.systems.pose_graph.start import held_poses, spanning_tree_start

Objective = Literal["logarithm", "chordal"]
ODOMETRY, LOOPS = "odometry", "loops"
"""Names of the groups of a problem with loops apart."""


def edge_parts(dim: int) -> tuple[slice, slice]:
    """Where rotation and translation stand in the errors of edges, 6 in space and 3 in the plane, and in their information."""
    split = 3 if dim == 6 else 1
    return slice(0, split), slice(split, dim)


def manifold_of(graph: PoseGraph) -> Manifold:
    """Of the poses of a graph: those of space, or of the plane."""
    return SE3 if graph.dimension == 3 else SE2


def pose_graph_problem(
    graph: PoseGraph,
    *,
    held: NDArray[np.int64] | None = None,
    loss: Loss | None = None,
    objective: Objective = "logarithm",
) -> tuple[Problem, Variables]:
    """The least-squares problem of a graph, with its poses as one block of variables.

    Args:
        held: poses that do not move; `held_poses(graph)` if left out.
    """
    problem = Problem()
    values = graph.poses if graph.poses is not None else spanning_tree_start(graph)
    poses = problem.add_variables(manifold_of(graph), values, name="poses")
    i, j = graph.edges.T
    problem.add_residuals(residual_of(graph, objective), poses[i], poses[j], loss=loss, name="edges")
    problem.fix(poses[held_poses(graph) if held is None else held])
    return problem, poses


def problem_with_loops_apart(graph: PoseGraph, is_loop: NDArray[np.bool_]) -> tuple[Problem, Variables]:
    """The same with the logarithmic error, its edges in two groups: `ODOMETRY`, left out where there is none, and `LOOPS`."""
    problem = Problem()
    values = graph.poses if graph.poses is not None else spanning_tree_start(graph)
    poses = problem.add_variables(manifold_of(graph), values, name="poses")
    for name, rows in ((ODOMETRY, ~is_loop), (LOOPS, is_loop)):
        if rows.any():
            part = with_edges(graph, rows)
            i, j = part.edges.T
            problem.add_residuals(residual_of(part), poses[i], poses[j], name=name)
    problem.fix(poses[held_poses(graph)])
    return problem, poses


def residual_of(graph: PoseGraph, objective: Objective = "logarithm") -> Residual:
    """The residuals of all edges."""
    if objective == "chordal":
        kappa, tau = chordal_weights(graph.information)
        return (ChordalPose if graph.dimension == 3 else ChordalPose2D)(graph.measurements, kappa=kappa, tau=tau)
    kind = RelativePose if graph.dimension == 3 else RelativePose2D
    return kind(graph.measurements, information=graph.information)


def with_edges(graph: PoseGraph, rows: NDArray[np.bool_]) -> PoseGraph:
    """The graph with some of its edges only."""
    if rows.all():
        return graph
    return replace(graph, edges=graph.edges[rows], measurements=graph.measurements[rows], information=graph.information[rows])


def consecutive_edges(graph: PoseGraph) -> NDArray[np.bool_]:
    """(m,) edges between poses that follow each other (`odometry_order`): what robots call odometry.

    None where less than half of the poses are joined to the next: the edges that are then were drawn as any others.
    """
    follow, known = _following(graph, odometry_order(graph))
    return follow if 2 * known >= len(graph.ids) - 1 else np.zeros(len(follow), dtype=np.bool_)


def odometry_order(graph: PoseGraph) -> NDArray[np.int64]:
    """(n,) place of every pose in the order of names or in that of the file, whichever joins more poses to the next."""
    by_name, by_file = np.empty(len(graph.ids), dtype=np.int64), np.arange(len(graph.ids))
    by_name[np.argsort(graph.ids, kind="stable")] = by_file
    if np.array_equal(by_name, by_file):
        return by_name
    return by_file if _following(graph, by_file)[1] > _following(graph, by_name)[1] else by_name


def _following(graph: PoseGraph, rank: NDArray[np.int64]) -> tuple[NDArray[np.bool_], int]:
    """(m,) edges between poses that follow each other in the order of rank (n,), and how many poses are so joined to the next."""
    i, j = rank[graph.edges].T
    follow = np.asarray(np.abs(i - j) == 1)
    is_joined = np.zeros(len(rank), dtype=np.bool_)
    is_joined[np.minimum(i, j)[follow]] = True
    return follow, int(np.count_nonzero(is_joined))


def squared_errors(residual: Residual, graph: PoseGraph, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """(m,) what every edge adds to chi2."""
    i, j = graph.edges.T
    whitened = np.einsum("nab,nb->na", residual.whitening.factors, residual.evaluate(poses[i], poses[j]))
    return np.asarray((whitened * whitened).sum(axis=1))


def turns(residual: Residual, graph: PoseGraph, poses: NDArray[np.float64]) -> float:
    """Root mean square of the errors of all edges in rotation [rad]."""
    i, j = graph.edges.T
    e = residual.evaluate(poses[i], poses[j])[:, : 3 if graph.dimension == 3 else 1]
    return float(np.sqrt((e * e).sum(axis=1).mean()))


def chi2(graph: PoseGraph, poses: NDArray[np.float64], objective: Objective = "logarithm") -> float:
    """The objective over the edges, for poses laid out as in the graph, without any robust loss and without ½."""
    return float(squared_errors(residual_of(graph, objective), graph, poses).sum())


def positions(graph: PoseGraph, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) positions of poses laid out as in a graph [m]; z = 0 in the plane."""
    return poses[:, 4:] if graph.dimension == 3 else np.column_stack([poses[:, 1:], np.zeros(len(poses))])
