"""A finished run of LiDAR-inertial odometry, refined: all poses, planes and IMU samples at once (docs/refinement.md).

In every round planes are found anew in the map as it then is; then

1. keyframes, each with the scans around it in its frame, move together with the planes, velocities, biases, the direction of
   gravity and, where the motion shows it, the mounting of the LiDAR, which is where drift goes;
2. every scan moves by itself, on the planes that were found, held by the IMU to its neighbours, which is where jitter goes.

A plane and a pose meet in a 4 × 4 matrix, so that no step depends on the number of points.

Source: Liu, Liu and Zhang, BALM2, TRO 2023; Liu, Liu, Yuan et al., HBA, RA-L 2023 (levels); Forster et al., TRO 2017 (IMU).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se3, so3
from boxplus.manifolds.body_pose import BodyPose
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.sphere import S2
from boxplus.maps.plane_voxels.plane_map import PlaneMap
from boxplus.maps.plane_voxels.thickness import Sharpness
from boxplus.optimization.problem import Problem
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals.inertial.imu import ImuPreintegration
from boxplus.residuals.planes.plane_cluster import Plane, PlaneCluster
from boxplus.residuals.planes.pose_quadratic import PoseQuadratic
from boxplus.residuals.prior import Prior
from boxplus.systems.refinement.config import RefinementConfig
from boxplus.systems.refinement.finished_run import FinishedRun
from boxplus.systems.refinement.inertial import preintegrated
from boxplus.systems.refinement.keyframes import Keyframes, choose_keyframes
from boxplus.systems.refinement.sightings import KeyframeClusters, judge, keyframe_clusters, lidar_poses, planes_of, scan_forms
from boxplus.systems.slam.correction import Correction

Floats = NDArray[np.float64]

_GRAVITY = 9.81
_FEWEST_PLANES = 6
_SECOND_AXIS = 0.1  # rad/s
_MARGIN = 5.0  # of the noise that the odometry assumes, over that of the samples
_BIAS_SIGMA = np.array([0.3] * 3 + [0.03] * 3)  # m/s², rad/s, of the first keyframe


@dataclass(frozen=True, slots=True, eq=False)
class RefinedState:
    """Everything that is estimated, for N scans.

    Attributes:
        T_world_imu: (N, 7); velocity_bias: (N, 9), as in `FinishedRun`.
        gravity_direction: (3,) unit vector, down.
        T_imu_lidar: (7,).
    """

    T_world_imu: Floats
    velocity_bias: Floats
    gravity_direction: Floats
    T_imu_lidar: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """What came of it.

    Attributes:
        before, after: the states.
        pose_covariance: (N, 6, 6) of the poses after, [θ, p], relative to the first one.
        sharpness: of the map of points that took no part, before and after.
        keyframes, planes: how many.
        costs: (rounds, 2) of the keyframes' problem, at its begin and end.
        extrinsic: whether the mounting was refined, and why, in words.
    """

    before: RefinedState
    after: RefinedState
    pose_covariance: Floats
    sharpness: tuple[Sharpness, Sharpness]
    keyframes: int
    planes: int
    costs: Floats
    extrinsic: str

    @property
    def refusal(self) -> str | None:
        """Why it is not to be believed: the points that took no part lie farther from their planes than before."""
        before, after = self.sharpness
        if not (np.isfinite(self.after.T_world_imu).all() and np.isfinite(self.pose_covariance).all()):
            return "the optimisation did not come to finite poses"
        if not before.points:
            return "no plane holds enough of the points that were kept for judging"
        if not after.thickness < before.thickness:
            return "the points that took no part lie farther from their planes than before"
        return None


def refine(
    run: FinishedRun, config: RefinementConfig | None = None, progress: Callable[[str, float], None] | None = None
) -> Refinement:
    """Refine a finished run.

    Args:
        run: at least two keyframes long.
        config: settings; each has a default.
        progress: called with what is being done and the share that is done.

    Raises:
        InputError: hardly any plane is seen by two keyframes.
    """
    config = config or RefinementConfig()
    tell = progress or (lambda stage, share: None)
    g = run.gravity_world / np.linalg.norm(run.gravity_world)
    before = state = RefinedState(run.T_world_imu, run.velocity_bias, g, run.T_imu_lidar)
    keyframes = choose_keyframes(run.time_ns, run.T_world_imu, config)
    refines_mounting, extrinsic = _mounting_is_refined(run, config)
    tell("finding planes", 0.0)
    T_lidar = T_before = lidar_poses(state.T_world_imu, state.T_imu_lidar)
    planes, information = planes_of(run, T_lidar, keyframes, config)
    judging = planes
    costs = []
    for number in range(config.rounds):
        if number:
            tell("finding planes", number / config.rounds)
            T_lidar = lidar_poses(state.T_world_imu, state.T_imu_lidar)
            planes, information = planes_of(run, T_lidar, keyframes, config)
        seen = keyframe_clusters(run, T_lidar, keyframes, planes, information)
        tell("moving keyframes", (number + 0.4) / config.rounds)
        is_last = number + 1 == config.rounds
        state, planes, is_held, cost, covariance = _move_keyframes(
            run, state, keyframes, planes, seen, config, refines_mounting, is_last
        )
        tell("moving scans", (number + 0.6) / config.rounds)
        state, own = _move_scans(run, state, planes, np.where(is_held, information, 0.0), config, is_last)
        costs.append(cost)
    own = own + _bending(run)
    tell("judging", 1.0)
    T_after = lidar_poses(state.T_world_imu, state.T_imu_lidar)
    return Refinement(
        before=before,
        after=_anchored(state, before.T_world_imu[0]),
        pose_covariance=_relative_to_first(state.T_world_imu, covariance + own, own[0]),
        sharpness=judge(run, T_before, T_after, judging),
        keyframes=len(keyframes),
        planes=int(np.count_nonzero(is_held)),
        costs=np.array(costs),
        extrinsic=extrinsic,
    )


def _mounting_is_refined(run: FinishedRun, config: RefinementConfig) -> tuple[bool, str]:
    """Whether the mounting of the LiDAR is refined, and why."""
    if config.extrinsic_estimation == "off":
        return False, "held, as extrinsic_estimation says"
    rates = run.imu.gyro - run.velocity_bias[:, 6:].mean(axis=0)
    second = float(np.sqrt(np.linalg.eigvalsh(rates.T @ rates / len(rates))[1]))
    text = f"the body turned about a second axis at {second:.2f} rad/s (root mean square)"
    if config.extrinsic_estimation == "on":
        return True, f"refined, as extrinsic_estimation says; {text}"
    if second < _SECOND_AXIS:
        return False, f"held: {text}, and {_SECOND_AXIS:g} would be needed to tell it"
    return True, f"refined: {text}"


def _anchored(state: RefinedState, first: Floats) -> RefinedState:
    """The same with the first pose where it was: the world is that of the filter."""
    move = se3.compose(first, se3.inverse(state.T_world_imu[0]))
    R = quaternion.to_matrix(move[:4])
    T = se3.compose(np.broadcast_to(move, state.T_world_imu.shape), state.T_world_imu)
    velocity_bias = np.hstack([state.velocity_bias[:, :3] @ R.T, state.velocity_bias[:, 3:]])
    return replace(state, T_world_imu=T, velocity_bias=velocity_bias, gravity_direction=R @ state.gravity_direction)


def _bending(run: FinishedRun) -> Floats:
    """Covariances (N, 6, 6) of what the gyroscope's own noise turns the points of a slice by, on the mean, about its pose."""
    seconds = np.diff(run.time_ns, prepend=run.time_ns[0]) * 1e-9
    seconds[0] = seconds[1]
    covariance = np.zeros((len(run), 6, 6))
    turn = (run.noise.gyro / _MARGIN) ** 2 * seconds / 12.0  # half of the points on either side
    covariance[:, np.arange(3), np.arange(3)] = turn[:, None]
    return covariance


def _relative_to_first(T: Floats, covariance: Floats, first: Floats) -> Floats:
    """Covariances (N, 6, 6) relative to the first scan: what that one is off by, (6, 6), moves and turns all others."""
    R = quaternion.to_matrix(T[:, :4])
    J = np.zeros((len(T), 6, 6))
    J[:, :3, :3] = np.swapaxes(R, 1, 2) @ R[0]
    J[:, 3:, :3] = -so3.hat(T[:, 4:] - T[0, 4:]) @ R[0]
    J[:, 3:, 3:] = np.eye(3)
    relative: Floats = covariance + J @ first @ np.swapaxes(J, 1, 2)
    relative[0] = 0.0
    return relative


def _move_keyframes(
    run: FinishedRun,
    state: RefinedState,
    keyframes: Keyframes,
    map_: PlaneMap,
    seen: KeyframeClusters,
    config: RefinementConfig,
    refines_mounting: bool,
    is_last: bool,
) -> tuple[RefinedState, PlaneMap, NDArray[np.bool_], tuple[float, float], Floats]:
    """Keyframes, planes, velocities, biases, gravity and mounting at once; every scan follows its keyframes."""
    T, at = state.T_world_imu, keyframes.scan
    numbers, plane = np.unique(seen.plane, return_inverse=True)
    if len(numbers) < _FEWEST_PLANES:
        raise InputError(
            f"{_FEWEST_PLANES} planes at least that two keyframes see", f"{len(numbers)}", "nothing can be refined here"
        )
    problem = Problem()
    poses = problem.add_variables(BodyPose, T[at], name="keyframes")
    states = problem.add_variables(Euclidean(9), state.velocity_bias[at], name="velocity_bias")
    down = problem.add_variables(S2, state.gravity_direction, name="gravity_direction")
    lidar = problem.add_variables(BodyPose, state.T_imu_lidar, name="T_imu_lidar")
    planes = problem.add_variables(Plane, map_.planes[numbers], name="planes")
    imu = ImuPreintegration(preintegrated(run, at, state.velocity_bias), gravity=(0.0, 0.0, -_GRAVITY), gravity_direction=True)
    problem.add_residuals(imu, poses[:-1], states[:-1], poses[1:], states[1:], down, name="imu")
    clusters = PlaneCluster(seen.clusters, map_.centres[seen.plane])
    problem.add_residuals(clusters, poses[seen.keyframe], lidar, planes[plane], name="planes")
    _add_bias_prior(problem, states)
    problem.fix(poses[:1])
    if refines_mounting:
        sigma = [np.deg2rad(config.extrinsic_rotation_sigma_deg)] * 3 + [config.extrinsic_translation_sigma] * 3
        problem.add_residuals(Prior(BodyPose, run.T_imu_lidar, sigma=sigma), lidar, name="T_imu_lidar as it was")
    else:
        problem.fix(lidar)
    solution = problem.solve(
        linear_solver="schur", max_iterations=config.max_iterations, cost_tolerance=1e-7, threads=config.threads, examine=False
    )
    T_new = Correction(run.time_ns[at], T[at], solution[poses]).apply(run.time_ns, T)
    turned = quaternion.to_matrix(T_new[:, :4]) @ np.swapaxes(quaternion.to_matrix(T[:, :4]), 1, 2)
    velocity = np.einsum("nij,nj->ni", turned, state.velocity_bias[:, :3])
    seconds, key_seconds = (run.time_ns - run.time_ns[0]) * 1e-9, (run.time_ns[at] - run.time_ns[0]) * 1e-9
    biases = np.stack([np.interp(seconds, key_seconds, solution[states][:, k]) for k in range(3, 9)], axis=1)
    covariance = np.zeros((len(run), 6, 6))
    if is_last:
        own = solution.covariance(poses)
        for a in range(6):
            for b in range(6):
                covariance[:, a, b] = np.interp(seconds, key_seconds, own[:, a, b])
    all_planes = map_.planes.copy()
    all_planes[numbers] = solution[planes]
    is_held = np.zeros(len(map_), dtype=np.bool_)
    is_held[numbers] = True
    after = RefinedState(T_new, np.hstack([velocity, biases]), solution[down][0], solution[lidar][0])
    return after, replace(map_, planes=all_planes), is_held, (solution.cost_initial, solution.cost), covariance


def _move_scans(
    run: FinishedRun, state: RefinedState, planes: PlaneMap, information: Floats, config: RefinementConfig, is_last: bool
) -> tuple[RefinedState, Floats]:
    """Every scan by itself on the planes, which are held, and between its neighbours in time."""
    problem = Problem()
    poses = problem.add_variables(BodyPose, state.T_world_imu, name="scans")
    states = problem.add_variables(Euclidean(9), state.velocity_bias, name="velocity_bias")
    between = preintegrated(run, np.arange(len(run)), state.velocity_bias)
    imu = ImuPreintegration(between, gravity=_GRAVITY * state.gravity_direction)
    problem.add_residuals(imu, poses[:-1], states[:-1], poses[1:], states[1:], name="imu")
    forms = scan_forms(run, state.T_world_imu, state.T_imu_lidar, planes, information)
    problem.add_residuals(PoseQuadratic(forms, state.T_world_imu[:, 4:]), poses, name="planes")
    _add_bias_prior(problem, states)
    solution = problem.solve(
        linear_solver="sparse", max_iterations=config.max_iterations, cost_tolerance=1e-7, threads=config.threads, examine=False
    )
    covariance = solution.covariance(poses) if is_last else np.zeros((len(run), 6, 6))
    return replace(state, T_world_imu=solution[poses], velocity_bias=solution[states]), covariance


def _add_bias_prior(problem: Problem, states: Variables) -> None:
    """What is known of the biases at the begin, and nothing of the velocity."""
    information = np.diag(np.concatenate([np.full(3, 1e-6), _BIAS_SIGMA**-2]))
    problem.add_residuals(Prior(Euclidean(9), np.zeros(9), information=information), states[:1], name="biases")
