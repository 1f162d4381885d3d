"""How much an IMU errs, as data sheets and Allan deviations say."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Noise densities, as data sheets and Allan deviations give them.

    Attributes:
        gyro: rad/s/√Hz.
        accel: m/s²/√Hz.
        gyro_walk: of the gyroscope's bias, rad/s²/√Hz.
        accel_walk: of the accelerometer's bias, m/s³/√Hz.
        gap_gyro: how angular velocity wanders between two samples that are more than 0.1 s apart, rad/s/√s; 0 where it is taken
            for linear there (docs/residuals/imu_preintegration.md, gaps).
        gap_accel: the same of specific force, m/s²/√s.

    Raises:
        InputError: a density that is not positive and finite: the covariance would be singular; a negative one within gaps.

    Example:
        >>> noise = bp.residuals.ImuNoise(gyro=1.7e-4, accel=2e-3, gyro_walk=1.9e-5, accel_walk=3e-3)
        >>> noise.gyro
        0.00017
    """

    gyro: float
    accel: float
    gyro_walk: float
    accel_walk: float
    gap_gyro: float = 0.0
    gap_accel: float = 0.0

    def __post_init__(self) -> None:
        for name in ("gyro", "accel", "gyro_walk", "accel_walk"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise InputError(
                    f"the noise density {name} positive and finite",
                    f"{value}",
                    "take it from the data sheet; a bias that does not change has a small one",
                )
        for name in ("gap_gyro", "gap_accel"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(f"{name} finite and not negative", f"{value}", "0 takes what happens in a gap for linear")

    @property
    def variances(self) -> NDArray[np.float64]:
        """Squared densities (6,): gyroscope, accelerometer, gyroscope bias, accelerometer bias, and both within gaps."""
        densities = self.gyro, self.accel, self.gyro_walk, self.accel_walk, self.gap_gyro, self.gap_accel
        return np.square(np.array(densities, dtype=np.float64))
