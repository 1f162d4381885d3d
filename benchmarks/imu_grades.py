"""The inertial sensors that campaigns draw from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from boxplus.simulation import ImuModel

# density of gyro [rad/s/√Hz] and accelerometer [m/s²/√Hz], walks of both biases, largest biases [rad/s], [m/s²]
IMU_GRADES: dict[str, tuple[float, ...]] = {
    "tactical": (3e-5, 3e-4, 2e-6, 3e-5, 1e-3, 0.01),
    "industrial": (1.7e-4, 2e-3, 1.9e-5, 1e-3, 0.01, 0.06),
    "cheap": (4e-4, 4e-3, 5e-5, 2e-3, 0.03, 0.25),
}


def draw_imu(grade: str, rates_hz: Sequence[float], random: np.random.Generator) -> ImuModel:
    """A sensor of this grade, at one of these rates, with random biases."""
    gyro, accel, gyro_walk, accel_walk, gyro_bias, accel_bias = IMU_GRADES[grade]
    return ImuModel(
        rate_hz=float(random.choice(rates_hz)),
        gyro_noise_density=gyro,
        accel_noise_density=accel,
        gyro_bias_walk=gyro_walk,
        accel_bias_walk=accel_walk,
        gyro_bias=tuple(random.uniform(-gyro_bias, gyro_bias, 3)),
        accel_bias=tuple(random.uniform(-accel_bias, accel_bias, 3)),
    )
