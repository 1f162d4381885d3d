"""Whether the edges agree with the poses that the file fixes, which nothing moves and no edge is doubted for.

Of every piece of the graph one fixed pose holds it, and the others are let go: where the edges then put these has a known
covariance, and each is held against where the file has it, which tells whole groups that lie elsewhere. And each is let go alone
while all others hold (`reactions.py`), which tells single ones, though noise adds up to more on the way from the first.

Held, one that is wrong bends what lies between, and its error is spread over so many edges that it looks like noise; graduated
non-convexity refuses the loop closures that contradict it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_exceeded
from boxplus.errors import BoxplusError
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.optimization.losses import Loss
from boxplus.optimization.minimizers.minimize import Callback
from boxplus.optimization.solver_options import SolverOptions
from boxplus.systems.pose_graph.doubts.fit import pose_names
from boxplus.systems.pose_graph.doubts.reactions import Reactions
from boxplus.systems.pose_graph.loops import judge_loops
from boxplus.systems.pose_graph.named import named
from boxplus.systems.pose_graph.problem import edge_parts, manifold_of, pose_graph_problem, with_edges
from boxplus.systems.pose_graph.start import components, spanning_tree_start

_CHANCE = 5e-5  # that the worst of the fixed poses of a sound graph is told, by either way of asking
_LINEAR = 0.3  # [rad] standard deviation of a rotation, up to which the covariance of poses that hang on it is right
_ASKED = 3  # of the worst, whether they are off once more, by a solve each
_SPARE = 10  # degrees of freedom from which on errors say how large noise is


def fixed_poses_doubt(
    graph: PoseGraph,
    poses: NDArray[np.float64],
    kept: NDArray[np.bool_],
    options: SolverOptions,
    loss: Loss | None,
    callback: Callback | None,
    is_loop: NDArray[np.bool_] | None = None,
) -> str | None:
    """A sentence where the edges put fixed poses elsewhere than the file does.

    Args:
        graph: edges with information.
        poses: the result, where least squares begins.
        kept: (m,) edges that count. loss: of these.
        is_loop: (m,) edges that graduated non-convexity could refuse; where it did, they are judged once more, without the poses
            that are let go: a wrong one has the very edges refused that speak against it.
        callback: may stop the search, which then finds nothing.
    """
    watch = named(callback, "do the edges agree with fixed poses?")
    part = with_edges(replace(graph, poses=poses), _believed(graph, poses, kept, is_loop, options, watch))
    together = _all_let_go(part, poses, options, loss, watch)
    if together is None:
        return None
    found = _each_let_go(part, poses, together.scale, options, loss, watch) or together
    return found.sentence(graph) if found.is_off.any() else None


@dataclass(frozen=True, slots=True)
class _Answer:
    """Where the edges put fixed poses that were let go.

    Attributes:
        witness: who holds them.
        worst: which of them is told.
        rows: (n,) of the graph.
        off: (n, d) from where the file has them.
        squared: (n,) that in standard deviations, squared.
        is_off: (n,) whether chance does not explain it.
        scale: of the variances, where the edges fit one another worse than they claim.
    """

    witness: str
    worst: int
    rows: NDArray[np.int64]
    off: NDArray[np.float64]
    squared: NDArray[np.float64]
    is_off: NDArray[np.bool_]
    scale: float

    def sentence(self, graph: PoseGraph) -> str:
        """What the edges say of the worst."""
        worst, (turn, shift) = self.worst, edge_parts(self.off.shape[1])
        distance, angle = np.linalg.norm(self.off[worst, shift]), math.degrees(float(np.linalg.norm(self.off[worst, turn])))
        more = np.count_nonzero(self.is_off) - 1
        return (
            f"the edges contradict the poses that the file fixes: as seen from {self.witness} they put pose "
            f"{graph.ids[self.rows[worst]]} {distance:.3g} m and {angle:.3g} deg from where it is fixed, by "
            f"{math.sqrt(self.squared[worst]):.3g} standard deviations"
            + (f", and {more} more elsewhere" if more else "")
            + ": one of these is wrong, or of another world, or the information of the edges claims too much"
        )


def _believed(
    graph: PoseGraph,
    poses: NDArray[np.float64],
    kept: NDArray[np.bool_],
    is_loop: NDArray[np.bool_] | None,
    options: SolverOptions,
    watch: Callback | None,
) -> NDArray[np.bool_]:
    """(m,) edges to be asked: those kept, or, where some were refused, those that are kept without the poses to be let go."""
    if is_loop is None or kept.all():
        return kept
    anchors = _anchors(graph)
    if len(anchors) == len(graph.fixed):
        return kept
    loose = replace(graph, fixed=anchors)
    odometry = with_edges(loose, ~is_loop)
    is_whole = np.array_equal(components(odometry), components(graph))
    start = spanning_tree_start(odometry) if is_whole else poses
    return judge_loops(loose, is_loop, start, options, watch).is_kept


def _all_let_go(
    part: PoseGraph, poses: NDArray[np.float64], options: SolverOptions, loss: Loss | None, watch: Callback | None
) -> _Answer | None:
    """All fixed poses let go but one of every piece; None where there is none, or no solution."""
    anchors, label = _anchors(part), components(part)
    judged = np.setdiff1d(part.fixed, anchors)
    if not len(judged):
        return None
    problem, variables = pose_graph_problem(replace(part, fixed=anchors), loss=loss)
    try:
        found = problem.solve(options, start=[poses], callback=watch)
        if found.is_broken_off or found.unconverged() is not None:
            return None
        P = found.covariance(variables[judged])
    except BoxplusError:  # pieces of the graph that only the fixed poses held
        return None
    off = manifold_of(part).boxminus(found.values[0][judged], poses[judged])
    dim = off.shape[1]
    turn, _ = edge_parts(dim)
    spare = dim * (len(part.edges) - len(part.ids) + len(np.unique(label)))
    scale = max(2.0 * found.cost / spare, 1.0) if spare >= _SPARE else 1.0
    squared = np.einsum("na,na->n", off, np.linalg.solve(P, off[:, :, None])[:, :, 0]) / scale
    squared[np.sqrt(np.einsum("nii->ni", P)[:, turn].max(axis=1)) > _LINEAR] = 0.0
    worst = int(np.argmax(squared))
    anchor = anchors[label[anchors] == label[judged[worst]]]
    is_off = squared > chi_square_exceeded(_CHANCE / len(judged), dim)
    return _Answer(f"pose {pose_names(part, anchor)}", worst, judged, off, squared, is_off, scale)


def _each_let_go(
    part: PoseGraph, poses: NDArray[np.float64], scale: float, options: SolverOptions, loss: Loss | None, watch: Callback | None
) -> _Answer | None:
    """Each fixed pose let go while all others hold; None where that finds none off, or tells nothing.

    The worst that it finds is asked once more by a solve, which linear reactions are not.
    """
    try:
        reactions = Reactions.of(part, options, loss, watch)
    except BoxplusError:
        return None
    if reactions is None:
        return None
    squared = np.where(reactions.turn > _LINEAR, 0.0, reactions.squared) / scale
    off = reactions.off.copy()
    limits = np.array([math.inf, *(chi_square_exceeded(_CHANCE / len(squared), k) for k in range(1, off.shape[1] + 1))])
    limit = limits[reactions.directions]
    is_off = squared > limit
    for worst in np.argsort(-np.where(is_off, squared, -1.0))[: min(_ASKED, np.count_nonzero(is_off))]:
        exact = _let_go(part, poses, int(reactions.rows[worst]), options, loss, watch)
        if exact is not None:
            off[worst], squared[worst] = exact[0], exact[1] / scale
        if squared[worst] > limit[worst]:
            return _Answer("the other fixed poses", int(worst), reactions.rows, off, squared, squared > limit, scale)
    return None


def _let_go(
    graph: PoseGraph,
    poses: NDArray[np.float64],
    row: int,
    options: SolverOptions,
    loss: Loss | None,
    callback: Callback | None,
) -> tuple[NDArray[np.float64], float] | None:
    """Where the edges put one fixed pose while the others hold, and that in standard deviations, squared; by a solve.

    None where none is to be had. What `Reactions` says is linear: of rotations known to 0.2 rad it made 110 deg and 6.4 standard
    deviations of 17 deg and 3.3.
    """
    problem, variables = pose_graph_problem(graph, held=np.setdiff1d(graph.fixed, [row]), loss=loss)
    try:
        found = problem.solve(options, start=[poses], callback=callback)
        if found.is_broken_off or found.unconverged() is not None:
            return None
        P = found.covariance(variables[[row]])[0]
    except BoxplusError:  # a direction that no edge measures
        return None
    off: NDArray[np.float64] = manifold_of(graph).boxminus(found.values[0][[row]], poses[[row]])[0]
    return off, float(off @ np.linalg.solve(P, off))


def _anchors(graph: PoseGraph) -> NDArray[np.int64]:
    """The first fixed pose of every piece that has one."""
    return np.asarray(graph.fixed[np.unique(components(graph)[graph.fixed], return_index=True)[1]])
