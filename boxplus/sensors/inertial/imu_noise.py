"""How much noise the samples of an IMU show, whatever its data sheet says."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.sensors.inertial.imu import ImuSamples

# White noise of variance σ² makes second differences of variance (1 + 4 + 1) σ²; a body in motion, hardly any.
_SECOND_DIFFERENCE = 6.0


def sample_noise(imu: ImuSamples) -> NDArray[np.float64]:
    """Densities (2, 3) of what differs from sample to sample, by axis: gyroscope [rad/s/√Hz], accelerometer [m/s²/√Hz].

    Vibration is in it, as far as the sensor does not filter it out; errors of scale, of axes and of the clock are not.

    Args:
        imu: at a steady rate; fewer than three samples show nothing.

    Example:
        >>> rest = ImuSamples.from_arrays(np.arange(5) * 5_000_000, np.zeros((5, 3)), np.full((5, 3), 9.8))
        >>> sample_noise(rest).max()
        np.float64(0.0)
    """
    if len(imu) < 3:
        return np.zeros((2, 3))  # no second difference shows any
    steps = np.sort(np.diff(imu.time_ns))
    step_s = 0.5e-9 * float(steps[(len(steps) - 1) // 2] + steps[len(steps) // 2])  # their median
    noise = np.zeros((2, 3))
    for sensor, values in enumerate((imu.gyro, imu.accel)):
        _second_differences_into(values, step_s / (_SECOND_DIFFERENCE * (len(imu) - 2)), noise[sensor])
    return noise


@kernel
def _second_differences_into(values: NDArray[np.float64], scale: float, roots: NDArray[np.float64]) -> None:
    """√(scale × the sum of squares) of the second differences of (n, 3), by axis, into zeros (3,)."""
    for k in range(2, len(values)):
        for axis in range(3):
            roots[axis] += (values[k, axis] - 2.0 * values[k - 1, axis] + values[k - 2, axis]) ** 2
    for axis in range(3):
        roots[axis] = math.sqrt(scale * roots[axis])
