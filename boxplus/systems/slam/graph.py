"""The pose graph of local maps: odometry that is never an outlier, loops that may be, and the vertical of each map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_quantile
from boxplus.manifolds import quaternion, se3
from boxplus.manifolds.se3 import SE3
from boxplus.optimization.losses import Squared
from boxplus.optimization.outliers.graduated import graduate
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.solver_options import SolverOptions
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals.gravity_direction import GravityDirection
from boxplus.residuals.relative_pose import RelativePose
from boxplus.systems.slam.loop import Floats, Loop

_LOOPS = "loops"
_INLIER = 0.999  # of true loops within the threshold
_DAMPING = 1e-9
_NARROWING = 2.0  # from width to width: what is graduated has been held against each other before, and 1.4 takes twice as long
_VERTICAL_LENGTH = 100.0  # m of way over which the verticals of local maps are one measurement


@dataclass(frozen=True, slots=True, eq=False)
class ClosedGraph:
    """Poses of the local maps in the map.

    Attributes:
        T_map: (n, 7).
        is_kept: (loops,) which loops the result rests on.
        errors: (loops,) what each of them is off by at the result, in standard deviations.
        solution: with history and covariance of the block `poses`.
        poses: that block.
    """

    T_map: Floats
    is_kept: NDArray[np.bool_]
    errors: Floats
    solution: Solution
    poses: Variables

    def covariances(self) -> tuple[Floats, Floats]:
        """Of each pose, against the first one, (n, 6, 6) on its right; and of each with the one after it, (n − 1, 6, 6)."""
        x, n = self.poses, len(self.T_map)
        steps = np.arange(n - 1)
        return self.solution.covariance(x), self.solution.covariance(x[steps], x[steps + 1])


@dataclass(frozen=True, slots=True, eq=False)
class MapGraph:
    """The local maps of an odometry and what holds them together.

    Attributes:
        time_ns: (n,) of the maps. T_odo: (n, 7) along the odometry; T_map: (n, 7) with loops closed.
        covariances: (n, 6, 6) of each in the one before. loops: those that are believed.
        gravity_sigma: of the vertical of a local map [rad].
    """

    time_ns: NDArray[np.int64]
    T_odo: Floats
    T_map: Floats
    covariances: Floats
    loops: Sequence[Loop] = ()
    gravity_sigma: float = 0.005


def open_graph(T_odo: Sequence[Floats], covariances: Sequence[Floats], gravity_sigma: float) -> tuple[Problem, Variables]:
    """Poses of local maps along the odometry, each with its vertical, the first held where it is; arguments as `close_graph`."""
    poses = np.stack(T_odo)
    steps = np.arange(len(poses) - 1)
    problem = Problem()
    x = problem.add_variables(SE3, poses, name="poses")
    if len(steps):
        measured = se3.compose(se3.inverse(poses[:-1]), poses[1:])
        problem.add_residuals(
            RelativePose(measured, covariance=np.stack(covariances)[1:]), x[steps], x[steps + 1], name="odometry"
        )
    # Every map's z axis is its own measurement of the vertical; their mean is that of the odometry's world.
    sigma = vertical_sigmas(poses, gravity_sigma)
    vertical = GravityDirection(np.tile([0.0, 0.0, 1.0], (len(poses), 1)), mean_up(poses), sigma=sigma)
    problem.add_residuals(vertical, x, name="gravity")
    problem.fix(x[0:1])
    return problem, x


def vertical_sigmas(T_odo: Floats, gravity_sigma: float) -> Floats:
    """(n, 2) standard deviations of the verticals of local maps at poses (n, 7) along an odometry [rad].

    Verticals are the odometry's own, and their errors are its errors: successive maps share them. All maps within 100 m of way,
    after which a tilt that walks at random (`drift_rotation`) has come to `gravity_sigma`, weigh as much as one that stands
    alone; each by itself they would make tilts seem known by the root of their number.
    """
    step = np.linalg.norm(np.diff(T_odo[:, 4:], axis=0), axis=1)
    between = 0.5 * (np.append(step, step[-1:]) + np.insert(step, 0, step[:1])) if len(step) else np.full(1, np.inf)
    sharing = np.maximum(_VERTICAL_LENGTH / np.maximum(between, 1e-3 * _VERTICAL_LENGTH), 1.0)
    return np.repeat((gravity_sigma * np.sqrt(sharing))[:, None], 2, axis=1)


def add_loops(problem: Problem, x: Variables, loops: Sequence[Loop], name: str) -> Group:
    """The measurements of loops between poses of `open_graph`."""
    i, j = np.array([[loop.place, loop.query] for loop in loops]).T
    Z, information = (np.stack([getattr(loop, what) for loop in loops]) for what in ("T_place_query", "information"))
    return problem.add_residuals(RelativePose(Z, information=information), x[i], x[j], name=name)


def mean_up(T_odo: Floats) -> Floats:
    """(3,) the vertical of the odometry's world, from poses (n, 7) of level maps."""
    up = quaternion.to_matrix(T_odo[:, :4])[:, :, 2].mean(axis=0)
    return np.asarray(up / np.linalg.norm(up))


def close_graph(
    T_odo: Sequence[Floats],
    covariances: Sequence[Floats],
    loops: Sequence[Loop],
    gravity_sigma: float,
    forced: Sequence[bool] = (),
) -> ClosedGraph:
    """Minimise over the poses of local maps, the first held where it is.

    Truncated least squares by graduated non-convexity on the loops alone (Yang, Antonante, Tzoumas and Carlone, RA-L 2020); the
    odometry, which holds everything together, is heard first.

    Args:
        T_odo: n poses (7,) along the odometry.
        covariances: n of (6, 6), that of each pose in the one before; the first is not looked at.
        loops: at least one; `forced` ones are believed whatever they say.
    """
    problem, x = open_graph(T_odo, covariances, gravity_sigma)
    is_forced = np.array(forced, dtype=np.bool_) if len(forced) else np.zeros(len(loops), dtype=np.bool_)
    rows = {"forced": np.flatnonzero(is_forced), _LOOPS: np.flatnonzero(~is_forced)}
    groups = {}
    for name, own in rows.items():
        if len(own):
            chosen = [loops[k] for k in own.tolist()]
            groups[name] = add_loops(problem, x, chosen, name)
    options = SolverOptions(initial_damping=_DAMPING)
    is_kept = np.ones(len(loops), dtype=np.bool_)
    if _LOOPS in groups:
        group = groups[_LOOPS]
        dof = np.array([loops[k].measured for k in rows[_LOOPS].tolist()])
        found = graduate(
            problem,
            group,
            loss="truncated",
            inlier_threshold=_threshold(int(dof.max())),
            weights={_LOOPS: np.zeros(len(dof))},
            narrowing=_NARROWING,
            options=options,
        )
        group.set_loss(Squared())
        kept = found.inliers[_LOOPS]
        problem.set_weights(group, kept.astype(np.float64))
        is_kept[rows[_LOOPS]] = kept
        solution = problem.solve(options, start=found.solution)
    else:
        solution = problem.solve(options)
    errors = np.zeros(len(loops))
    for name, group in groups.items():
        errors[rows[name]] = np.sqrt(group.squares(solution.values))
    return ClosedGraph(solution[x], is_kept, errors, solution, x)


def _threshold(dof: int) -> float:
    return math.sqrt(chi_square_quantile(_INLIER, dof))
