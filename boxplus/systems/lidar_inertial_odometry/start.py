"""The first state: from standstill, or from a short batch over scans and IMU when the platform moves (SPEC.md 9.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.filtering.degeneracy import pose_directions, strong_step
from boxplus.filtering.nav_state import (
    STANDARD_GRAVITY,
    T_BA,
    T_BW,
    T_G,
    T_P_L,
    T_THETA_L,
    T_V,
    TANGENT,
    NavState,
    boxplus_into,
)
from boxplus.filtering.propagation import NODE, propagate_interval
from boxplus.manifolds import so3
from boxplus.maps.ikd_tree import IkdTree
from boxplus.sensors.deskew import deskew_into
from boxplus.sensors.downsampling import VoxelFilter
from boxplus.sensors.imu import ImuSamples
from boxplus.sensors.sequencer import Frame
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.plane_measurement import PlaneMeasurement

_REST_GYRO_STD = 0.1  # rad/s, SPEC.md 9.4
_REST_ACCEL_STD = 0.5  # m/s²
_REST_ACCEL_NORM = (9.0, 10.6)
_IN_G = (0.8, 1.25)
_STANDARD_G = 9.80665
_REST_MISFIT = (1.25, 0.005)  # at rest, aligning the last scan gains no more than this factor and this much [m] ...
_REST_MISFIT_MAX = 0.08  # ... and it fits to this [m]
_REST_SCANS = 3
_MIN_MOVING_SCANS = 8


@dataclass(frozen=True, slots=True)
class Start:
    """How the odometry began.

    Attributes:
        kind: "static" or "moving".
        time_ns: the instant of `state`: the end of the first scan.
        state, covariance: first state and its (24, 24) covariance, tangent as in SPEC.md 9.1.
        duration_s: how long the start was observed.
        text: one sentence with the evidence.
    """

    kind: Literal["static", "moving"]
    time_ns: int
    state: NavState
    covariance: NDArray[np.float64]
    duration_s: float
    text: str


def find_start(frames: Sequence[Frame], config: LioConfig) -> Start | str:
    """Decide between the static and the moving start over `frames`; a sentence when neither is possible yet.

    Raises:
        InputError: the accelerometer reports in g.
    """
    imu = joined_imu(frames)
    duration = (frames[-1].scan.end_ns - frames[0].scan.start_ns) * 1e-9
    extrinsic = NavState.identity(None if config.T_imu_lidar is None else np.array(config.T_imu_lidar))
    gyro_std = float(imu.gyro.std(axis=0).max())
    accel_std = float(imu.accel.std(axis=0).max())
    norm = float(np.linalg.norm(imu.accel.mean(axis=0)))
    if _IN_G[0] < norm < _IN_G[1]:
        raise InputError(
            "accelerations in m/s², about 9.8 on average at the start",
            f"{norm:.2f}",
            f"the accelerometer reports in g: multiply by {_STANDARD_G} (reading a recording: --accel-unit g)",
        )
    low, high = _REST_ACCEL_NORM
    still = gyro_std < _REST_GYRO_STD and accel_std < _REST_ACCEL_STD and low <= norm <= high and len(imu) > 10
    evidence = f"gyro std {gyro_std:.3f} rad/s, accelerometer std {accel_std:.2f} m/s² around {norm:.2f} m/s²"
    if still:
        at_rest, moved, aligned = _standstill(frames, config, extrinsic)
        evidence += f"; the last scan lies {moved * 100:.1f} cm off the first ones unmoved, {aligned * 100:.1f} cm aligned"
        if at_rest:
            state, covariance = _static_state(imu, extrinsic, config)
            return Start("static", frames[0].scan.end_ns, state, covariance, duration, f"at rest: {evidence}")
    if len(frames) < _MIN_MOVING_SCANS:
        return f"not at rest ({evidence}), and {len(frames)} scans are not enough for a moving start; waiting for more data"
    path = _LidarPath(frames, config, extrinsic)
    # The first scans were moved by a biased gyro and without a velocity: once more, knowing both.
    path = _LidarPath(frames, config, replace(extrinsic, v_world_imu=path.first_velocity, bias_gyro=path.gyro_bias(imu)))
    if path.failed:
        return f"not at rest ({evidence}), and the first scans do not overlap enough for a moving start; waiting for more data"
    state, covariance, misfit = _moving_state(frames, path, extrinsic, config)
    speed = float(np.linalg.norm(state.v_world_imu))
    text = f"moving at {speed:.2f} m/s: {evidence}; batch over {len(frames)} scans fits to {misfit * 100:.1f} cm"
    return Start("moving", frames[0].scan.end_ns, state, covariance, duration, text)


def _standstill(frames: Sequence[Frame], config: LioConfig, extrinsic: NavState) -> tuple[bool, float, float]:
    """Whether the last scans fit the first ones without any motion as well as with the best one; both misfits [m].

    A displacement found by registration cannot decide: a narrow field of view leaves directions in which it slides.
    """
    tree = IkdTree(cell_size=config.map_cell, rebuild="inplace")
    voxel_filter = VoxelFilter(max(config.scan_voxel, config.map_cell), config.max_points)
    for frame in frames[:_REST_SCANS]:
        tree.insert(extrinsic.to_world(voxel_filter(frame.scan.p_lidar)[1]), downsample=True)
    unmoved, aligned = [], []
    for frame in frames[-_REST_SCANS:]:
        points = voxel_filter(frame.scan.p_lidar)[0]
        x = extrinsic.pack()
        unmoved.append(PlaneMeasurement(points, tree, config, voxel=config.scan_voxel, with_extrinsic=False).at(x, rematch=True))
        align(points, tree, x, config)
        aligned.append(PlaneMeasurement(points, tree, config, voxel=config.scan_voxel, with_extrinsic=False).at(x, rematch=True))
    factor, margin = _REST_MISFIT
    off, best = (float(np.mean([i.residual_rms for i in group])) for group in (unmoved, aligned))
    kept = sum(i.used for i in unmoved) >= max(0.9 * sum(i.used for i in aligned), config.min_points * len(unmoved))
    return bool(kept and off <= min(factor * best + margin, _REST_MISFIT_MAX)), off, best


def joined_imu(frames: Sequence[Frame]) -> ImuSamples:
    """The IMU samples of several frames, each once."""
    time = np.concatenate([f.imu.time_ns for f in frames])
    time, first = np.unique(time, return_index=True)
    return ImuSamples(
        time, np.concatenate([f.imu.gyro for f in frames])[first], np.concatenate([f.imu.accel for f in frames])[first]
    )


def _gravity_rotation(up_imu: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shortest rotation that takes the measured `up_imu` (3,) to +z (SPEC.md 9.4)."""
    up = up_imu / np.linalg.norm(up_imu)
    if up[2] < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    K = so3.hat(np.array([up[1], -up[0], 0.0]))
    rotation: NDArray[np.float64] = np.eye(3) + K + K @ K / (1.0 + up[2])
    return rotation


def _first_covariance(gyro_sigma: float, accel_sigma: float, velocity_sigma: float, gravity_sigma: float) -> NDArray[np.float64]:
    """Prior at the start. Pose: the first scan makes the map, so the first pose is the datum and exact by definition.

    What is not known is how gravity lies in that frame: the tilt from the accelerometer's bias goes into `g`.
    """
    sigma = np.full(TANGENT, 1e-5)
    sigma[T_V : T_V + 3] = velocity_sigma
    sigma[T_BW : T_BW + 3] = gyro_sigma
    sigma[T_BA : T_BA + 3] = accel_sigma
    sigma[T_G : T_G + 3] = gravity_sigma
    sigma[T_THETA_L : T_THETA_L + 3] = 3e-3
    sigma[T_P_L : T_P_L + 3] = 3e-3
    return np.diag(sigma**2)


def _static_state(imu: ImuSamples, extrinsic: NavState, config: LioConfig) -> tuple[NavState, NDArray[np.float64]]:
    up = imu.accel.mean(axis=0)
    R = _gravity_rotation(up) if config.gravity_aligned else np.eye(3)
    direction = R @ up / np.linalg.norm(up)
    # The part of the bias along gravity is seen at once: whatever the norm exceeds 9.81 m/s² by.
    bias_accel = up * (1.0 - STANDARD_GRAVITY / np.linalg.norm(up))
    state = NavState(
        R,
        np.zeros(3),
        np.zeros(3),
        imu.gyro.mean(axis=0),
        bias_accel,
        -STANDARD_GRAVITY * direction,
        extrinsic.R_imu_lidar,
        extrinsic.p_imu_lidar,
    )
    gyro_sigma = max(float(imu.gyro.std(axis=0).max()) / np.sqrt(len(imu)), 1e-4)
    covariance = _first_covariance(gyro_sigma=gyro_sigma, accel_sigma=0.1, velocity_sigma=0.01, gravity_sigma=0.1)
    return state, covariance


class _LidarPath:
    """Poses of the IMU at the ends of the scans by the LiDAR alone, in the frame of the first one.

    Rotation is predicted by the gyro, translation by constant velocity; each scan is matched to the map of those before.
    """

    def __init__(self, frames: Sequence[Frame], config: LioConfig, first: NavState) -> None:
        tree = IkdTree(cell_size=config.map_cell, rebuild="inplace")
        voxel_filter = VoxelFilter(max(config.scan_voxel, config.map_cell), config.max_points)
        x = first.pack()
        self.rotations: list[NDArray[np.float64]] = []
        self.positions: list[NDArray[np.float64]] = []
        self.failed = False
        self._ends = [frame.scan.end_ns * 1e-9 for frame in frames]
        for index, frame in enumerate(frames):
            before = NavState.unpack(x)
            points, map_points = voxel_filter(deskew_at_constant_velocity(frame, x, config))
            if index > 0:
                self.failed |= not align(points, tree, x, config)
                x[12:15] = (x[9:12] - before.p_world_imu) / ((frame.scan.end_ns - frame.begin_ns) * 1e-9)
            now = NavState.unpack(x)
            self.rotations.append(now.R_world_imu)
            self.positions.append(now.p_world_imu)
            tree.insert(now.to_world(map_points), downsample=True)

    @property
    def first_velocity(self) -> NDArray[np.float64]:
        """(3,) mean velocity over the first scans, which the first one alone cannot tell."""
        scans = min(4, len(self.positions) - 1)
        mean: NDArray[np.float64] = (self.positions[scans] - self.positions[0]) / (self._ends[scans] - self._ends[0])
        return mean

    def gyro_bias(self, imu: ImuSamples) -> NDArray[np.float64]:
        """(3,) mean difference between the gyro's and the LiDAR's turn rate [rad/s], IMU frame."""
        steps = [so3.log(a.T @ b) for a, b in zip(self.rotations[:-1], self.rotations[1:], strict=True)]
        lidar_rate = np.sum(steps, axis=0) / (self._ends[-1] - self._ends[0])
        inside = (imu.time_ns * 1e-9 >= self._ends[0]) & (imu.time_ns * 1e-9 <= self._ends[-1])
        bias: NDArray[np.float64] = imu.gyro[inside].mean(axis=0) - lidar_rate
        return bias


def align(points: NDArray[np.float32], tree: IkdTree, x: NDArray[np.float64], config: LioConfig) -> bool:
    """Gauss-Newton on the pose alone, without the weak directions; x (36,) is replaced. False when too few points match."""
    measurement = PlaneMeasurement(points, tree, config, voxel=config.scan_voxel, with_extrinsic=False)
    delta = np.zeros(TANGENT)
    for _ in range(15):
        information = measurement.at(x, rematch=True)
        if information.used < config.min_points:
            return False
        directions = pose_directions(information.A, measurement.lever_arm, config.weak_threshold)
        delta[:6] = strong_step(information.A, information.b, directions)
        boxplus_into(x, delta, x)
        if np.abs(delta).max() < 1e-4:
            break
    return True


def deskew_at_constant_velocity(frame: Frame, x: NDArray[np.float64], config: LioConfig) -> NDArray[np.float32]:
    """Deskew a frame with the gyro and the velocity in x (36,), and move x to the end of the scan."""
    free = NavState.unpack(x)
    weightless = free.pack()
    weightless[21:24] = 0.0
    time = (frame.imu.time_ns - frame.begin_ns) * 1e-9
    duration = (frame.scan.end_ns - frame.begin_ns) * 1e-9
    nodes = np.zeros((len(time) + 3, NODE))
    ones = np.ones(4)
    cov = np.eye(TANGENT)
    count = propagate_interval(
        weightless, cov, time, frame.imu.gyro, np.zeros_like(frame.imu.accel), duration, ones, config.max_imu_gap, ones, nodes
    )
    points = np.zeros_like(frame.scan.p_lidar)
    deskew_into(frame.scan.p_lidar, frame.scan.time_ns, frame.begin_ns, nodes, count, weightless, points)
    x[:21] = weightless[:21]
    return points


def _moving_state(
    frames: Sequence[Frame], path: _LidarPath, extrinsic: NavState, config: LioConfig
) -> tuple[NavState, NDArray[np.float64], float]:
    """Velocity and gravity from positions p(t) = p₀ + v₀ t + ½ g t² + ∬ R a, linear in (p₀, v₀, g); |g| = 9.81 imposed.

    R is the LiDAR path's rotation, so the biases are left to the filter; their prior is wide.
    """
    t0 = frames[0].scan.end_ns
    imu = joined_imu(frames)
    ends = np.array([(f.scan.end_ns - t0) * 1e-9 for f in frames])
    # Specific force in the path's frame, integrated twice with the rotations of the path in between turned by the gyro.
    time = np.concatenate([ends, (imu.time_ns - t0) * 1e-9])
    time = np.unique(time[(time >= 0.0) & (time <= ends[-1])])
    force = np.zeros((len(time), 3))
    accel = np.stack([np.interp(time, (imu.time_ns - t0) * 1e-9, imu.accel[:, i]) for i in range(3)], axis=1)
    steps = [so3.log(a.T @ b) for a, b in zip(path.rotations[:-1], path.rotations[1:], strict=True)]
    for i, t in enumerate(time):
        k = min(max(int(np.searchsorted(ends, t, side="right")) - 1, 0), len(steps) - 1)
        share = (t - ends[k]) / (ends[k + 1] - ends[k])
        force[i] = path.rotations[k] @ so3.exp(share * steps[k]) @ accel[i]
    dt = np.diff(time)[:, None]
    velocity = np.vstack([np.zeros(3), np.cumsum(0.5 * (force[1:] + force[:-1]) * dt, axis=0)])
    swept = velocity[:-1] * dt + (2.0 * force[:-1] + force[1:]) / 6.0 * dt**2
    position = np.vstack([np.zeros(3), np.cumsum(swept, axis=0)])
    at_ends = np.searchsorted(time, ends)
    target = np.array(path.positions) - position[at_ends]

    # Prior: the mean specific force is gravity but for the mean acceleration, taken as 1 m/s² (one sigma).
    sigma_position, sigma_mean_acceleration = 0.02, 1.0
    up = force.mean(axis=0)
    gravity: NDArray[np.float64] = -STANDARD_GRAVITY * up / np.linalg.norm(up)
    basis = np.stack([np.ones_like(ends), ends, 0.5 * ends**2], axis=1) / sigma_position
    solution = np.zeros((2, 3))
    for _ in range(5):
        tangent = np.linalg.svd(gravity[None, :])[2][1:]  # two directions orthogonal to g
        # Unknowns: p₀ (3), v₀ (3), two tilts of g [m/s²].
        rows = np.zeros((3 * len(ends) + 2, 8))
        values = np.zeros(3 * len(ends) + 2)
        for axis in range(3):
            block = slice(axis * len(ends), (axis + 1) * len(ends))
            rows[block, axis] = basis[:, 0]
            rows[block, 3 + axis] = basis[:, 1]
            rows[block, 6:] = np.outer(basis[:, 2], tangent[:, axis])
            values[block] = target[:, axis] / sigma_position - basis[:, 2] * gravity[axis]
        prior = -STANDARD_GRAVITY * up / np.linalg.norm(up)
        rows[-2:, 6:] = np.eye(2) / sigma_mean_acceleration
        values[-2:] = tangent @ (prior - gravity) / sigma_mean_acceleration
        solution_vector, *_ = np.linalg.lstsq(rows, values, rcond=None)
        tilted = gravity + tangent.T @ solution_vector[6:]
        gravity = (tilted * (STANDARD_GRAVITY / np.linalg.norm(tilted))).astype(np.float64)
        solution[:] = solution_vector[:6].reshape(2, 3)
        if np.linalg.norm(solution_vector[6:]) < 1e-6:
            break
    misfit = float(np.sqrt(np.mean((rows @ solution_vector - values)[:-2] ** 2))) * sigma_position
    information = rows.T @ rows
    spread = np.linalg.inv(information) * max(1.0, (misfit / sigma_position) ** 2)
    velocity_sigma = float(np.sqrt(spread[3:6, 3:6].diagonal().max()))
    gravity_sigma = float(np.sqrt(spread[6:, 6:].diagonal().max()))

    R = _gravity_rotation(np.asarray(-gravity, dtype=np.float64)) if config.gravity_aligned else np.eye(3)
    R0 = path.rotations[0]
    state = NavState(
        R @ R0,
        np.zeros(3),
        R @ solution[1],
        path.gyro_bias(imu),
        np.zeros(3),
        R @ gravity,
        extrinsic.R_imu_lidar,
        extrinsic.p_imu_lidar,
    )
    covariance = _first_covariance(
        gyro_sigma=1e-2, accel_sigma=0.2, velocity_sigma=max(velocity_sigma, 0.05), gravity_sigma=max(gravity_sigma, 0.1)
    )
    return state, covariance, misfit


def deskew_first(frame: Frame, state: NavState, config: LioConfig) -> NDArray[np.float32]:
    """Deskew the first scan, whose END `state` describes: found by going back with the gyro and the velocity."""
    forward = NavState.identity().pack()
    forward[15:18] = state.bias_gyro
    deskew_at_constant_velocity(frame, forward, config)
    turned = forward[:9].reshape(3, 3)
    elapsed = (frame.scan.end_ns - frame.begin_ns) * 1e-9
    x = state.pack()
    x[:9] = (state.R_world_imu @ turned.T).ravel()
    x[9:12] = state.p_world_imu - state.v_world_imu * elapsed
    return deskew_at_constant_velocity(frame, x, config)
