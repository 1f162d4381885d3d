"""Which IMU samples can be measurements at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.imu import ImuSamples

GYRO_LIMIT, ACCEL_LIMIT = 100.0, 400.0  # rad/s, m/s²: more than any IMU on a robot measures


def finite(imu: ImuSamples) -> NDArray[np.bool_]:
    """(N,) which samples are numbers throughout."""
    return np.asarray(np.isfinite(imu.gyro).all(axis=1) & np.isfinite(imu.accel).all(axis=1))


def beyond(imu: ImuSamples) -> NDArray[np.bool_]:
    """(N,) which samples are larger than what any sensor measures; NaN is not."""
    return np.asarray((np.abs(imu.gyro) > GYRO_LIMIT).any(axis=1) | (np.abs(imu.accel) > ACCEL_LIMIT).any(axis=1))
