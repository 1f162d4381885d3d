"""How noisy the IMU is as it is mounted and moved, told from its samples.

What vibrates differs from sample to sample. A gyroscope whose scale or axes are off by a share s of what it measures errs by
s |ω| as long as it turns one way, and the other way when it turns back: over a second, as if by noise of density s |ω|.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.inertial.imu_noise import sample_noise
from boxplus.systems.lidar_inertial_odometry.config import LioConfig

# Densities of gyroscope [rad/s/√Hz] and accelerometer [m/s²/√Hz]: of one that a motor or a gait shakes, as two real flights
# showed against their ground truth over 1 to 4 s, and of one that moves smoothly, which is believed more, though its clock
# is never exact.
_SHAKEN = np.array([2e-3, 5e-2])
_SMOOTH = np.array([5e-4, 5e-3])
_MARGIN = 5.0  # the filter's density over that of the samples: what they do not show, and what has been filtered out of them
_MEMORY_S = 1.0
_FEWEST_SAMPLES = 5


class ObservedNoise:
    """Follows the densities of gyroscope and accelerometer from scan to scan; settings that are given stay as they are.

    Args:
        config: its noises, what turning adds, and walks of biases.
    """

    def __init__(self, config: LioConfig) -> None:
        given = (config.gyro_noise, config.accel_noise)
        self._most = np.array([most if value is None else value for most, value in zip(_SHAKEN, given, strict=True)])
        self._least = np.array([least if value is None else value for least, value in zip(_SMOOTH, given, strict=True)])
        self._walks = np.array([config.gyro_bias_walk, config.accel_bias_walk])
        self._of_turning = config.gyro_scale_noise
        self._seen: NDArray[np.float64] | None = None
        self._rate_sq = 0.0  # mean square of the turn rate [rad²/s²]

    def update(self, imu: ImuSamples) -> NDArray[np.float64]:
        """Look at the samples of a scan; returns the squared densities (4,) to carry the state over it with."""
        if len(imu):
            self._rate_sq = float(np.einsum("ij,ij->", imu.gyro, imu.gyro)) / len(imu)
        if len(imu) < _FEWEST_SAMPLES:
            self._seen = None
        else:
            now = (sample_noise(imu) ** 2).mean(axis=1)
            seconds = float(imu.time_ns[-1] - imu.time_ns[0]) * 1e-9
            before = now if self._seen is None else self._seen
            # What begins to shake is believed at once, what seems to have ended only after a while.
            self._seen = np.maximum(now, before + min(seconds / _MEMORY_S, 1.0) * (now - before))
        return self.density

    @property
    def density(self) -> NDArray[np.float64]:
        """(4,) squared, as of the last scan: gyroscope, accelerometer, walks of their biases; the most where nothing is known."""
        noise = self._most if self._seen is None else np.clip(_MARGIN * np.sqrt(self._seen), self._least, self._most)
        density: NDArray[np.float64] = np.concatenate([noise, self._walks]) ** 2
        density[0] += self._of_turning**2 * self._rate_sq
        return density
