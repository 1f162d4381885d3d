"""Many loop closures were refused: were they false, or were loop closures and odometry read as something they are not?

Where most are false, the few that are true confirm each other: all others predict each of them so narrowly that a false one
hardly falls there, and those that were refused join poses as far apart as any. Units, directions or ids that differ between
odometry and loop closures, or odometry that claims more than it can, look otherwise. What was refused joins poses that are near
each other, though not as claimed, and what was kept agrees because little was predicted of it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_quantile
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.optimization.solver_options import SolverOptions
from boxplus.systems.pose_graph.doubts.reliability import Reliability
from boxplus.systems.pose_graph.loops import LoopVerdict
from boxplus.systems.pose_graph.problem import odometry_order, pose_graph_problem, residual_of, with_edges

_MANY, _NEARLY_ALL = 0.5, 0.8  # share of the loop closures
_FEW = 5  # stretches that loop closures were kept between; fewer agree as they happen to
_NEAR, _AS_NEAR = 0.1, 0.3  # share of any pairs that count as near, and of refused ones that are, of which false ones are not
_STRETCH = 30  # poses; false loop closures next to each other agree with each other, and are one witness
_PARTNERS = 16  # other loop closures, with whose poses those of one make any pair
_BY_CHANCE = 0.1  # of the kept ones, that false ones may be expected among; sound graphs have a hundredth
_GATE = 0.999  # of true loop closures within the prediction


def refusals_doubt(graph: PoseGraph, verdict: LoopVerdict) -> str | None:
    """A sentence where the loop closures that were refused hardly were false, or those that were kept may be."""
    loops, refused = int(np.count_nonzero(verdict.is_loop)), np.flatnonzero(verdict.is_loop & ~verdict.is_kept)
    if not len(refused) >= max(_MANY * loops, _FEW):
        return None
    told = f"{len(refused)} of {loops} loop closures were refused"
    near = _share_near(graph, verdict.solution.values[0], refused)
    if near > _AS_NEAR:
        return (
            f"{told}, and {near:.0%} of these join poses that the result has near each other, which false ones would not: loop "
            "closures and odometry differ in unit, in direction or in what they claim, or the odometry slipped"
        )
    if not len(refused) >= _NEARLY_ALL * loops:
        return None
    told += ", and the result is nearly the odometry alone"
    witnesses = _witnesses(graph, np.flatnonzero(verdict.is_loop & verdict.is_kept))
    by_chance = None
    if len(witnesses) >= _FEW:
        by_chance = _kept_by_chance(graph, verdict, witnesses, _witnesses(graph, refused))
        if by_chance is not None and not by_chance > _BY_CHANCE * len(witnesses):
            return None
    many = "" if by_chance is None else f", and by chance {by_chance:.2g} would be"
    return (
        f"{told}: so many are false, or loop closures and odometry differ in unit, in direction or in what they claim, and those "
        f"that were kept agree by chance; between stretches of {_STRETCH} poses {len(witnesses)} were kept{many}"
    )


def _share_near(graph: PoseGraph, poses: NDArray[np.float64], edges: NDArray[np.int64]) -> float:
    """Share of these edges whose poses lie nearer to each other than nine of ten pairs of the poses that they join."""
    p = poses[:, -graph.dimension :]
    i, j = graph.edges[edges].T
    own = np.linalg.norm(p[i] - p[j], axis=1)
    partners = range(1, min(len(edges), _PARTNERS + 1))
    any_pair = np.concatenate([np.linalg.norm(p[i] - p[np.roll(j, k)], axis=1) for k in partners])
    return float((own < np.quantile(any_pair, _NEAR)).mean())


def _witnesses(graph: PoseGraph, edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """One of these loop closures for every two stretches of odometry: what is false next to each other agrees with each other."""
    stretch = np.sort(odometry_order(graph)[graph.edges[edges]], axis=1) // _STRETCH
    return edges[np.unique(stretch, axis=0, return_index=True)[1]]


def _kept_by_chance(graph: PoseGraph, verdict: LoopVerdict, kept: NDArray[np.int64], refused: NDArray[np.int64]) -> float | None:
    """How many of `refused` would have been kept as those of `kept` were; None where nothing tells.

    A false one is kept where it falls into what all other edges predict of a kept one. That takes up a volume, and the errors of
    those that were refused are spread over another.
    """
    d, x = graph.information.shape[1], verdict.solution.values[0]
    is_counted = ~verdict.is_loop
    is_counted[kept] = True
    part = with_edges(replace(graph, poses=x), is_counted)
    problem, poses = pose_graph_problem(part)
    known = Reliability.of(part, problem.solve(SolverOptions(max_iterations=0), start=[x]), poses)
    if known is None:
        return None
    share = np.eye(d) - known.predicted[verdict.is_loop[is_counted]]
    sign, logarithm = np.linalg.slogdet(share)
    residual = residual_of(graph)
    r, valid = np.zeros((len(graph.edges), d)), np.ones(len(graph.edges), dtype=np.bool_)
    rows = tuple(column.astype(np.uint32) for column in graph.edges.T)
    residual.evaluate_into(0, len(r), (x, x), rows, r, valid)
    W = np.broadcast_to(residual.whitening.factors, (len(r), d, d))[refused]
    e = np.einsum("nab,nb->na", W, r[refused])
    spread = np.linalg.slogdet(e.T @ e / len(e))
    if not (sign > 0.0).all() or not spread[0] > 0.0:
        return None
    radius = math.sqrt(chi_square_quantile(_GATE, d))
    ball = 0.5 * d * math.log(math.pi) - math.lgamma(0.5 * d + 1.0) + d * math.log(radius)
    density = -0.5 * (d * math.log(2.0 * math.pi) + spread[1])
    return len(refused) * float(np.exp(np.minimum(ball - 0.5 * logarithm + density, 0.0)).mean())
