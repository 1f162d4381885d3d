"""What a start has to go by, and what it says where that is not enough."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import NavState
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import Frame, joined_imu
from boxplus.systems.lidar_inertial_agreement.agreement import gyro_guesses
from boxplus.systems.lidar_inertial_agreement.lidar_path.own_surfaces import show_little
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import with_cells_for
from boxplus.systems.lidar_inertial_agreement.rest import Rest
from boxplus.systems.lidar_inertial_odometry.config import LioConfig

_QUIET_GYRO, _QUIET_ACCEL = 0.1, 0.5  # rad/s, m/s²: standard deviations at rest where the LiDAR cannot tell
_FEWEST_QUIET_SAMPLES, _QUIET_TURN = 11, 0.03  # rad/s on average, an axis: the bias of a gyroscope in order
_PARTS, _STEADY_ACCEL = 5, 0.1  # m/s²: what means over a fifth of a second may differ by, besides what vibration leaves
_PATIENCE_S, _PATIENT_SCANS = 3.0, 30
_UPRIGHT = 0.98  # cosine of an axis and the vertical: 0.999 and more of those along which walls leave it open
WAITING = "; waiting for more data"
"""How a refusal ends that the next scans may lift."""


class NotYet(Exception):
    """Why there is no start yet; a sentence."""


class Beginning:
    """What a start has to go by: some scans, the IMU samples around them, and what has been found of both."""

    def __init__(self, frames: Sequence[Frame], config: LioConfig) -> None:
        self.frames, self.config = frames, config
        self.scans: list[Scan] = [frame.scan for frame in frames]
        self.registration: RegistrationConfig = with_cells_for(self.scans[0], config)
        self.imu = joined_imu(frames)
        self.extrinsic = NavState.identity(None if config.T_imu_lidar is None else np.array(config.T_imu_lidar))
        self.guesses = gyro_guesses(self.imu, self.extrinsic.R_imu_lidar)
        up = self.extrinsic.R_imu_lidar.T @ self.imu.accel.mean(axis=0)
        self.up_lidar: NDArray[np.float64] = up / max(float(np.linalg.norm(up)), 1e-9)
        self.duration_s = (self.scans[-1].end_ns - self.scans[0].start_ns) * 1e-9
        # What is in doubt may become clear; where it has not by now, a start says so.
        self.waited_long = self.duration_s >= _PATIENCE_S or len(self.scans) >= _PATIENT_SCANS
        self.accel_norm = float(np.linalg.norm(self.imu.accel.mean(axis=0)))
        self.gyro_std, self.accel_std = float(self.imu.gyro.std(axis=0).max()), float(self.imu.accel.std(axis=0).max())
        self.evidence = (
            f"gyro std {self.gyro_std:.3f} rad/s, accelerometer std {self.accel_std:.2f} m/s² around {self.accel_norm:.2f} m/s²"
        )

    def note(self, rest: Rest) -> None:
        self.evidence += f"; the LiDAR alone moves with {rest.speed * 100:.1f} cm/s and {np.degrees(rest.turn_rate):.2f} deg/s"

    def level(self, axes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Those of some axes (K, 3) of the LiDAR that lie across the vertical: hardly anything begins at a constant climb."""
        return axes[np.abs(axes @ self.up_lidar) < _UPRIGHT].reshape(-1, 3)

    def imu_is_quiet(self, rest: Rest) -> bool:
        """Whether the IMU shows nothing but vibration and biases, as it does at rest and at a constant speed."""
        if self.gyro_std >= _QUIET_GYRO or len(self.imu) < _FEWEST_QUIET_SAMPLES:
            return False
        turning = rest.open_turns @ self.extrinsic.R_imu_lidar.T @ self.imu.gyro.mean(axis=0)
        turns = bool(np.linalg.norm(turning) > _QUIET_TURN * np.sqrt(len(turning)))
        return not turns and (self.accel_std < _QUIET_ACCEL or _shaken_only(self.imu))

    def torn(self) -> NotYet:
        """Why there is no start on a path whose scans do not lie upon the ones before them."""
        little = show_little(self.scans, self.registration)
        if little:
            return NotYet(f"the surroundings do not show whether the platform moves: {little} ({self.evidence}){WAITING}")
        return NotYet(f"the first scans do not overlap enough to see whether they move ({self.evidence}){WAITING}")

    def not_moving(self, why: str) -> NotYet:
        return NotYet(f"not at rest ({self.evidence}), and {why}{WAITING}")


def broken(path: LidarPath) -> bool:
    """Whether scans of a path do not lie upon the ones before them."""
    return bool(path.failed or path.segment[-1] != path.segment[0])


def _shaken_only(imu: ImuSamples) -> bool:
    """Whether all that the accelerometer shows is vibration: its means over parts of the window agree as well as that allows."""
    parts = np.array_split(imu.accel, _PARTS)
    means = np.array([part.mean(axis=0) for part in parts if len(part)])
    allowed = _STEADY_ACCEL + imu.accel.std(axis=0) / np.sqrt(len(imu) / _PARTS)
    return bool((means.std(axis=0) < allowed).all())
