"""What speaks against the sensors of a rig, frame by frame: the way by the IMU alone, and the cameras among themselves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion
from boxplus.residuals.inertial.imu_preintegration import Preintegration
from boxplus.systems.visual_inertial_odometry.corners.focal_watch import FocalWatch
from boxplus.systems.visual_inertial_odometry.corners.instant_watch import InstantWatch
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks
from boxplus.systems.visual_inertial_odometry.inertial_watch import InertialWatch
from boxplus.systems.visual_inertial_odometry.rig import Rig

Floats = NDArray[np.float64]


class SensorWatches:
    """Watches over the way, the focal lengths and the instants of the images.

    Args:
        rig: cameras and IMU.
        pixel_sigma: standard deviation of a corner along each axis [px].
        gravity: magnitude [m/s²].
    """

    def __init__(self, rig: Rig, pixel_sigma: float, gravity: float) -> None:
        self._inertial = InertialWatch(gravity)
        self._focal, self._instants = FocalWatch(rig, pixel_sigma), InstantWatch(rig, pixel_sigma)

    def add(self, pose: Floats, state: Floats, covariance: Floats, step: Preintegration | None) -> None:
        """The newest frame, see `InertialWatch.add`."""
        self._inertial.add(pose, state, covariance, step)

    def add_keyframe(self, tracks: Tracks, pose: Floats, state: Floats, rate: Floats) -> None:
        """The corners of a keyframe in motion: the same view again has the same errors.

        Args:
            pose: (7,) T_world_imu; state: (9,) [v, b_a, b_g]; rate: (3,) that the gyroscope measured at its time [rad/s].
        """
        self._focal.add(tracks)
        self._instants.add(tracks, rate - state[6:], quaternion.to_matrix(pose[:4]).T @ state[:3])

    @property
    def among_cameras(self) -> str | None:
        """What contradicts the cameras beside each other, in a sentence; None where nothing does."""
        return self._instants.contradiction or self._focal.contradiction

    @property
    def apart(self) -> str | None:
        """How the way of the cameras and the IMU's contradict each other, in a sentence; None where they do not."""
        return self._inertial.contradiction

    @property
    def lengths(self) -> tuple[float, float]:
        """See `InertialWatch.length`."""
        return self._inertial.length
