"""Standstill after a start at rest: as long as nothing has moved, the velocity is known to be zero."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import T_V, TANGENT, P, V, boxplus_into
from boxplus.sensors.imu import ImuSamples

_ZERO_VELOCITY_SIGMA = 0.01  # m/s
_MAX_DEVIATIONS = 4.0  # standard deviations of a scan's mean from the mean at rest
_LEAST_ACCEL, _LEAST_GYRO = 0.05, 0.005  # m/s², rad/s: smaller deviations are no motion
_MAX_DISPLACEMENT = 0.05  # m


class Standstill:
    """Watches a platform that started at rest and says when it leaves.

    Where the LiDAR sees a direction badly, an IMU that is only just initialised drifts along it within a second. Knowing
    that the platform rests keeps velocity, tilt and biases right until it moves. It counts as moving, for good, once the
    mean of the IMU over a scan or the position has changed by more than noise.

    Args:
        imu: samples during which the platform was at rest.
        p_world_imu: (3,) where it rests.
    """

    def __init__(self, imu: ImuSamples, p_world_imu: NDArray[np.float64]) -> None:
        self.active = True
        self._p_world_imu = p_world_imu
        self._gyro, self._accel = imu.gyro.mean(axis=0), imu.accel.mean(axis=0)
        self._gyro_std, self._accel_std = imu.gyro.std(axis=0), imu.accel.std(axis=0)

    def update(self, imu: ImuSamples, x: NDArray[np.float64], cov: NDArray[np.float64]) -> None:
        """If the platform still rests, apply v = 0 to the state x (36,) and its covariance (24, 24), in place."""
        root = np.sqrt(len(imu))
        gyro_off = np.abs(imu.gyro.mean(axis=0) - self._gyro) - _MAX_DEVIATIONS * self._gyro_std / root
        accel_off = np.abs(imu.accel.mean(axis=0) - self._accel) - _MAX_DEVIATIONS * self._accel_std / root
        displacement = np.linalg.norm(x[P : P + 3] - self._p_world_imu)
        if gyro_off.max() > _LEAST_GYRO or accel_off.max() > _LEAST_ACCEL or displacement > _MAX_DISPLACEMENT:
            self.active = False
        if not self.active:
            return
        columns = cov[:, T_V : T_V + 3]
        innovation = cov[T_V : T_V + 3, T_V : T_V + 3] + _ZERO_VELOCITY_SIGMA**2 * np.eye(3)
        gain = np.linalg.solve(innovation, columns.T).T
        delta = np.zeros(TANGENT)
        delta[:] = -gain @ x[V : V + 3]
        boxplus_into(x, delta, x)
        # Joseph's form stays positive definite.
        reduce = np.eye(TANGENT)
        reduce[:, T_V : T_V + 3] -= gain
        cov[:] = reduce @ cov @ reduce.T + _ZERO_VELOCITY_SIGMA**2 * gain @ gain.T
