"""What the IMU measured between two frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.residuals.inertial.imu_preintegration import Preintegration
from boxplus.sensors.inertial.imu import ImuSamples


def imu_step(
    imu: ImuSamples, interval_ns: tuple[int, int], state: NDArray[np.float64], noise: ImuNoise, spare_ns: int = 0
) -> Preintegration:
    """The samples of an interval, preintegrated.

    Args:
        interval_ns: begin and end, in the clock of the samples.
        state: (9,) [v, b_a, b_g], whose biases are subtracted.
        spare_ns: of samples on both sides, so that the interval may be moved.
    """
    since, until = interval_ns
    first = max(int(np.searchsorted(imu.time_ns, since - spare_ns, side="right")) - 1, 0)
    last = int(np.searchsorted(imu.time_ns, until + spare_ns, side="left")) + 1
    return Preintegration.integrate(
        imu.time_ns[first:last],
        imu.gyro[first:last],
        imu.accel[first:last],
        noise=noise,
        intervals_ns=[since, until],
        bias_accel=state[3:6],
        bias_gyro=state[6:],
    )
