"""What speaks against a result that its own objective does not examine: a robust loss, the chordal objective, a lone joint.

A loss lets go of what contradicts the rest, and the chordal objective has no distribution that its errors could be held
against. So the edges that count are held against each other with the logarithmic error, in least squares from the poses that
came out. And no objective sees that two stretches of odometry hang together by one loop closure, which may say anything.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.optimization.losses import Loss
from boxplus.optimization.solver_options import SolverOptions
from boxplus.sparse.graphs.components import connected_components
from boxplus.sparse.graphs.cut_edges import cut_edges
from boxplus.systems.pose_graph.doubts.fit import Fit, edge_names, misfit, standing_out
from boxplus.systems.pose_graph.doubts.reliability import Reliability
from boxplus.systems.pose_graph.doubts.suspicions import BENT, Suspicion, suspicions
from boxplus.systems.pose_graph.problem import (
    consecutive_edges,
    manifold_of,
    pose_graph_problem,
    residual_of,
    squared_errors,
    with_edges,
)
from boxplus.systems.pose_graph.start import components, held_poses

_TOLD = 5  # lone joints, before the rest is counted
_LARGE = 0.1  # share of the poses that hang on a lone joint, from which on the result is not to be trusted


def held_against_each_other(
    graph: PoseGraph, poses: NDArray[np.float64], options: SolverOptions, loss: Loss | None, kept: NDArray[np.bool_] | None
) -> list[Suspicion]:
    """What edges say of each other that count in a result, with the logarithmic error.

    Args:
        graph: edges with information.
        poses: the result, where least squares begins.
        options: of the solver.
        loss: of the result; edges that no noise explains at its poses are those that it is there for.
        kept: (m,) edges that a loss that forgets began with; those that it let go of afterwards may be the right ones.
    """
    dim = graph.information.shape[1]
    counted = np.ones(len(graph.edges), dtype=np.bool_) if kept is None else kept.copy()
    if loss is not None and kept is None:
        without = ~standing_out(squared_errors(residual_of(graph), graph, poses), dim)
        if components(with_edges(graph, without)).max(initial=0) == components(graph).max(initial=0):
            counted = without
    part = with_edges(replace(graph, poses=poses), counted)
    problem, variables = pose_graph_problem(part)
    solution = problem.solve(options, start=[poses])
    squared = squared_errors(residual_of(part), part, solution.values[0])
    fit = Fit.of(part, squared, np.ones(len(squared), dtype=np.bool_), len(held_poses(part)))
    said = []
    if fit.is_poor:
        told = (
            f"{misfit(fit)} with the logarithmic error, from these poses on: false edges, information that is too optimistic, "
            "or a local minimum"
        )
        said.append(Suspicion(told, fit.is_contradiction and bool(standing_out(squared, dim).any())))
    known = Reliability.of(part, solution, variables)
    if known is None:
        return said
    if loss is not None and not loss.is_redescending and not counted.all():
        said += _pulled(known, poses, graph, ~counted)
    return said + suspicions(known, solution, consecutive_edges(graph)[counted])


def _pulled(known: Reliability, poses: NDArray[np.float64], graph: PoseGraph, doubtful: NDArray[np.bool_]) -> list[Suspicion]:
    """How far edges that no noise explains hold the result from where all others put it, under a loss that gives up none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        off = manifold_of(graph).boxminus(poses, known.poses) / known.deviations
    bent = float(np.abs(np.where(known.deviations > 0.0, off, 0.0)).max(initial=0.0))
    if not bent > BENT:
        return []
    edges = np.flatnonzero(doubtful)
    told = (
        f"{len(edges)} edges that no noise explains ({edge_names(graph, edges)}) hold the result up to {bent:.2g} of its own "
        "standard deviations from where all others put it, as this loss gives none up: take one that does (geman_mcclure), "
        "or --robust gnc"
    )
    return [Suspicion(told, True)]


def lone_joints(graph: PoseGraph, follow: NDArray[np.bool_]) -> list[Suspicion]:
    """Stretches of odometry that are joined by a single loop closure, which nothing checks.

    Closures between the same two poses are one witness; poses that the file fixes are joined by that.

    Args:
        follow: (m,) which edges are odometry (`consecutive_edges`).
    """
    is_loop = ~follow
    label = connected_components(len(graph.ids), *graph.edges[follow].T)[1]
    sizes = np.bincount(label, minlength=1)
    if is_loop.all() or len(sizes) < 2:
        return []
    i, j = np.sort(graph.edges[is_loop], axis=1).T
    edges = np.flatnonzero(is_loop)[np.unique(i * len(graph.ids) + j, return_index=True)[1]]
    a, b = label[graph.edges[edges]].T
    between = np.flatnonzero(a != b)
    edges, a, b = edges[between], a[between], b[between]
    held = label[graph.fixed]
    cuts, hanging = cut_edges(np.append(a, held[1:]), np.append(b, held[:1].repeat(len(held[1:]))), sizes)
    lone = np.flatnonzero((cuts < len(edges)) & (hanging > 1))
    lone = lone[np.argsort(-hanging[lone], kind="stable")]
    said = []
    for cut, count in zip(cuts[lone[:_TOLD]], hanging[lone[:_TOLD]], strict=True):
        one, other = graph.ids[graph.edges[edges[cut]]]
        said.append(
            Suspicion(
                f"{count} poses hang on the loop closure {one} → {other} alone, which joins stretches of odometry: whether it "
                "is right, and with it how they lie to each other, nothing can tell",
                bool(count >= _LARGE * len(graph.ids)),
            )
        )
    if len(lone) > _TOLD:
        most = hanging[lone[_TOLD]]
        told = f"{len(lone) - _TOLD} more stretches of odometry hang on one loop closure each, of {most} poses at most"
        said.append(Suspicion(told, bool(most >= _LARGE * len(graph.ids))))
    return said
