"""What the IMU measured between two frames, and how little it says of times when it was silent."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.residuals.inertial.imu_preintegration import Preintegration
from boxplus.sensors.imu import ImuSamples

_GAP_ACCEL, _GAP_RATE = 3.0, 0.5  # m/s², rad/s: of what may happen while the IMU is silent


def imu_step(
    imu: ImuSamples, interval_ns: tuple[int, int], state: NDArray[np.float64], noise: ImuNoise, max_gap: float, spare_ns: int = 0
) -> Preintegration:
    """The samples of an interval, preintegrated.

    Args:
        interval_ns: begin and end, in the clock of the samples.
        state: (9,) [v, b_a, b_g], whose biases are subtracted.
        max_gap: longest time between samples that is integrated over as if nothing happened [s].
        spare_ns: of samples on both sides, so that the interval may be moved.
    """
    since, until = interval_ns
    first = max(int(np.searchsorted(imu.time_ns, since - spare_ns, side="right")) - 1, 0)
    last = int(np.searchsorted(imu.time_ns, until + spare_ns, side="left")) + 1
    step = Preintegration.integrate(
        imu.time_ns[first:last],
        imu.gyro[first:last],
        imu.accel[first:last],
        noise=noise,
        intervals_ns=[since, until],
        bias_accel=state[3:6],
        bias_gyro=state[6:],
    )
    gap = float(step.longest_gap_s[0])
    if gap > max_gap:
        # What happened meanwhile is not known; in the order [α, θ, β].
        spread = np.repeat([0.5 * _GAP_ACCEL * gap**2, _GAP_RATE * gap, _GAP_ACCEL * gap], 3)
        step.covariance[0][range(9), range(9)] += spread**2
    return step
