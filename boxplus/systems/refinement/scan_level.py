"""Level two of refinement: every scan by itself on the planes, which are held, and between its neighbours in time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds.body_pose import BodyPose
from boxplus.manifolds.euclidean import Euclidean
from boxplus.maps.plane_voxels.plane_map import PlaneMap
from boxplus.optimization.problem import Problem
from boxplus.optimization.solver_options import SolverOptions
from boxplus.residuals.inertial.imu import ImuPreintegration
from boxplus.residuals.planes.pose_quadratic import PoseQuadratic
from boxplus.systems.refinement.config import RefinementConfig
from boxplus.systems.refinement.counted_less import covariances_of
from boxplus.systems.refinement.finished_run import FinishedRun
from boxplus.systems.refinement.inertial import GRAVITY, add_bias_prior, imu_counted, preintegrated
from boxplus.systems.refinement.planes.sightings import scan_forms, weights_of_slices
from boxplus.systems.refinement.state import RefinedState
from boxplus.systems.refinement.unshown import kept_steps

Floats = NDArray[np.float64]


def move_scans(
    run: FinishedRun,
    state: RefinedState,
    planes: PlaneMap,
    information: Floats,
    config: RefinementConfig,
    *,
    with_covariance: bool,
) -> tuple[RefinedState, Floats]:
    """The state with every scan moved, and covariances (N, 6, 6) of the poses on the planes; zero unless they are asked for."""
    problem = Problem()
    poses = problem.add_variables(BodyPose, state.T_world_imu, name="scans")
    states = problem.add_variables(Euclidean(9), state.velocity_bias, name="velocity_bias")
    between = preintegrated(run, np.arange(len(run)), state.velocity_bias, state.time_offset_s)
    imu = ImuPreintegration(between, gravity=GRAVITY * state.gravity_direction)
    by_imu = problem.add_residuals(imu, poses[:-1], states[:-1], poses[1:], states[1:], name="imu")
    forms = scan_forms(run, state.T_world_imu, state.T_imu_lidar, planes, information, config.threads)
    on_planes = problem.add_residuals(PoseQuadratic(forms, state.T_world_imu[:, 4:]), poses, name="planes")
    steps = np.flatnonzero(np.einsum("nii->n", run.open_steps[1:]) > 0.0)
    if len(steps):  # the keyframes have been moved by what tells
        as_they_are = kept_steps(state.T_world_imu, steps, steps + 1, run.open_steps[steps + 1])
        problem.add_residuals(as_they_are, poses[steps], poses[steps + 1], name="steps along what is open", carry_over=True)
    add_bias_prior(problem, states)
    options = SolverOptions(
        linear_solver="sparse", max_iterations=config.max_iterations, cost_tolerance=1e-7, threads=config.threads, examine=False
    )
    solution = problem.solve(options)
    covariance = np.zeros((len(run), 6, 6))
    if with_covariance:
        weights = weights_of_slices(run)
        counted = {on_planes: weights, by_imu: imu_counted(weights < 1.0)}
        (covariance,) = covariances_of(problem, solution, [poses], counted, {}, options, is_determined=True)
    return replace(state, T_world_imu=solution[poses], velocity_bias=solution[states]), covariance
