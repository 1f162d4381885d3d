"""Level one of refinement: keyframes, each with the scans around it in its frame, and everything that all of them share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.manifolds import quaternion
from boxplus.manifolds.body_pose import BodyPose
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.sphere import S2
from boxplus.maps.plane_voxels.plane_map import PlaneMap
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.solver_options import SolverOptions
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals.inertial.imu import ImuPreintegration
from boxplus.residuals.planes.plane_cluster import Plane, PlaneCluster
from boxplus.residuals.prior import Prior
from boxplus.systems.refinement.calibrated import Calibrated
from boxplus.systems.refinement.config import RefinementConfig
from boxplus.systems.refinement.counted_less import covariances_of
from boxplus.systems.refinement.finished_run import FinishedRun
from boxplus.systems.refinement.inertial import GRAVITY, add_bias_prior, preintegrated
from boxplus.systems.refinement.keyframes import Keyframes
from boxplus.systems.refinement.outside.evidence import Receiver
from boxplus.systems.refinement.outside.fixes import add_fixes
from boxplus.systems.refinement.outside.loops import KeyframeLoops, between_keyframes
from boxplus.systems.refinement.planes.sightings import KeyframeClusters
from boxplus.systems.refinement.state import RefinedState
from boxplus.systems.refinement.unshown import between, kept_steps
from boxplus.systems.slam.correction import Correction

Floats = NDArray[np.float64]

_FEWEST_PLANES = 6


@dataclass(frozen=True, slots=True, eq=False)
class MovedKeyframes:
    """What came of moving the keyframes.

    Attributes:
        state: with the scans behind their keyframes. planes: as moved; is_held: (P,) which of them took part.
        cost: at the begin and at the end.
        covariance: (N, 6, 6) of the poses, interpolated between keyframes; mounting_sigma: (6,) [rad, m]; both are zero unless
            they were asked for.
        time_offset_sigma: [s]; zero where it is held.
        loops: those of the run, None without; loop_errors: (L,) what they are off by at the end [standard deviations].
    """

    state: RefinedState
    planes: PlaneMap
    is_held: NDArray[np.bool_]
    cost: tuple[float, float]
    covariance: Floats
    mounting_sigma: Floats
    time_offset_sigma: float
    loops: KeyframeLoops | None
    loop_errors: Floats


@dataclass(frozen=True, slots=True)
class _Unknowns:
    poses: Variables
    states: Variables
    down: Variables
    lidar: Variables
    offset: Variables | None
    planes: Variables


def move_keyframes(
    run: FinishedRun,
    state: RefinedState,
    keyframes: Keyframes,
    map_: PlaneMap,
    seen: KeyframeClusters,
    config: RefinementConfig,
    free: Calibrated,
    *,
    with_covariance: bool,
) -> MovedKeyframes:
    """Keyframes, planes, velocities, biases, gravity and what is calibrated at once; every scan follows its keyframes.

    Raises:
        InputError: hardly any plane is seen by two keyframes.
    """
    numbers, plane = np.unique(seen.plane, return_inverse=True)
    if len(numbers) < _FEWEST_PLANES:
        raise InputError(
            f"{_FEWEST_PLANES} planes at least that two keyframes see", f"{len(numbers)}", "nothing can be refined here"
        )
    problem, x = _opened(run, state, keyframes, map_.planes[numbers], config, free)
    clusters = PlaneCluster(seen.clusters, map_.centres[seen.plane])
    on_planes = problem.add_residuals(clusters, x.poses[seen.keyframe], x.lidar, x.planes[plane], name="planes")
    held: dict[Group, Floats] = {}
    loops = None
    if run.loops is not None:
        loops = between_keyframes(run.loops, run.time_ns, state.T_world_imu, keyframes, map_, seen, state.T_imu_lidar)
        # One group of all of them, for what they are off by; of those that planes tell better the weight is zero.
        group = problem.add_residuals(loops.residual, x.poses[loops.place], x.poses[loops.query], name="loops", carry_over=True)
        held[group] = np.where(loops.is_told, 0.0, 1.0)
        problem.set_weights(group, held[group])
    pairs, open_ = between(keyframes.scan, run.open_steps)
    if len(pairs) and run.fixes is None:  # positions by satellite tell what the surroundings did not show
        as_they_were = kept_steps(run.T_world_imu, keyframes.scan[pairs], keyframes.scan[pairs + 1], open_)
        problem.add_residuals(as_they_were, x.poses[pairs], x.poses[pairs + 1], name="steps along what is open", carry_over=True)
    fixes = None if run.fixes is None else add_fixes(problem, x.poses, run.fixes, run.time_ns, state, keyframes)
    options = SolverOptions(
        linear_solver="schur", max_iterations=config.max_iterations, cost_tolerance=1e-7, threads=config.threads, examine=False
    )
    solution = problem.solve(options)
    covariance, sigma = np.zeros((len(run), 6, 6)), dict[Variables, Floats]()
    if with_covariance:
        blocks = [x.poses, x.lidar, *(() if x.offset is None else (x.offset,)), *(() if fixes is None else fixes.blocks)]
        # IMU, priors and the first pose, which is held, determine all but where a straight way lies on the Earth.
        counted, is_determined = {on_planes: seen.counted}, fixes is None
        own, *single = covariances_of(problem, solution, blocks, counted, held, options, is_determined=is_determined)
        covariance = _between(run, keyframes, own)
        sigma = {block: np.sqrt(np.diagonal(found[0])) for block, found in zip(blocks[1:], single, strict=True)}
    elif x.offset is not None:
        sigma = {x.offset: solution.standard_deviations(x.offset)[0]}
    all_planes = map_.planes.copy()
    all_planes[numbers] = solution[x.planes]
    is_held = np.zeros(len(map_), dtype=np.bool_)
    is_held[numbers] = True
    return MovedKeyframes(
        state=_followed(run, state, keyframes, solution, x, None if fixes is None else fixes.receiver(solution, sigma)),
        planes=replace(map_, planes=all_planes),
        is_held=is_held,
        cost=(solution.cost_initial, solution.cost),
        covariance=covariance,
        mounting_sigma=sigma.get(x.lidar, np.zeros(6)),
        time_offset_sigma=0.0 if x.offset is None else float(sigma[x.offset][0]),
        loops=loops,
        loop_errors=np.zeros(0) if loops is None else _errors(loops, solution[x.poses]),
    )


def _opened(
    run: FinishedRun, state: RefinedState, keyframes: Keyframes, planes: Floats, config: RefinementConfig, free: Calibrated
) -> tuple[Problem, _Unknowns]:
    """All variables, the IMU between keyframes and what was known before."""
    at = keyframes.scan
    problem = Problem()
    poses = problem.add_variables(BodyPose, state.T_world_imu[at], name="keyframes")
    states = problem.add_variables(Euclidean(9), state.velocity_bias[at], name="velocity_bias")
    down = problem.add_variables(S2, state.gravity_direction, name="gravity_direction")
    lidar = problem.add_variables(BodyPose, state.T_imu_lidar, name="T_imu_lidar")
    offset = None
    if free.time_offset:
        offset = problem.add_variables(Euclidean(1), [state.time_offset_s], name="time_offset")
        problem.add_residuals(Prior(Euclidean(1), [0.0], sigma=config.time_offset_sigma), offset, name="time offset as it was")
    imu = ImuPreintegration(
        preintegrated(run, at, state.velocity_bias, state.time_offset_s),
        gravity=(0.0, 0.0, -GRAVITY),
        gravity_direction=True,
        time_offset=free.time_offset,
        time_offset_s=state.time_offset_s,
    )
    shared = (down,) if offset is None else (down, offset)
    problem.add_residuals(imu, poses[:-1], states[:-1], poses[1:], states[1:], *shared, name="imu")
    add_bias_prior(problem, states)
    problem.fix(poses[:1])
    if free.mounting:
        sigma = [np.deg2rad(config.extrinsic_rotation_sigma_deg)] * 3 + [config.extrinsic_translation_sigma] * 3
        problem.add_residuals(Prior(BodyPose, run.T_imu_lidar, sigma=sigma), lidar, name="T_imu_lidar as it was")
    else:
        problem.fix(lidar)
    return problem, _Unknowns(poses, states, down, lidar, offset, problem.add_variables(Plane, planes, name="planes"))


def _followed(
    run: FinishedRun,
    state: RefinedState,
    keyframes: Keyframes,
    solution: Solution,
    x: _Unknowns,
    receiver: Receiver | None,
) -> RefinedState:
    """Every scan behind its keyframes, the correction interpolated on the way between."""
    T, at = state.T_world_imu, keyframes.scan
    T_new = Correction(run.time_ns[at], T[at], solution[x.poses]).apply(run.time_ns, T)
    turned = quaternion.to_matrix(T_new[:, :4]) @ np.swapaxes(quaternion.to_matrix(T[:, :4]), 1, 2)
    velocity = np.einsum("nij,nj->ni", turned, state.velocity_bias[:, :3])
    seconds, key_seconds = _seconds(run, keyframes)
    biases = np.stack([np.interp(seconds, key_seconds, solution[x.states][:, k]) for k in range(3, 9)], axis=1)
    return RefinedState(
        T_world_imu=T_new,
        velocity_bias=np.hstack([velocity, biases]),
        gravity_direction=solution[x.down][0],
        T_imu_lidar=solution[x.lidar][0],
        time_offset_s=state.time_offset_s if x.offset is None else float(solution[x.offset][0, 0]),
        receiver=receiver,
    )


def _between(run: FinishedRun, keyframes: Keyframes, own: Floats) -> Floats:
    """(N, 6, 6) interpolated between those of the keyframes (K, 6, 6)."""
    seconds, key_seconds = _seconds(run, keyframes)
    covariance = np.zeros((len(run), 6, 6))
    for a in range(6):
        for b in range(6):
            covariance[:, a, b] = np.interp(seconds, key_seconds, own[:, a, b])
    return covariance


def _seconds(run: FinishedRun, keyframes: Keyframes) -> tuple[Floats, Floats]:
    return (run.time_ns - run.time_ns[0]) * 1e-9, (run.time_ns[keyframes.scan] - run.time_ns[0]) * 1e-9


def _errors(loops: KeyframeLoops, T_key: Floats) -> Floats:
    """(L,) what loops are off by, in their own standard deviations."""
    white = loops.residual.whitening.factors @ loops.residual.evaluate(T_key[loops.place], T_key[loops.query])[:, :, None]
    return np.asarray(np.linalg.norm(white[:, :, 0], axis=1))
