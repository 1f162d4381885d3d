"""Preintegration between poses of a finished run, with gaps of the IMU for what they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds.euclidean import Euclidean
from boxplus.optimization.problem import Problem
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals.inertial.imu_preintegration import Preintegration
from boxplus.residuals.prior import Prior
from boxplus.systems.refinement.finished_run import FinishedRun

Floats = NDArray[np.float64]

GRAVITY = 9.81  # m/s²
MARGIN = 5.0  # of the noise that the odometry assumes, over that of the samples
_BIAS_SIGMA = np.array([0.3] * 3 + [0.03] * 3)  # m/s², rad/s, of the first keyframe
_LONGEST_GAP_S = 0.15
_GAP_TURN, _GAP_PUSH = 1.0, 5.0  # rad/s and m/s², that nobody has measured


def preintegrated(
    run: FinishedRun, scans: NDArray[np.int64], velocity_bias: Floats, time_offset_s: float = 0.0
) -> Preintegration:
    """Between successive ones of `scans`, at the biases (N, 9) of the earlier one; the IMU's clock is `time_offset_s` ahead.

    Over a gap of the samples the covariance is that of not knowing how the body moved.
    """
    begin, end = scans[:-1], scans[1:]
    scan_ns = run.time_ns + round(time_offset_s * 1e9)
    time_ns, gyro, accel = _covering(run, int(scan_ns[0]), int(scan_ns[-1]))
    found = Preintegration.integrate(
        time_ns,
        gyro,
        accel,
        noise=run.noise,
        intervals_ns=np.stack([scan_ns[begin], scan_ns[end]], axis=1),
        bias_accel=velocity_bias[begin, 3:6],
        bias_gyro=velocity_bias[begin, 6:],
    )
    unknown = (found.longest_gap_s > _LONGEST_GAP_S) | (found.longest_gap_s >= found.duration_s)
    gap = np.where(unknown, np.minimum(found.longest_gap_s, found.duration_s), 0.0)
    if not gap.any():
        return found
    turn, push = _GAP_TURN * gap, _GAP_PUSH * gap
    sigma = np.concatenate(
        [np.repeat((push * found.duration_s)[:, None], 3, 1), np.repeat(turn[:, None], 3, 1), np.repeat(push[:, None], 3, 1)],
        axis=1,
    )
    covariance = found.covariance.copy()
    covariance[:, np.arange(9), np.arange(9)] += sigma**2
    return replace(found, covariance=covariance, steps=np.maximum(found.steps, 2))


def imu_counted(at_rest: NDArray[np.bool_]) -> Floats:
    """(n − 1,) what the IMU between n successive poses is counted for, of what it is worth, given which of them are at rest.

    The margin that the odometry takes is for what a moving IMU gets wrong: scale, axes, what happens between samples. At rest
    there is the noise of the samples alone.
    """
    return np.where(at_rest[:-1] & at_rest[1:], MARGIN**-2, 1.0)


def add_bias_prior(problem: Problem, states: Variables) -> None:
    """What is known of the biases at the begin, and nothing of the velocity."""
    information = np.diag(np.concatenate([np.full(3, 1e-6), _BIAS_SIGMA**-2]))
    problem.add_residuals(Prior(Euclidean(9), np.zeros(9), information=information), states[:1], name="biases")


def _covering(run: FinishedRun, begin_ns: int, end_ns: int) -> tuple[NDArray[np.int64], Floats, Floats]:
    """The samples, the first and last one held as far as the scans reach."""
    time_ns, gyro, accel = run.imu.time_ns, run.imu.gyro, run.imu.accel
    if time_ns[0] > begin_ns:
        time_ns, gyro, accel = np.insert(time_ns, 0, begin_ns), np.vstack([gyro[:1], gyro]), np.vstack([accel[:1], accel])
    if time_ns[-1] < end_ns:
        time_ns, gyro, accel = np.append(time_ns, end_ns), np.vstack([gyro, gyro[-1:]]), np.vstack([accel, accel[-1:]])
    return time_ns, gyro, accel
