"""A finished run of LiDAR-inertial odometry, refined: all poses, planes and IMU samples at once (docs/refinement.md).

In every round planes are found anew in the map as it then is; then

1. keyframes, each with the scans around it in its frame, move together with the planes, velocities, biases, the direction of
   gravity and, where they are asked for, the mounting of the LiDAR and the time offset, held by loops that were closed and by
   positions by satellite as well: that is where drift goes;
2. every scan moves by itself, on the planes that were found, held by the IMU to its neighbours, which is where jitter goes.

A plane and a pose meet in a 4 × 4 matrix, so that no step depends on the number of points.

Source: Liu, Liu and Zhang, BALM2, TRO 2023; Liu, Liu, Yuan et al., HBA, RA-L 2023 (levels); Forster et al., TRO 2017 (IMU).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_settings
from boxplus.manifolds import quaternion, se3, so3
from boxplus.maps.plane_voxels.thickness import Sharpness
from boxplus.systems.refinement.calibrated import Calibrated, CalibrationFound
from boxplus.systems.refinement.config import RefinementConfig
from boxplus.systems.refinement.finished_run import FinishedRun
from boxplus.systems.refinement.inertial import MARGIN
from boxplus.systems.refinement.keyframe_level import move_keyframes
from boxplus.systems.refinement.keyframes import choose_keyframes
from boxplus.systems.refinement.planes.sightings import judge, keyframe_clusters, lidar_poses, planes_of
from boxplus.systems.refinement.scan_level import move_scans
from boxplus.systems.refinement.state import RefinedState

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """What came of it.

    Attributes:
        before, after: the states.
        pose_covariance: (N, 6, 6) of the poses after, [θ, p], relative to the first one. From the first scan on that left
            something open it is that of the run, whose steps are kept along it.
        sharpness: of the map of points that took no part, before and after.
        keyframes, planes: how many.
        costs: (rounds, 2) of the keyframes' problem, at its begin and end.
        calibration: what became of mounting and time offset.
        loop_errors: (L,) what the loops of the run are off by after it [standard deviations].
        loop_is_told: (L,) whether planes that both stretches see took its place.
    """

    before: RefinedState
    after: RefinedState
    pose_covariance: Floats
    sharpness: tuple[Sharpness, Sharpness]
    keyframes: int
    planes: int
    costs: Floats
    calibration: CalibrationFound
    loop_errors: Floats
    loop_is_told: NDArray[np.bool_]

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
    config = as_settings(RefinementConfig, config)
    tell = progress or (lambda stage, share: None)
    g = run.gravity_world / np.linalg.norm(run.gravity_world)
    before = state = RefinedState(run.T_world_imu, run.velocity_bias, g, run.T_imu_lidar)
    keyframes = choose_keyframes(run.time_ns, run.T_world_imu, config)
    free = Calibrated.of(run, config)
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
        seen = keyframe_clusters(run, T_lidar, keyframes, planes, information, config.threads)
        tell("moving keyframes", (number + 0.4) / config.rounds)
        is_last = number + 1 == config.rounds
        moved = move_keyframes(run, state, keyframes, planes, seen, config, free, with_covariance=is_last)
        free, state = free.judged(moved.state, moved.time_offset_sigma, config)
        tell("moving scans", (number + 0.6) / config.rounds)
        held = np.where(moved.is_held, information, 0.0)
        state, own = move_scans(run, state, moved.planes, held, config, with_covariance=is_last)
        costs.append(moved.cost)
    own = own + _bending(run)
    tell("judging", 1.0)
    T_after = lidar_poses(state.T_world_imu, state.T_imu_lidar)
    return Refinement(
        before=before,
        after=_anchored(state, before.T_world_imu[0]),
        pose_covariance=_where_shown(run, _relative_to_first(state.T_world_imu, moved.covariance + own, own[0])),
        sharpness=judge(run, T_before, T_after, judging, config.threads),
        keyframes=len(keyframes),
        planes=int(np.count_nonzero(moved.is_held)),
        costs=np.array(costs),
        calibration=free.found(run, state, moved.mounting_sigma, moved.time_offset_sigma, config),
        loop_errors=moved.loop_errors,
        loop_is_told=np.zeros(0, dtype=np.bool_) if moved.loops is None else moved.loops.is_told,
    )


def _anchored(state: RefinedState, first: Floats) -> RefinedState:
    """The same with the first pose where it was: the world is that of the filter; on the Earth, where the fixes put it."""
    if state.receiver is not None:
        return state.moved(state.receiver.T_enu_world)
    return state.moved(se3.compose(first, se3.inverse(state.T_world_imu[0])))


def _bending(run: FinishedRun) -> Floats:
    """Covariances (N, 6, 6) of what the gyroscope's own noise turns the points of a slice by, on the mean, about its pose."""
    seconds = np.diff(run.time_ns, prepend=run.time_ns[0]) * 1e-9
    seconds[0] = seconds[1]
    covariance = np.zeros((len(run), 6, 6))
    turn = (run.noise.gyro / MARGIN) ** 2 * seconds / 12.0  # half of the points on either side
    covariance[:, np.arange(3), np.arange(3)] = turn[:, None]
    return covariance


def _where_shown(run: FinishedRun, covariance: Floats) -> Floats:
    """Covariances (N, 6, 6) as long as the run was shown everything: a step that is held is held, and is not known any better."""
    return covariance if run.covariance is None else np.where(run.is_unshown[:, None, None], run.covariance, covariance)


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
