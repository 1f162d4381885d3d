"""Poses of local maps, georeference, lever arm and delay in one graph; outliers by truncated least squares."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_quantile
from boxplus.manifolds import quaternion, se3, so3
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.se3 import SE3
from boxplus.manifolds.upright_rotation import upright_rotation
from boxplus.optimization.losses import Squared
from boxplus.optimization.outliers.graduated import graduate
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.solver_options import SolverOptions
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals.antenna_position import AntennaPosition
from boxplus.residuals.gravity_direction import GravityDirection
from boxplus.residuals.prior import Prior
from boxplus.residuals.relative_pose import RelativePose
from boxplus.systems.georeference.attachment import AttachedFixes
from boxplus.systems.georeference.config import GeoreferenceConfig
from boxplus.systems.georeference.shifts import Shifts
from boxplus.systems.slam.graph import MapGraph, add_loops, mean_up, open_graph

Floats = NDArray[np.float64]

_DAMPING = 1e-9
_MEDIAN_SQUARE = 2.366  # of a normal vector of three
_MEDIAN_ON_GROUND = 1.386  # of one of two
_QUARTER, _UPPER_SQUARE = 0.75, 1.323  # of a normal number: where a map lies at one of two heights, half of the others fit
_HEIGHTS_APART = 3.0  # times what places scatter by, and as many as they claim: heights are then believed less by themselves
_ROUNDS = 4
_SETTLED = 1.1
OFF_SIGMAS = 3.0
_LEAST_OFF = 0.1  # m: less is no reason to distrust a map
_HERE = np.array([[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
_SHIFTED = np.diag(np.repeat([1e-6, 100.0], 3) ** 2)[None]  # rad, m: of one datum in another


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """What the graph with fixes came to.

    Attributes:
        T_map: (n, 7) of the local maps. T_enu_map: (7,); covariance: (6, 6) of it, [w, v] on the right [rad, m].
        sigma: (n,) standard deviation of a horizontal axis of each map's position in ENU [m].
        lever: (3,) in the IMU's frame [m]; lever_sigma: (3,), zero where it was given.
        delay, delay_sigma: by which fixes are stamped late [s].
        is_used: (N,) which fixes the result rests on. errors: (N, 3) predicted less measured, east, north, up [m].
        fix_covariance: (N, 3, 3) of a fix as it was believed, beside those near to it in time [m²].
        noise_scale: factor of the standard deviations that the fixes needed, at least 1; height_scale: that of their heights
            beside it, where these scatter by far more than the places do, else 1.
        tension: mean square of the odometry's errors, in variances per direction; far below 1 where nothing bends it.
        datum_step: (3,) what the second datum is shifted by against the first, east, north, up [m]; zero where there is one.
        shifts: to ask what a shift of fixes would explain, if their datum is one.
    """

    T_map: Floats
    T_enu_map: Floats
    covariance: Floats
    sigma: Floats
    lever: Floats
    lever_sigma: Floats
    delay: float
    delay_sigma: float
    is_used: NDArray[np.bool_]
    errors: Floats
    fix_covariance: Floats
    noise_scale: float
    height_scale: float
    tension: float
    datum_step: Floats
    shifts: Shifts

    @property
    def gated(self) -> list[tuple[int, int]]:
        """Stretches [begin, end) of successive fixes that are not used."""
        edges = np.flatnonzero(np.diff(np.concatenate([[True], self.is_used, [True]]).astype(np.int8)))
        return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]

    @property
    def p_enu_map(self) -> Floats:
        """(n, 3) where the local maps are, in the first datum [m]."""
        return np.asarray(se3.compose(self.T_enu_map, self.T_map)[:, 4:])

    def is_off(self, metres: float) -> bool:
        """Whether a map that is off by so much on the ground is so by more than it claims, and by more than matters."""
        return metres > max(OFF_SIGMAS * float(np.median(self.sigma)), _LEAST_OFF)


def level(T_odo: Floats) -> Floats:
    """(3, 3) rotation that turns the vertical of an odometry's world upright, without yaw."""
    return upright_rotation(mean_up(T_odo))


def fit(
    graph: MapGraph,
    attached: AttachedFixes,
    p_enu: Floats,
    T_enu_map: Floats,
    believed: NDArray[np.bool_],
    lever: Floats | None,
    config: GeoreferenceConfig,
    after: NDArray[np.bool_] | None = None,
) -> Fit:
    """Minimise over everything, from a start.

    Errors of fixes stay for tens of seconds, so that fixes nearer to each other than that count as one together: standard
    deviations are multiplied by √(correlation/spacing). The threshold of outliers is divided by it: a fix is judged by its own.
    Beside its own noise there is what the odometry drifted from the local map to it, which is the same for all fixes made there:
    where the antenna stands for longer than that, they count as one.

    Args:
        attached: N fixes, p_enu: (N, 3) where they are. T_enu_map: (7,) the start, believed: (N,) the fixes it rests on.
        lever: (3,) given; None: estimated about zero.
        after: (N,) the fixes in another datum, which is shifted by what fits best; none if left out.
    """
    datum = np.zeros(len(attached), dtype=np.intp) if after is None else after.astype(np.intp)
    datums = 1 if after is None else 2
    spacing = float(np.median(np.diff(attached.time_ns))) * 1e-9
    inflation = math.sqrt(max(config.correlation / spacing, 1.0))
    threshold = math.sqrt(chi_square_quantile(config.inlier, 3))
    lasts = np.bincount(attached.half_of)[attached.half_of] / inflation**2
    of_odometry = (inflation**2 * attached.drift**2 * np.maximum(lasts, 1.0))[:, None, None] * np.eye(3)
    noise_scale = height_scale = 1.0
    arm_start = np.zeros((1, 3)) if lever is None else lever[None]
    start = [graph.T_map, np.repeat(T_enu_map[None], datums, axis=0), arm_start, np.zeros((1, 1))]
    for _ in range(_ROUNDS):
        problem, x = open_graph(list(graph.T_odo), list(graph.covariances), graph.gravity_sigma)
        if graph.loops:
            add_loops(problem, x, graph.loops, "loops")
        world = problem.add_variables(SE3, start[1], name="T_enu_map")
        arm = problem.add_variables(Euclidean(3), start[2], name="lever arm")
        delay = problem.add_variables(Euclidean(1), start[3], name="delay")
        problem.add_residuals(GravityDirection([mean_up(graph.T_odo)], sigma=graph.gravity_sigma), world[:1], name="vertical")
        if after is not None:
            same_turn = RelativePose(_HERE, covariance=_SHIFTED)
            problem.add_residuals(same_turn, world[:1], world[1:], name="step of the datum")
        problem.add_residuals(Prior(Euclidean(1), [0.0], sigma=config.delay_sigma), delay, name="delay")
        if lever is None:
            problem.add_residuals(Prior(Euclidean(3), np.zeros(3), sigma=config.lever_sigma), arm, name="lever arm")
        else:
            problem.fix(arm)
        axes = inflation * noise_scale * np.array([1.0, 1.0, height_scale])
        covariance = axes[:, None] * attached.covariance * axes + of_odometry
        residual = AntennaPosition(p_enu, attached.T_map_imu, attached.v_map, covariance=covariance)
        every = np.zeros(len(attached), dtype=np.intp)
        fixes = problem.add_residuals(residual, world[datum], x[attached.map_of], arm[every], delay[every], name="fixes")
        options = SolverOptions(initial_damping=_DAMPING)
        found = graduate(
            problem, fixes, loss="truncated", inlier_threshold=threshold / inflation,
            weights={"fixes": believed.astype(np.float64)}, options=options, start=start,
        )  # fmt: skip
        used = found.inliers["fixes"]
        squares = fixes.squares(found.solution.values) * inflation**2
        T_enu, T_map, lever_now, late = (found.solution[own] for own in (world, x, arm, delay))
        errors = residual.evaluate(T_enu[datum], T_map[attached.map_of], lever_now[0], late[0])[believed]
        on_ground, of_height = _scatter(errors, covariance[believed] / inflation**2)
        if of_height > _HEIGHTS_APART * max(on_ground, 1.0):  # of another reference, say; the places are good all the same
            height_scale *= of_height / max(on_ground, 1.0)
            continue
        # Of those the start rests on, not of those that were kept: what is cut off at a threshold always looks quiet.
        scatter = math.sqrt(float(np.median(squares[believed])) / _MEDIAN_SQUARE)
        if scatter <= _SETTLED:
            break
        noise_scale *= scatter
    fixes.set_loss(Squared())
    problem.set_weights(fixes, used.astype(np.float64))
    solution = problem.solve(options, start=found.solution)
    return _result(
        solution, problem, x, (world, arm, delay), residual, attached, datum, used, covariance, (noise_scale, height_scale)
    )


def _scatter(errors: Floats, covariance: Floats) -> tuple[float, float]:
    """By how many of their standard deviations errors (N, 3) scatter, on the ground and in height."""
    ground = np.linalg.solve(covariance[:, :2, :2], errors[:, :2, None])[..., 0]
    squares, of_height = np.einsum("na,na->n", errors[:, :2], ground), errors[:, 2] ** 2 / covariance[:, 2, 2]
    return (
        math.sqrt(float(np.median(squares)) / _MEDIAN_ON_GROUND),
        math.sqrt(float(np.quantile(of_height, _QUARTER)) / _UPPER_SQUARE),
    )


def _result(
    solution: Solution,
    problem: Problem,
    x: Variables,
    others: tuple[Variables, Variables, Variables],
    residual: AntennaPosition,
    attached: AttachedFixes,
    datum: NDArray[np.intp],
    used: NDArray[np.bool_],
    fix_covariance: Floats,
    scales: tuple[float, float],
) -> Fit:
    world, arm, delay = others
    T_map, T_enu, lever = solution[x], solution[world], solution[arm][0]
    fixes = residual.linearize(T_enu[datum], T_map[attached.map_of], lever, solution[delay][0])
    of_world, of_map, of_arm, of_delay = fixes.jacobians
    one = np.zeros(len(attached), dtype=np.intp)
    odometry = [group for group in problem.groups if group.name == "odometry"]
    tension = float(np.mean(odometry[0].squares(solution.values))) / 6.0 if odometry else 0.0
    information = np.asarray(np.linalg.inv(fix_covariance) * used[:, None, None], dtype=np.float64)
    return Fit(
        T_map=T_map,
        T_enu_map=T_enu[0],
        covariance=solution.covariance(world)[0],
        sigma=_position_sigma(solution, x, world),
        lever=lever,
        lever_sigma=solution.standard_deviations(arm)[0],
        delay=float(solution[delay][0, 0]),
        delay_sigma=float(solution.standard_deviations(delay)[0, 0]),
        is_used=used,
        errors=fixes.residuals,
        fix_covariance=fix_covariance,
        noise_scale=scales[0],
        height_scale=scales[1],
        tension=tension,
        datum_step=T_enu[-1, 4:] - T_enu[0, 4:],
        shifts=Shifts(
            p_enu=residual.p_enu + fixes.residuals,
            errors=fixes.residuals,
            information=information,
            solution=solution,
            blocks=(x, world, arm, delay),
            jacobians=(of_map, of_world, of_arm, of_delay),
            rows=(attached.map_of, datum, one, one),
        ),
    )


def _position_sigma(solution: Solution, x: Variables, world: Variables) -> Floats:
    """In the first datum, of p = R₁ p₂ + p₁: ∂p/∂T_enu_map = [−R₁ [p₂]×  R₁], ∂p/∂T_map_k = [0  R₁ R₂]."""
    T, every = solution[x], np.zeros(len(solution[x]), dtype=np.intp)
    R1 = quaternion.to_matrix(solution[world][0, :4])
    R12 = R1 @ quaternion.to_matrix(T[:, :4])
    of_world = np.concatenate([-R1 @ so3.hat(T[:, 4:]), np.broadcast_to(R1, (len(T), 3, 3))], axis=2)
    of_map = np.concatenate([np.zeros((len(T), 3, 3)), R12], axis=2)
    own, between = solution.covariance(x), solution.covariance(world[every], x)
    cross = of_world @ between @ of_map.transpose(0, 2, 1)
    total = of_world @ solution.covariance(world)[0] @ of_world.transpose(0, 2, 1) + of_map @ own @ of_map.transpose(0, 2, 1)
    total = total + cross + cross.transpose(0, 2, 1)
    return np.asarray(np.sqrt(0.5 * np.maximum(total[:, 0, 0] + total[:, 1, 1], 0.0)))


def antennas(graph: MapGraph, attached: AttachedFixes, lever: Floats | None) -> Floats:
    """(N, 3) the antenna at each fix, in the map with loops closed."""
    T = se3.compose(graph.T_map[attached.map_of], attached.T_map_imu)
    arm = np.zeros(3) if lever is None else lever
    return np.asarray(T[:, 4:] + quaternion.to_matrix(T[:, :4]) @ arm)
