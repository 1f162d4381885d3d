"""A turn at a constant rate, which a bias of the gyroscope would explain as well, were it not too fast for one.

Where turns change, their changes show unit, sign and mounting of a gyroscope whatever its bias (`rotation`). A platform that goes
round at one rate shows its mean alone, g = R l + b of the gyroscope and l of the LiDAR, and b may be anything a bias can be. No
sensor's comes to 20 deg/s, though. Beyond that two mistakes explain a mean that nothing else does:

    the unit    g = 57.3 R l, or R l / 57.3
    the sign    g = −R l

Neither is looked for where the LiDAR does not turn: round surfaces may hide that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.lidar_inertial_agreement.finding import Finding
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath

_LARGEST_BIAS_RAD_S = np.deg2rad(20.0)
_DEGREES = 180.0 / np.pi
_AS_MEANT = 0.25  # of the rate, by which the mean may differ from what the mistake makes of it
_SLOWEST_RAD_S = np.deg2rad(3.0)
_KNOWN_RAD = 0.02  # attitude of a scan
_LEAST_SEEN = 0.5  # of the steps of a path


@dataclass(frozen=True, slots=True)
class SteadyTurn:
    """Mean rates of both sensors over the same time.

    Attributes:
        lidar: (3,) [rad/s], about the LiDAR's axes.
        gyro: (3,) in its own unit, about the IMU's axes.
    """

    lidar: NDArray[np.float64]
    gyro: NDArray[np.float64]

    def finding(self, R_imu_lidar: NDArray[np.float64] | None) -> Finding | None:
        """The mistake that explains both means where no bias does.

        Args:
            R_imu_lidar: (3, 3) mounting in use; without one only how fast they turn is compared, and no sign is told.
        """
        if np.linalg.norm(self.lidar) < _SLOWEST_RAD_S or self._off_by(1.0, R_imu_lidar) < _LARGEST_BIAS_RAD_S:
            return None
        how_fast = (
            f"the LiDAR turns steadily with {np.degrees(np.linalg.norm(self.lidar)):.1f} deg/s and the gyroscope says "
            f"{np.degrees(np.linalg.norm(self.gyro)):.1f} deg/s, which is no bias"
        )
        if self._means(_DEGREES, R_imu_lidar):
            text = f"{how_fast}: it reports deg/s; convert it to rad/s (reading a recording: --gyro-unit deg/s)"
            return Finding("gyro_unit", text)
        if self._means(1.0 / _DEGREES, R_imu_lidar):
            text = f"{how_fast}: its rates were taken for deg/s and are rad/s (reading a recording: --gyro-unit rad/s)"
            return Finding("gyro_unit", text)
        if R_imu_lidar is not None and self._means(-1.0, R_imu_lidar):
            text = (
                f"{how_fast}, the other way round: its sign is flipped (negate its rates), T_imu_lidar is half a turn off, or "
                "the points are mirrored"
            )
            return Finding("gyro_sign", text)
        return None

    def _off_by(self, factor: float, R_imu_lidar: NDArray[np.float64] | None) -> float:
        """The bias [unit of the gyroscope] that is left where it reads `factor` times the rate."""
        if R_imu_lidar is None:
            return float(abs(np.linalg.norm(self.gyro) - abs(factor) * np.linalg.norm(self.lidar)))
        return float(np.linalg.norm(self.gyro - factor * R_imu_lidar @ self.lidar))

    def _means(self, factor: float, R_imu_lidar: NDArray[np.float64] | None) -> bool:
        return self._off_by(factor, R_imu_lidar) < _AS_MEANT * abs(factor) * float(np.linalg.norm(self.lidar))


def steady_turn(path: LidarPath, imu: ImuSamples) -> SteadyTurn | None:
    """The mean rates over the steps of a path whose attitudes the scans show; None where that is less than half of them.

    Args:
        path: from `lidar_path`.
        imu: finite samples in order of time.
    """
    if len(path) < 2 or len(imu) < 2:
        return None
    known = np.linalg.eigvalsh(path.information[:, :3, :3])[:, 0] > _KNOWN_RAD**-2
    inside = (path.time_ns >= imu.time_ns[0]) & (path.time_ns <= imu.time_ns[-1])
    usable = known & inside
    steps = np.flatnonzero(usable[1:] & inside[:-1] & (path.segment[1:] == path.segment[:-1]))
    if len(steps) < _LEAST_SEEN * (len(path) - 1):
        return None
    turned = so3.log(np.swapaxes(path.R_path_lidar[steps], 1, 2) @ path.R_path_lidar[steps + 1])
    seconds = (path.time_ns[steps + 1] - path.time_ns[steps]) * 1e-9
    among = (imu.time_ns >= path.time_ns[steps[0]]) & (imu.time_ns <= path.time_ns[steps[-1] + 1])
    return SteadyTurn(turned.sum(axis=0) / seconds.sum(), imu.gyro[among].mean(axis=0)) if among.any() else None
