"""The start at rest: neither the images nor the IMU move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from boxplus.manifolds import so3
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks, shared_rows
from boxplus.systems.visual_inertial_odometry.start.ray_tracks import Floats

STILL_PX = 0.5  # median motion of the corners in half of the window, beyond that from image to image, which is noise
_GYRO_STD, _ACCEL_STD = 0.01, 0.1  # rad/s, m/s²: of means over a tenth of a second, which shaking at high rates leaves alone
_SHAKEN_GYRO, _SHAKEN_ACCEL = 0.5, 5.0  # rad/s, m/s²: of single samples, beyond which means are not to be trusted
_GRAVITY_ERROR = 0.5  # m/s²
_NOISE_SHARE = 0.2  # of the motion from image to image, which at rest is noise; what is taken off has noise too
_TILT_DEG = 0.06  # that noise leaves, beside what the accelerometer's bias does
_BLOCK_S = 0.1
_SHAKING = 1.5
_FEWEST_TRACKS = 15
_SPEED_STD = 0.02  # m/s: half a pixel in a second at some metres
_TURN_STD = 5e-4  # rad/s: half a pixel in a second


@dataclass(frozen=True)
class Rest:
    """What a standstill tells, or why it is none.

    Attributes:
        problem: a sentence, empty when it is one.
        R_world_imu: (3, 3), z up, turned from the axes of the IMU the shortest way.
        gyro_bias: (3,) [rad/s]; accel_bias: (3,) [m/s²], along gravity, where it is seen.
        covariance: (15, 15) of [θ, p, v, b_ω, b_a] at its end.
        facts: numbers of the tests.
    """

    problem: str
    R_world_imu: Floats
    gyro_bias: Floats
    accel_bias: Floats
    covariance: Floats
    facts: dict[str, float]


def judge_rest(seen: Sequence[Tracks], imu: ImuSamples, noise: ImuNoise, gravity: float, accel_bias_sigma: float) -> Rest:
    """Whether all of these frames were taken at rest, and the state if they were.

    Args:
        seen: frames in order of time.
        imu: samples between the first and the last of them.
        noise: of the IMU.
        gravity: its magnitude [m/s²].
        accel_bias_sigma: of the accelerometer's bias beforehand [m/s²].
    """
    duration = (seen[-1].time_ns - seen[0].time_ns) * 1e-9
    half = max(len(seen) // 2, 1)
    shown, moved_half = _motion(seen, half)
    _, moved_one = _motion(seen, 1)
    moved = float(np.sqrt(max(moved_half**2 - moved_one**2, 0.0))) if np.isfinite(moved_half) else np.inf  # noise taken off
    gyro, accel = imu.gyro.mean(axis=0), imu.accel.mean(axis=0)
    gyro_std, accel_std = (_block_std(imu.time_ns, values) for values in (imu.gyro, imu.accel))
    raw_gyro, raw_accel = (float(values.std(axis=0).max()) for values in (imu.gyro, imu.accel))
    # What shakes from sample to sample leaves this in the mean over a tenth of a second; `noise` has it as a density.
    gyro_most = max(_GYRO_STD, _SHAKING * noise.gyro / np.sqrt(_BLOCK_S))
    accel_most = max(_ACCEL_STD, _SHAKING * noise.accel / np.sqrt(_BLOCK_S))
    norm = float(np.linalg.norm(accel))
    facts = {
        "image motion [px]": moved,
        "gyroscope, deviation [rad/s]": gyro_std,
        "accelerometer, deviation [m/s²]": accel_std,
        "mean specific force [m/s²]": norm,
    }
    problem = ""
    if shown < _FEWEST_TRACKS:
        problem = f"only {shown:.0f} corners stay in view ({_FEWEST_TRACKS} are needed)"
    elif moved > STILL_PX + _NOISE_SHARE * moved_one:
        problem = f"the image moves by {moved:.1f} px in {0.5 * duration:.1f} s (at rest: {STILL_PX:g})"
    elif gyro_std > gyro_most:
        problem = f"the gyroscope varies by {gyro_std:.3f} rad/s (at rest: {gyro_most:.2g})"
    elif accel_std > accel_most:
        problem = f"the accelerometer varies by {accel_std:.2f} m/s² (at rest: {accel_most:.2g})"
    elif raw_gyro > _SHAKEN_GYRO or raw_accel > _SHAKEN_ACCEL:
        problem = (
            f"the IMU shakes by {raw_gyro:.2f} rad/s and {raw_accel:.1f} m/s² (at rest: {_SHAKEN_GYRO:g} and {_SHAKEN_ACCEL:g})"
        )
    elif abs(norm - gravity) > _GRAVITY_ERROR:
        problem = f"the mean specific force is {norm:.2f} m/s², not {gravity:.2f}"
    of_mean = accel_std**2 * _BLOCK_S / max(duration, _BLOCK_S)
    tilt = float(np.rad2deg(np.sqrt(of_mean) / gravity))
    if not problem and tilt > _TILT_DEG:
        problem = f"shaking leaves gravity uncertain by {tilt:.2f} deg (at rest: {_TILT_DEG:g})"
    up = accel / max(norm, 1e-9)
    R = shortest_turn(up, np.array([0.0, 0.0, 1.0]))

    # The force is Rᵀ g + b_a: along gravity the bias is seen, across it is not told from tilt.
    along = np.outer(up, up)
    A = np.zeros((15, 6))  # by a horizontal bias, an error of the force, and nothing else
    across = np.eye(3) - along
    # θ × up = -δ / g where the bias is δ too small; θ = R_imu_world tilt, seen in the IMU.
    A[0:3, 0:3] = so3.hat(up) @ across / gravity
    A[12:15, 0:3] = across
    A[12:15, 3:6] = along
    spread = np.diag([accel_bias_sigma**2] * 3 + [of_mean] * 3)
    covariance = A @ spread @ A.T
    covariance[3:6, 3:6] += np.eye(3) * 1e-12
    covariance[6:9, 6:9] += np.eye(3) * _SPEED_STD**2
    covariance[9:12, 9:12] += np.eye(3) * (gyro_std**2 * _BLOCK_S / max(duration, _BLOCK_S) + _TURN_STD**2)
    covariance[0:3, 0:3] += np.eye(3) * of_mean / gravity**2
    covariance[12:15, 12:15] += np.eye(3) * (noise.accel_walk**2 * duration + of_mean)
    return Rest(problem, R, gyro, (norm - gravity) * up, covariance, facts)


def _motion(seen: Sequence[Tracks], step: int) -> tuple[float, float]:
    """Fewest corners that two frames `step` apart share, and the mean of the medians of how far they moved [px]."""
    shared, moved = [], []
    for first, second in zip(seen[:-step], seen[step:], strict=True):
        i, j = shared_rows(first.ids, second.ids)
        motion = np.linalg.norm(second.pixels[j, 0] - first.pixels[i, 0], axis=1)
        motion = motion[np.isfinite(motion)]
        shared.append(len(motion))
        moved.append(float(np.median(motion)) if len(motion) else np.inf)
    return float(min(shared)), float(np.mean(moved))


def _block_std(time_ns: np.ndarray, values: Floats) -> float:
    """Largest standard deviation along an axis of means over tenths of a second."""
    block = ((time_ns - time_ns[0]) // int(_BLOCK_S * 1e9)).astype(np.int64)
    count = np.bincount(block)
    full = count >= 0.5 * np.median(count[count > 0])
    means = np.stack([np.bincount(block, column)[full] / count[full] for column in values.T], axis=1)
    return float(means.std(axis=0).max())


def shortest_turn(a: Floats, b: Floats) -> Floats:
    """The rotation (3, 3) with R a = b for unit vectors, about the axis across both."""
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-9:
        if cosine > 0.0:
            return np.eye(3)
        axis = np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))])
        sine = float(np.linalg.norm(axis))
        return so3.exp(np.pi * axis / sine)
    turn: Floats = so3.exp(np.arctan2(sine, cosine) * axis / sine)
    return turn
