"""How much noise the samples of an IMU show, whatever its data sheet says."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.inertial.imu import ImuSamples

# White noise of variance σ² makes second differences of variance (1 + 4 + 1) σ²; a body in motion, hardly any.
_SECOND_DIFFERENCE = 6.0


def sample_noise(imu: ImuSamples) -> NDArray[np.float64]:
    """Densities (2, 3) of what differs from sample to sample, by axis: gyroscope [rad/s/√Hz], accelerometer [m/s²/√Hz].

    Vibration is in it, as far as the sensor does not filter it out; errors of scale, of axes and of the clock are not.

    Args:
        imu: at least three samples, at a steady rate.

    Example:
        >>> rest = ImuSamples.from_arrays(np.arange(5) * 5_000_000, np.zeros((5, 3)), np.full((5, 3), 9.8))
        >>> sample_noise(rest).max()
        np.float64(0.0)
    """
    steps = np.sort(np.diff(imu.time_ns))
    step_s = 0.5e-9 * float(steps[(len(steps) - 1) // 2] + steps[len(steps) // 2])  # their median
    values = np.concatenate([imu.gyro, imu.accel], axis=1)
    second = values[2:] - 2.0 * values[1:-1] + values[:-2]
    squares = np.einsum("ij,ij->j", second, second).reshape(2, 3) / len(second)
    noise: NDArray[np.float64] = np.sqrt(squares / _SECOND_DIFFERENCE * step_s)
    return noise
