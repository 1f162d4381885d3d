"""One pose graph over sessions: each with its own poses, an anchor in the world, and encounters between them.

A session enters by its own optimum and the information there: its steps and loops are measured as they stand after its own
optimisation, so that they cost nothing until an encounter pulls. Encounters connect two poses and two anchors (Kim et al., ICRA
2010) and are the only residuals that may be outliers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_quantile
from boxplus.manifolds import se3
from boxplus.manifolds.se3 import SE3
from boxplus.optimization.losses import Squared
from boxplus.optimization.outliers.graduated import graduate
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.solver_options import SolverOptions
from boxplus.residuals.anchored_pose import AnchoredRelativePose
from boxplus.residuals.gravity_direction import GravityDirection
from boxplus.residuals.prior import Prior
from boxplus.residuals.relative_pose import RelativePose
from boxplus.systems.sessions.encounter import Encounter
from boxplus.systems.sessions.session import Session
from boxplus.systems.slam.graph import vertical_sigmas
from boxplus.systems.slam.loop import Floats

_INLIER = 0.999  # of true encounters within the threshold
_DAMPING = 1e-9
_STRETCH = 0.005  # of a session, to see how its cost grows
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class JoinedGraph:
    """Where the sessions are.

    Attributes:
        T_world_session: (s, 7) anchors; covariance: (s, 6, 6) on their right, of the first zero.
        T_world_map: for each session (n, 7), its local maps.
        is_kept: (encounters,) which of them the result rests on; errors: what each is off by, in standard deviations.
        scale: (s, 2) what each session's lengths would be multiplied by to fit the others best, and its standard deviation; 1 and
            0 of the first one.
    """

    T_world_session: Floats
    covariance: Floats
    T_world_map: list[Floats]
    is_kept: NDArray[np.bool_]
    errors: Floats
    scale: Floats


def join(sessions: Sequence[Session], encounters: Sequence[Encounter], T_start: Floats, gravity_sigma: float) -> JoinedGraph:
    """Minimise over poses and anchors; the first session's frame is the world.

    Args:
        encounters: at least one, numbers of sessions as in `sessions`; all sessions connected.
        T_start: (s, 7) anchors to start from.
    """
    graph = _Graph(sessions, encounters, T_start, gravity_sigma)
    kept, solution = graph.solve()
    anchors = solution[graph.anchors]
    ends = np.cumsum([len(session.maps) for session in sessions])[:-1]
    within = np.split(solution[graph.poses], ends)
    scales = [_scale_of(k, sessions, encounters, anchors, gravity_sigma, kept) for k in range(1, len(sessions))]
    return JoinedGraph(
        anchors,
        solution.covariance(graph.anchors[np.arange(len(sessions))]),
        [se3.compose(np.broadcast_to(A, T.shape), T) for A, T in zip(anchors, within, strict=True)],
        kept,
        np.sqrt(graph.encounters.squares(solution.values)),
        np.array([(1.0, 0.0), *scales]),
    )


def _scale_of(
    number: int,
    sessions: Sequence[Session],
    encounters: Sequence[Encounter],
    T_start: Floats,
    gravity_sigma: float,
    kept: NDArray[np.bool_],
) -> tuple[float, float]:
    """The scale of a session against the others, and its standard deviation: where the least cost is, and how fast it grows.

    With a scale s of the session alone, whatever else is free takes its best value, and the cost is a parabola about its minimum:
    c(s) = c₀ + (s − ŝ)² / 2σ² (profile likelihood), told by three values of it.
    """
    cost = []
    for scale in (1.0 - _STRETCH, 1.0, 1.0 + _STRETCH):
        own = sessions[number]
        T = own.T_session_map.copy()
        T[:, 4:] *= scale
        stretched = [*sessions[:number], replace(own, T_session_map=T), *sessions[number + 1 :]]
        cost.append(_Graph(stretched, encounters, T_start, gravity_sigma).cost(kept))
    curvature = (cost[0] - 2.0 * cost[1] + cost[2]) / _STRETCH**2
    if curvature <= 0.0:
        return 1.0, math.inf
    return 1.0 - 0.5 * (cost[2] - cost[0]) / (_STRETCH * curvature), 1.0 / math.sqrt(curvature)


class _Graph:
    def __init__(
        self, sessions: Sequence[Session], encounters: Sequence[Encounter], T_start: Floats, gravity_sigma: float
    ) -> None:
        self.problem = problem = Problem()
        counts = [len(session.maps) for session in sessions]
        first = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
        poses = np.concatenate([session.T_session_map for session in sessions])
        self.poses = x = problem.add_variables(SE3, poses, name="poses")
        self.anchors = A = problem.add_variables(SE3, T_start, name="anchors")
        steps = np.concatenate([begin + np.arange(count - 1) for begin, count in zip(first, counts, strict=True)]).astype(
            np.int64
        )
        if len(steps):
            covariance = np.concatenate([np.stack([m.covariance for m in s.maps])[1:] for s in sessions if len(s.maps) > 1])
            measured = se3.compose(se3.inverse(poses[steps]), poses[steps + 1])
            problem.add_residuals(RelativePose(measured, covariance=covariance), x[steps], x[steps + 1], name="odometry")
        for number, (session, begin, count) in enumerate(zip(sessions, first, counts, strict=True)):
            sigma = vertical_sigmas(session.T_session_map, gravity_sigma)
            vertical = GravityDirection(np.tile(_UP, (count, 1)), session.up, sigma=sigma)
            problem.add_residuals(vertical, x[begin + np.arange(count)], name=f"gravity_{number}")
            if session.loops:
                i, j = begin + np.array([[loop.place, loop.query] for loop in session.loops]).T
                own = RelativePose(
                    se3.compose(se3.inverse(poses[i]), poses[j]), information=np.stack([k.information for k in session.loops])
                )
                problem.add_residuals(own, x[i], x[j], name=f"loops_{number}")
        if len(sessions) > 1:
            ups = np.stack([session.up for session in sessions])
            level = GravityDirection(ups[1:], ups[0], sigma=gravity_sigma)
            problem.add_residuals(level, A[np.arange(1, len(sessions))], name="level")
        residual = AnchoredRelativePose(
            np.stack([e.loop.T_place_query for e in encounters]), information=np.stack([e.loop.information for e in encounters])
        )
        a, i, b, j = np.array(
            [
                (e.place_session, first[e.place_session] + e.loop.place, e.query_session, first[e.query_session] + e.loop.query)
                for e in encounters
            ]
        ).T
        self.encounters = problem.add_residuals(residual, A[a], x[i], A[b], x[j], name="encounters")
        problem.fix(A[0:1])
        for session, begin in zip(sessions, first, strict=True):
            if session.start_covariance.any():
                start = Prior(SE3, poses[begin], covariance=session.start_covariance)
                problem.add_residuals(start, x[begin : begin + 1], name=f"start_{session.name}")
            else:
                problem.fix(x[begin : begin + 1])

    def solve(self) -> tuple[NDArray[np.bool_], Solution]:
        """Which encounters are kept, and the minimum with them."""
        options = SolverOptions(initial_damping=_DAMPING)
        threshold = math.sqrt(chi_square_quantile(_INLIER, 6))
        found = graduate(self.problem, self.encounters, loss="truncated", inlier_threshold=threshold, options=options)
        self.encounters.set_loss(Squared())
        kept = found.inliers["encounters"]
        self.problem.set_weights(self.encounters, kept.astype(np.float64))
        return kept, self.problem.solve(options, start=found.solution)

    def cost(self, kept: NDArray[np.bool_]) -> float:
        """The least cost with some of the encounters."""
        self.problem.set_weights(self.encounters, kept.astype(np.float64))
        return self.problem.solve(SolverOptions(initial_damping=_DAMPING)).cost
