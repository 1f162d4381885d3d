"""Visual-inertial odometry: a sliding window of keyframes with IMU, landmarks and a prior of first estimates.

Source: Qin, Li and Shen, VINS-Mono, TRO 2018; Leutenegger et al., OKVIS, IJRR 2015; Usenko et al., Basalt, RA-L 2020.
"""

from __future__ import annotations

from typing import overload

from numpy.typing import ArrayLike

from boxplus.sensors.camera_image import CameraImage
from boxplus.sensors.imu import ImuSamples
from boxplus.systems.visual_inertial_odometry.config import VioConfig
from boxplus.systems.visual_inertial_odometry.estimate import VioEstimate
from boxplus.systems.visual_inertial_odometry.rig import Rig
from boxplus.systems.visual_inertial_odometry.start.start import Start


class VisualInertialOdometry:
    """Estimates the pose of an IMU from its samples and the images of cameras rigidly attached to it.

    Push IMU samples and images in the order of time; each call returns the estimates that have become ready, one for each instant
    at which images were taken (it waits for the images of all cameras, and for IMU samples up to it). Call `flush` at the end.

    Args:
        config: the settings; None for the defaults.
        rig: cameras and IMU.
    """

    def __init__(self, config: VioConfig | None, rig: Rig) -> None:
        self.config, self.rig = config or VioConfig(), rig
        self.start: Start | None = None
        self.start_problem: str | None = None

    @overload
    def push_imu(self, samples: ImuSamples) -> list[VioEstimate]: ...
    @overload
    def push_imu(self, samples: ArrayLike, gyro: ArrayLike, accel: ArrayLike) -> list[VioEstimate]: ...
    def push_imu(
        self, samples: ImuSamples | ArrayLike, gyro: ArrayLike | None = None, accel: ArrayLike | None = None
    ) -> list[VioEstimate]:
        """Take IMU samples, or times (N,) int64 [ns] with gyro (N, 3) [rad/s] and accel (N, 3) [m/s²]."""
        return []

    def push_image(self, image: CameraImage) -> list[VioEstimate]:
        """Take an image; returns the estimates that became ready."""
        return []

    def flush(self) -> list[VioEstimate]:
        """No more data will come: process what still waits."""
        return []
