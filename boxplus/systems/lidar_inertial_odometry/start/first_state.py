"""State and covariance of a platform that has been found at rest, or moving along a path (docs/agreement.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
from boxplus.manifolds import so3
from boxplus.manifolds.upright_rotation import upright_rotation
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.sequencer import Frame
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.shown_turns import shown_turns
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
from boxplus.systems.lidar_inertial_odometry.mounting.unknown_mounting import first_sensitivity, with_mounting

_SLOPE_STD = 0.01  # of the scale of an accelerometer in order
_ACCEL_BIAS_STD = 0.15  # m/s²
_MOUNTING_STD = 0.01  # rad
_MEAN_ACCEL_STD = 2.0  # m/s²
_GYRO_BIAS_STD = 5e-3  # rad/s, of the difference to the LiDAR over a second
_ANY_GYRO_BIAS_STD = 0.05  # rad/s, of a gyroscope in order, about axes where the LiDAR does not show how it turns
_TWICE = 4.0  # the batch and then the filter see the same scans: its covariance is widened by this


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


def static_state(imu: ImuSamples, extrinsic: NavState, config: LioConfig) -> tuple[NavState, NDArray[np.float64]]:
    """State and (24, 24) covariance of a platform at rest: gravity and biases are what the IMU shows on average."""
    up = imu.accel.mean(axis=0)
    R = upright_rotation(up) if config.gravity_aligned else np.eye(3)
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
    turned, speed = _swing(imu)
    gyro_sigma = max(float(imu.gyro.std(axis=0).max()) / np.sqrt(len(imu)), turned, 1e-4)
    # The mean of a shaken accelerometer is not better known than its samples are many.
    gravity_sigma = float(np.hypot(0.1, 2.0 * imu.accel.std(axis=0).max() / np.sqrt(len(imu))))
    covariance = _first_covariance(
        config, gyro_sigma=gyro_sigma, accel_sigma=0.1, velocity_sigma=max(speed, 0.01), gravity_sigma=gravity_sigma
    )
    if config.extrinsic_estimation != "off":
        covariance = with_mounting(covariance, first_sensitivity(state.pack()))
    return state, covariance


def _swing(imu: ImuSamples) -> tuple[float, float]:
    """How a platform that ends as it began swings meanwhile: amplitudes of turn over the time watched [rad/s] and speed [m/s].

    A mean turn rate is off by what the platform turned from the first sample to the last, and at the instant of the first state
    it may be anywhere in its swing. Vibration, tens of times a second, adds up to nothing.
    """
    seconds = np.diff(imu.time_ns, prepend=imu.time_ns[0])[:, None] * 1e-9
    turn, speed = (np.cumsum((part - part.mean(axis=0)) * seconds, axis=0) for part in (imu.gyro, imu.accel))
    watched = max(float(seconds.sum()), 1e-3)
    return float(np.sqrt(2.0) * turn.std(axis=0).max()) / watched, float(np.sqrt(2.0) * speed.std(axis=0).max())


def moving_fit(
    frames: Sequence[Frame], path: LidarPath, imu: ImuSamples, extrinsic: NavState, config: LioConfig
) -> TranslationFit | None:
    """Velocity, gravity and bias from the LiDAR's path and the accelerometer, with metres as given and the mounting as known."""
    mean, std = wide_prior()
    mean[ARM], std[ARM] = extrinsic.p_imu_lidar, 0.01
    # Over a second the mean specific force is gravity but for the mean acceleration.
    R_path_imu = path.R_path_lidar[len(path) // 2] @ extrinsic.R_imu_lidar.T
    mean[GRAVITY], std[GRAVITY] = -R_path_imu @ imu.accel.mean(axis=0), _MEAN_ACCEL_STD
    std[SLOPE], std[BIAS], std[TURN] = _SLOPE_STD, _ACCEL_BIAS_STD, _MOUNTING_STD
    if config.extrinsic_estimation != "off":
        std[ARM], std[TURN] = config.extrinsic_translation_sigma, np.deg2rad(config.extrinsic_rotation_sigma_deg)
    bias_gyro = gyro_bias(path, imu, extrinsic)
    seconds = (frames[-1].scan.end_ns - frames[0].scan.start_ns) * 1e-9
    return compare_accelerations(path, imu, extrinsic.R_imu_lidar, bias_gyro, 0.0, (mean, std), stretch_s=seconds + 1.0)


def gyro_bias(path: LidarPath, imu: ImuSamples, extrinsic: NavState) -> NDArray[np.float64]:
    """(3,) mean difference between the gyroscope's and the LiDAR's turn rate [rad/s], IMU frame; zero where no scene shows it."""
    steps = so3.log(np.swapaxes(path.R_path_lidar[:-1], 1, 2) @ path.R_path_lidar[1:])
    span = (path.time_ns[-1] - path.time_ns[0]) * 1e-9
    inside = (imu.time_ns >= path.time_ns[0]) & (imu.time_ns <= path.time_ns[-1])
    shown = extrinsic.R_imu_lidar @ shown_turns(path)[0]
    bias: NDArray[np.float64] = imu.gyro[inside].mean(axis=0) - extrinsic.R_imu_lidar @ steps.sum(axis=0) / span
    return shown @ (shown.T @ bias)


def moving_state(
    frames: Sequence[Frame],
    path: LidarPath,
    not_shown: NDArray[np.float64],
    imu: ImuSamples,
    fit: TranslationFit,
    extrinsic: NavState,
    config: LioConfig,
) -> tuple[NavState, NDArray[np.float64]]:
    """State and covariance at the end of the first scan, carried there from the beginning of the batch.

    About the axes `not_shown` (3, K), LiDAR frame, the surroundings say nothing of the gyroscope's bias.
    """
    first = fit.stretches[0]
    bias_gyro = gyro_bias(path, imu, extrinsic)
    known = _with_mounting_known(fit, extrinsic, config)
    bias = fit.bias + known.change[6:]
    attitude = BodyAttitude(path, imu, extrinsic.R_imu_lidar, bias_gyro, 0)
    end_ns = frames[0].scan.end_ns
    grid = np.unique(
        np.concatenate([[first.time_ns, end_ns], imu.time_ns[(imu.time_ns > first.time_ns) & (imu.time_ns < end_ns)]])
    )
    R_grid = attitude.at(grid)
    accel = np.stack([np.interp(grid, imu.time_ns, imu.accel[:, i]) for i in range(3)], axis=1) - bias
    force = np.einsum("nij,nj->ni", R_grid, accel)
    dt = np.diff(grid)[:, None] * 1e-9
    gravity = fit.gravity + known.change[3:6]
    v_path = first.state[3:] + known.change[:3] + (0.5 * (force[1:] + force[:-1]) * dt).sum(axis=0) + gravity * float(dt.sum())
    gravity *= STANDARD_GRAVITY / float(np.linalg.norm(gravity))
    R_path_imu = R_grid[-1]
    R_world_path = upright_rotation(-gravity) if config.gravity_aligned else R_path_imu.T
    state = NavState(
        R_world_path @ R_path_imu,
        np.zeros(3),
        R_world_path @ v_path,
        bias_gyro,
        bias,
        R_world_path @ gravity,
        extrinsic.R_imu_lidar,
        extrinsic.p_imu_lidar,
    )
    covariance = _first_covariance(config, gyro_sigma=_GYRO_BIAS_STD, accel_sigma=0.0, velocity_sigma=0.0, gravity_sigma=0.0)
    open_turns = extrinsic.R_imu_lidar @ not_shown
    covariance[T_BW : T_BW + 3, T_BW : T_BW + 3] += _ANY_GYRO_BIAS_STD**2 * open_turns @ open_turns.T
    turn = np.zeros((9, 9))
    turn[:3, :3] = turn[3:6, 3:6] = R_world_path
    turn[6:, 6:] = np.eye(3)
    into = np.r_[T_V : T_V + 3, T_G : T_G + 3, T_BA : T_BA + 3]
    floor = np.diag(np.repeat([0.02, 0.05, 0.02], 3) ** 2)
    covariance[np.ix_(into, into)] = _TWICE * turn @ known.covariance @ turn.T + floor
    if config.extrinsic_estimation == "off":
        return state, covariance
    B = first_sensitivity(state.pack())
    B[into] = turn @ known.moves
    return state, with_mounting(covariance, B)


@dataclass(frozen=True, slots=True)
class _Known:
    """[velocity, gravity, bias] of a batch (9) with the mounting as it is given; velocity and gravity along the path's axes.

    Attributes:
        change: (9,) what they differ by from the batch, which may have moved the mounting.
        covariance: (9, 9) with the mounting known.
        moves: (9, 6) how they move with it, [δθ_L, δp_L].
    """

    change: NDArray[np.float64]
    covariance: NDArray[np.float64]
    moves: NDArray[np.float64]


def _with_mounting_known(fit: TranslationFit, extrinsic: NavState, config: LioConfig) -> _Known:
    C = fit.stretches[0].covariance
    z = np.r_[3:6, 6 + GRAVITY.start : 6 + GRAVITY.stop, 6 + BIAS.start : 6 + BIAS.stop]
    if config.extrinsic_estimation == "off":
        return _Known(np.zeros(9), C[np.ix_(z, z)], np.zeros((9, 6)))
    a = np.r_[6 + TURN.start : 6 + TURN.stop, 6 + ARM.start : 6 + ARM.stop]
    moves: NDArray[np.float64] = np.linalg.solve(C[np.ix_(a, a)], C[np.ix_(a, z)]).T
    change = moves @ np.concatenate([-fit.turn, extrinsic.p_imu_lidar - fit.p_imu_lidar])
    covariance = C[np.ix_(z, z)] - moves @ C[np.ix_(a, z)]
    moves[:, :3] = moves[:, :3] @ extrinsic.R_imu_lidar  # Exp(turn) R_imu_lidar = R_imu_lidar Exp(δθ_L)
    return _Known(change, covariance, moves)
