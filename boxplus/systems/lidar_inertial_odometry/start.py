"""The first state: at rest, or moving, from the LiDAR's own motion compared with the IMU (docs/agreement.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
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
)
from boxplus.filtering.propagation import NODE, propagate_interval
from boxplus.manifolds import so3
from boxplus.sensors.deskew import deskew_into
from boxplus.sensors.imu import ImuSamples
from boxplus.sensors.sequencer import Frame
from boxplus.systems.lidar_inertial_agreement.agreement import gyro_guesses
from boxplus.systems.lidar_inertial_agreement.lidar_motion import LidarPath, lidar_path
from boxplus.systems.lidar_inertial_agreement.other_speeds import other_speed
from boxplus.systems.lidar_inertial_agreement.rest import Rest, judge_rest
from boxplus.systems.lidar_inertial_agreement.translation import (
    ARM,
    BIAS,
    GRAVITY,
    SLOPE,
    TURN,
    BodyAttitude,
    TranslationFit,
    compare_accelerations,
    wide_prior,
)
from boxplus.systems.lidar_inertial_odometry.config import LioConfig

_REST_ACCEL_NORM = (9.0, 10.6)  # m/s²
_NO_GRAVITY = 0.5  # m/s²: less on average than any start but free fall
_IN_G = (0.8, 1.25)
_STANDARD_G = 9.80665
_QUIET_GYRO, _QUIET_ACCEL = 0.1, 0.5  # rad/s, m/s²: standard deviations at rest where the LiDAR cannot tell
_PARTS, _STEADY_ACCEL = 5, 0.1  # m/s²: what vibration leaves of a mean over a fifth of a second
_MIN_MOVING_SCANS = 8
_FEWEST_SAMPLES = 5
_UPRIGHT = 0.9  # cosine
_LARGEST_BIAS = 0.12  # rad/s, of a gyroscope that works
_LARGEST_MISFIT_M = 0.05  # of the batch over a moving start
_SLOPE_STD = 0.01  # of the scale of an accelerometer in order
_ACCEL_BIAS_STD = 0.15  # m/s²
_LARGEST_ACCEL_BIAS = 0.4  # m/s²: what an accelerometer in order has, as a path does not bend for no reason
_MOUNTING_STD = 0.01  # rad
_UNKNOWN_SPEED = 3.0  # m/s: standard deviation beyond which the velocity was not found
_MEAN_ACCEL_STD = 2.0  # m/s²
_GYRO_BIAS_STD = 5e-3  # rad/s, of the difference to the LiDAR over a second
_TWICE = 4.0  # the batch and then the filter see the same scans: its covariance is widened by this


@dataclass(frozen=True, slots=True)
class Start:
    """How the odometry began.

    Attributes:
        kind: "static" or "moving".
        time_ns: the instant of `state`: the end of the first scan.
        state, covariance: first state and its (24, 24) covariance, tangent as in `NavState`.
        duration_s: how long the start was observed.
        text: one sentence with the evidence.
        warning: what could not be decided, a sentence; empty when all was.
        unshown_axes: (K, 3) unit axes in the world along which rest was taken for granted.
    """

    kind: Literal["static", "moving"]
    time_ns: int
    state: NavState
    covariance: NDArray[np.float64]
    duration_s: float
    text: str
    warning: str = ""
    unshown_axes: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))


def find_start(frames: Sequence[Frame], config: LioConfig) -> Start | str:
    """Decide between the static and the moving start over `frames`; a sentence when neither is possible yet.

    At rest means that the LiDAR does not move against what it sees, however much the IMU is shaken; only along what the scene
    does not determine a quiet IMU has to do. Moving, velocity and gravity come from a batch over the LiDAR's path and the
    accelerometer.

    Raises:
        InputError: the accelerometer reports in g, was taken for one that does, or shows no gravity.
    """
    imu = joined_imu(frames)
    duration = (frames[-1].scan.end_ns - frames[0].scan.start_ns) * 1e-9
    norm = float(np.linalg.norm(imu.accel.mean(axis=0)))
    if norm < _NO_GRAVITY:
        raise InputError(
            "accelerations with gravity, about 9.8 m/s² on average at the start",
            f"{norm:.2f} m/s²",
            "the accelerometer delivers nothing, or its driver takes gravity out: give what it measures",
        )
    if _IN_G[0] < norm < _IN_G[1]:
        raise InputError(
            "accelerations in m/s², about 9.8 on average at the start",
            f"{norm:.2f}",
            f"the accelerometer reports in g: multiply by {_STANDARD_G} (reading a recording: --accel-unit g)",
        )
    if _IN_G[0] < norm / _STANDARD_G**2 < _IN_G[1]:
        raise InputError(
            "accelerations in m/s², about 9.8 on average at the start",
            f"{norm:.1f}",
            "the accelerometer reports in m/s² and was taken for one in g (reading a recording: --accel-unit m/s2)",
        )
    extrinsic = NavState.identity(None if config.T_imu_lidar is None else np.array(config.T_imu_lidar))
    gyro_std, accel_std = float(imu.gyro.std(axis=0).max()), float(imu.accel.std(axis=0).max())
    evidence = f"gyro std {gyro_std:.3f} rad/s, accelerometer std {accel_std:.2f} m/s² around {norm:.2f} m/s²"
    scans = [frame.scan for frame in frames]
    path = lidar_path(scans, config, gyro_guesses(imu, extrinsic.R_imu_lidar), unbroken=True)
    if path.failed or len(path) < min(len(frames), 3) or path.segment[-1] != path.segment[0]:
        return f"the first scans do not overlap enough to see whether they move ({evidence}); waiting for more data"
    within = int(np.count_nonzero((imu.time_ns >= path.time_ns[0]) & (imu.time_ns <= path.time_ns[-1])))
    if len(path) < 2 or within < _FEWEST_SAMPLES:
        return f"{len(path)} scans and {within} IMU samples between them are not enough for a start; waiting for more data"
    rest = judge_rest(path, scans, config)
    evidence += f"; the LiDAR alone moves with {rest.speed * 100:.1f} cm/s and {np.degrees(rest.turn_rate):.2f} deg/s"
    # At rest the gyroscope is to show nothing; a LiDAR that sees little may turn on its own.
    bias = float(np.linalg.norm(imu.gyro.mean(axis=0) if rest.at_rest else _gyro_bias(path, imu, extrinsic)))
    if bias > _LARGEST_BIAS:
        return (
            f"the gyroscope turns by {np.degrees(bias):.1f} deg/s more than the LiDAR, which no bias explains: its unit, its "
            "sign, T_imu_lidar or the topics are wrong, or the LiDAR sees too little; waiting for more data"
        )
    quiet = gyro_std < _QUIET_GYRO and (accel_std < _QUIET_ACCEL or _shaken_only(imu)) and len(imu) > 10
    if rest.at_rest and (quiet or rest.determined):
        low, high = _REST_ACCEL_NORM
        if not low <= norm <= high:
            return f"at rest, but the accelerometer shows {norm:.2f} m/s², not one gravity: check its unit and scale"
        state, covariance = _static_state(imu, extrinsic, config)
        axes = _unshown(rest, extrinsic.R_imu_lidar.T @ imu.accel.mean(axis=0) / norm)
        R_world_lidar = state.R_world_imu @ extrinsic.R_imu_lidar
        return Start(
            "static",
            frames[0].scan.end_ns,
            state,
            covariance,
            duration,
            f"at rest: {evidence}",
            _undecided(axes),
            axes @ R_world_lidar.T,
        )
    if len(frames) < _MIN_MOVING_SCANS:
        return f"not at rest ({evidence}), and {len(frames)} scans are not enough for a moving start; waiting for more data"
    # Once more, each scan undistorted with the gyroscope instead of a constant rate.
    steady = ImuSamples(imu.time_ns, imu.gyro - _gyro_bias(path, imu, extrinsic), imu.accel)
    guesses = gyro_guesses(steady, extrinsic.R_imu_lidar)
    path = lidar_path(scans, config, guesses, undistort=True, velocity=_first_velocity(path), unbroken=True)
    if path.failed or path.segment[-1] != path.segment[0]:
        return f"not at rest ({evidence}), and the first scans do not overlap enough for a moving start; waiting for more data"
    fit = _moving_fit(frames, path, imu, extrinsic)
    if fit is None:
        return f"not at rest ({evidence}), and the scene does not determine how the platform turns; waiting for more data"
    if fit.sigma > _LARGEST_MISFIT_M:
        return (
            f"not at rest ({evidence}), and LiDAR and IMU do not fit better than {fit.sigma * 100:.1f} cm; waiting for more data"
        )
    if np.linalg.norm(fit.bias) > _LARGEST_ACCEL_BIAS:
        return (
            f"not at rest ({evidence}), and the path of the LiDAR asks for a bias of the accelerometer of "
            f"{np.linalg.norm(fit.bias):.2f} m/s²: it sees too little, or the accelerometer is bad; waiting for more data"
        )
    state, covariance = _moving_state(frames, path, imu, fit, extrinsic, config)
    speed = float(np.linalg.norm(state.v_world_imu))
    variances, axes = np.linalg.eigh(covariance[T_V : T_V + 3, T_V : T_V + 3])
    sigma = float(np.sqrt(variances[-1]))
    if sigma > _UNKNOWN_SPEED:
        axis = (state.R_world_imu @ extrinsic.R_imu_lidar).T @ axes[:, -1]
        return (
            f"not at rest ({evidence}), and the surroundings do not show how fast the platform moves along {_axis_text(axis)} "
            f"(LiDAR axes): {sigma:.0f} m/s more or less; waiting for more data"
        )
    other = other_speed(path, scans, config, guesses)
    if other is not None:
        return (
            f"not at rest ({evidence}), and the surroundings do not show how fast the platform moves: the scans fit about as "
            f"well at {np.linalg.norm(other):.1f} m/s as at {speed:.1f} m/s; waiting for more data"
        )
    text = f"moving at {speed:.2f} ± {sigma:.2f} m/s: {evidence}; batch over {len(frames)} scans fits to {fit.sigma * 100:.1f} cm"
    return Start("moving", frames[0].scan.end_ns, state, covariance, duration, text)


def _shaken_only(imu: ImuSamples) -> bool:
    """Whether all that the accelerometer shows is vibration: its means over parts of the window agree."""
    parts = np.array_split(imu.accel, _PARTS)
    means = np.array([part.mean(axis=0) for part in parts if len(part)])
    return bool(means.std(axis=0).max() < _STEADY_ACCEL)


def _unshown(rest: Rest, up_lidar: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 3) axes along which nothing shows rest, LiDAR frame; up and down, hardly anything begins at a constant speed."""
    return rest.open_axes[np.abs(rest.open_axes @ up_lidar) < _UPRIGHT].reshape(-1, 3)


def _undecided(axes: NDArray[np.float64]) -> str:
    """A sentence about the axes along which nothing shows rest."""
    if not len(axes):
        return ""
    return (
        "the surroundings do not show whether the platform moves along "
        f"{' and '.join(_axis_text(axis) for axis in axes)} (LiDAR axes): taken as at rest, because the IMU is quiet; "
        "at a constant speed it would be as quiet, so the position along it is called weak and its standard deviation grows by "
        "10 m/s until something shows the speed"
    )


def _axis_text(axis: NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{value:+.2f}" for value in axis) + ")"


def joined_imu(frames: Sequence[Frame]) -> ImuSamples:
    """The IMU samples of several frames, each once."""
    imu = ImuSamples.joined(frame.imu for frame in frames)
    time, first = np.unique(imu.time_ns, return_index=True)
    return ImuSamples(time, imu.gyro[first], imu.accel[first])


def _gravity_rotation(up_imu: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shortest rotation that takes the measured `up_imu` (3,) to +z (SPEC.md 9.4)."""
    up = up_imu / np.linalg.norm(up_imu)
    if up[2] < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    K = so3.hat(np.array([up[1], -up[0], 0.0]))
    rotation: NDArray[np.float64] = np.eye(3) + K + K @ K / (1.0 + up[2])
    return rotation


def _first_covariance(
    config: LioConfig, *, gyro_sigma: float, accel_sigma: float, velocity_sigma: float, gravity_sigma: float
) -> NDArray[np.float64]:
    """Prior at the start. Pose: the first scan makes the map, so the first pose is the datum and exact by definition.

    What is not known is how gravity lies in that frame: the tilt from the accelerometer's bias goes into `g`.
    """
    sigma = np.full(TANGENT, 1e-5)
    sigma[T_V : T_V + 3] = velocity_sigma
    sigma[T_BW : T_BW + 3] = gyro_sigma
    sigma[T_BA : T_BA + 3] = accel_sigma
    sigma[T_G : T_G + 3] = gravity_sigma
    sigma[T_THETA_L : T_THETA_L + 3] = np.deg2rad(config.extrinsic_rotation_sigma_deg)
    sigma[T_P_L : T_P_L + 3] = config.extrinsic_translation_sigma
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
    # The mean of a shaken accelerometer is not better known than its samples are many.
    gravity_sigma = float(np.hypot(0.1, 2.0 * imu.accel.std(axis=0).max() / np.sqrt(len(imu))))
    covariance = _first_covariance(
        config, gyro_sigma=gyro_sigma, accel_sigma=0.1, velocity_sigma=0.01, gravity_sigma=gravity_sigma
    )
    return state, covariance


def _moving_fit(frames: Sequence[Frame], path: LidarPath, imu: ImuSamples, extrinsic: NavState) -> TranslationFit | None:
    """Velocity, gravity and bias from the LiDAR's path and the accelerometer, with the mounting and metres as given."""
    mean, std = wide_prior()
    mean[ARM], std[ARM] = extrinsic.p_imu_lidar, 0.01
    # Over a second the mean specific force is gravity but for the mean acceleration.
    R_path_imu = path.R_path_lidar[len(path) // 2] @ extrinsic.R_imu_lidar.T
    mean[GRAVITY], std[GRAVITY] = -R_path_imu @ imu.accel.mean(axis=0), _MEAN_ACCEL_STD
    std[SLOPE], std[BIAS], std[TURN] = _SLOPE_STD, _ACCEL_BIAS_STD, _MOUNTING_STD
    bias_gyro = _gyro_bias(path, imu, extrinsic)
    seconds = (frames[-1].scan.end_ns - frames[0].scan.start_ns) * 1e-9
    return compare_accelerations(path, imu, extrinsic.R_imu_lidar, bias_gyro, 0.0, (mean, std), stretch_s=seconds + 1.0)


def _first_velocity(path: LidarPath) -> NDArray[np.float64]:
    """(3,) over the first scans [m/s]."""
    last = min(3, len(path) - 1)
    velocity: NDArray[np.float64] = (path.p_path_lidar[last] - path.p_path_lidar[0]) / (
        (path.time_ns[last] - path.time_ns[0]) * 1e-9
    )
    return velocity


def _gyro_bias(path: LidarPath, imu: ImuSamples, extrinsic: NavState) -> NDArray[np.float64]:
    """(3,) mean difference between the gyroscope's and the LiDAR's turn rate [rad/s], IMU frame."""
    steps = so3.log(np.swapaxes(path.R_path_lidar[:-1], 1, 2) @ path.R_path_lidar[1:])
    span = (path.time_ns[-1] - path.time_ns[0]) * 1e-9
    inside = (imu.time_ns >= path.time_ns[0]) & (imu.time_ns <= path.time_ns[-1])
    bias: NDArray[np.float64] = imu.gyro[inside].mean(axis=0) - extrinsic.R_imu_lidar @ steps.sum(axis=0) / span
    return bias


def _moving_state(
    frames: Sequence[Frame], path: LidarPath, imu: ImuSamples, fit: TranslationFit, extrinsic: NavState, config: LioConfig
) -> tuple[NavState, NDArray[np.float64]]:
    """State and covariance at the end of the first scan, carried there from the beginning of the batch."""
    first = fit.stretches[0]
    bias_gyro = _gyro_bias(path, imu, extrinsic)
    attitude = BodyAttitude(path, imu, extrinsic.R_imu_lidar, bias_gyro, 0)
    end_ns = frames[0].scan.end_ns
    grid = np.unique(
        np.concatenate([[first.time_ns, end_ns], imu.time_ns[(imu.time_ns > first.time_ns) & (imu.time_ns < end_ns)]])
    )
    R_grid = attitude.at(grid)
    accel = np.stack([np.interp(grid, imu.time_ns, imu.accel[:, i]) for i in range(3)], axis=1) - fit.bias
    force = np.einsum("nij,nj->ni", R_grid, accel)
    dt = np.diff(grid)[:, None] * 1e-9
    v_path = first.state[3:] + (0.5 * (force[1:] + force[:-1]) * dt).sum(axis=0) + fit.gravity * float(dt.sum())
    gravity = fit.gravity * (STANDARD_GRAVITY / float(np.linalg.norm(fit.gravity)))
    R_path_imu = R_grid[-1]
    R_world_path = _gravity_rotation(-gravity) if config.gravity_aligned else R_path_imu.T
    state = NavState(
        R_world_path @ R_path_imu,
        np.zeros(3),
        R_world_path @ v_path,
        bias_gyro,
        fit.bias,
        R_world_path @ gravity,
        extrinsic.R_imu_lidar,
        extrinsic.p_imu_lidar,
    )
    covariance = _first_covariance(config, gyro_sigma=_GYRO_BIAS_STD, accel_sigma=0.0, velocity_sigma=0.0, gravity_sigma=0.0)
    # [velocity, gravity, bias] of the batch: velocity and gravity along the path's axes.
    known = np.r_[3:6, 6 + GRAVITY.start : 6 + GRAVITY.stop, 6 + BIAS.start : 6 + BIAS.stop]
    turn = np.zeros((9, 9))
    turn[:3, :3] = turn[3:6, 3:6] = R_world_path
    turn[6:, 6:] = np.eye(3)
    into = np.r_[T_V : T_V + 3, T_G : T_G + 3, T_BA : T_BA + 3]
    floor = np.diag(np.repeat([0.02, 0.05, 0.02], 3) ** 2)
    covariance[np.ix_(into, into)] = _TWICE * turn @ first.covariance[np.ix_(known, known)] @ turn.T + floor
    return state, covariance


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
