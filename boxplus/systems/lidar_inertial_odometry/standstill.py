"""Standstill after a start at rest: as long as nothing has moved, the velocity is known to be zero."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import T_V, TANGENT, P, V, boxplus_into
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.lidar_inertial_odometry.mounting.unknown_mounting import MOUNTING, mounting_known

_ZERO_VELOCITY_SIGMA = 0.01  # m/s
_MAX_DEVIATIONS = 5.0  # standard deviations of what the IMU's noise sums up to
_LEAST_SPEED, _LEAST_TURN = 0.015, 0.002  # m/s, rad: smaller changes are no motion
_MAX_DISPLACEMENT = 0.05  # m
_LENGTHS = (1, 2, 4, 8, 16)  # scans over which changes of velocity and attitude are summed up
_LONGEST_MEMORY_S = 5.0  # of the means at rest, which follow the biases
_BIAS_WALK = np.repeat([1e-4, 2e-3], 3)  # of cheap sensors [rad/s²/√Hz, m/s³/√Hz]: how far they are behind


class Standstill:
    """Watches a platform that started at rest and says when it leaves.

    Where the LiDAR sees a direction badly, an IMU that is only just initialised drifts along it within a second. Knowing
    that the platform rests keeps velocity, tilt and biases right until it moves. It counts as moving, for good, once what
    the IMU has measured beside its means at rest sums up, over one scan or up to sixteen, to more than its noise does (a
    lift sets off with a hundredth of g, which no single scan shows), or once the position has changed.

    Args:
        imu: samples during which the platform was at rest.
        p_world_imu: (3,) where it rests.
    """

    def __init__(self, imu: ImuSamples, p_world_imu: NDArray[np.float64]) -> None:
        self.active = True
        self._p_world_imu = p_world_imu
        self._mean = np.concatenate([imu.gyro.mean(axis=0), imu.accel.mean(axis=0)])
        seconds = max(float(imu.time_ns[-1] - imu.time_ns[0]) * 1e-9, 1e-3)
        # Of a sum of n samples over t seconds, std √n (t / n): what a second of white noise sums up to is the density.
        std = np.concatenate([imu.gyro.std(axis=0), imu.accel.std(axis=0)])
        self._density = std * np.sqrt(seconds / len(imu))
        self._memory_s = seconds
        self._recent: list[tuple[float, NDArray[np.float64]]] = []

    def update(
        self,
        imu: ImuSamples,
        seconds: float,
        x: NDArray[np.float64],
        cov: NDArray[np.float64],
        passed: NDArray[np.float64] | None,
    ) -> NDArray[np.float64] | None:
        """If the platform still rests, apply v = 0 to the state x (36,) and its covariance (24, 24), in place.

        Args:
            imu: the samples of a scan; seconds: how long it took [s].
            x, cov: the state predicted for its end.
            passed: (n, n) what the prediction has made of the first n errors of the state; None where nobody knows.

        Returns:
            (n, n) what is left of them now, with the mounting known.
        """
        displacement = np.linalg.norm(x[P : P + 3] - self._p_world_imu)
        if self._sets_off(imu, seconds) or displacement > _MAX_DISPLACEMENT:
            self.active = False
            return passed
        gain = _gain(cov)
        delta = np.zeros(TANGENT)
        delta[:] = -gain @ x[V : V + 3]
        boxplus_into(x, delta, x)
        # Joseph's form stays positive definite; the products round one triangle otherwise than the other.
        reduce = np.eye(TANGENT)
        reduce[:, T_V : T_V + 3] -= gain
        reduced = reduce @ cov @ reduce.T + _ZERO_VELOCITY_SIGMA**2 * gain @ gain.T
        known = mounting_known(cov)[0] if cov[MOUNTING, T_V].any() else cov
        left = np.eye(TANGENT)
        left[:, T_V : T_V + 3] -= _gain(known)
        cov[:] = 0.5 * (reduced + reduced.T)
        return None if passed is None else left[: len(passed), : len(passed)] @ passed

    def _sets_off(self, imu: ImuSamples, seconds: float) -> bool:
        """Whether the turns and changes of velocity of the last scans are more than noise, over any of the lengths."""
        if len(imu):
            self._recent.append((seconds, np.concatenate([imu.gyro.mean(axis=0), imu.accel.mean(axis=0)])))
        least = np.repeat([_LEAST_TURN, _LEAST_SPEED], 3)
        total, summed = 0.0, np.zeros(6)
        for count, (duration, mean) in enumerate(reversed(self._recent), start=1):
            total += duration
            summed += duration * (mean - self._mean)
            # The noise of these scans, that of the means at rest, which counts over all of them, and of the biases since.
            white = self._density**2 * (total + total**2 / self._memory_s)
            noise = np.sqrt(white + _BIAS_WALK**2 * (total + self._memory_s / 2.0) * total**2)
            if count in _LENGTHS and np.any(np.abs(summed) > np.maximum(_MAX_DEVIATIONS * noise, least)):
                return True
        if len(self._recent) > _LENGTHS[-1]:
            duration, mean = self._recent.pop(0)
            self._memory_s = min(self._memory_s + duration, _LONGEST_MEMORY_S)
            self._mean += (mean - self._mean) * min(duration / self._memory_s, 1.0)
        return False


def _gain(cov: NDArray[np.float64]) -> NDArray[np.float64]:
    """(24, 3) by which a state of covariance (24, 24) follows its velocity, where that is known to be zero."""
    columns = cov[:, T_V : T_V + 3]
    innovation = columns[T_V : T_V + 3] + _ZERO_VELOCITY_SIGMA**2 * np.eye(3)
    return np.asarray(np.linalg.solve(innovation, columns.T).T, dtype=np.float64)
