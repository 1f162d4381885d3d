"""What carries the sensors: the cameras, where they sit on the IMU, and how much the IMU errs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats
from boxplus.cameras.model import CameraModel
from boxplus.errors import InputError
from boxplus.manifolds import quaternion
from boxplus.recordings.cameras.calibration import LONGEST_READOUT_S
from boxplus.residuals.inertial.imu_noise import ImuNoise

CAUTIOUS_NOISE = ImuNoise(gyro=2e-3, accel=2e-2, gyro_walk=1e-4, accel_walk=1e-3)
"""For an IMU of which nothing is known: that of a cheap one, vibration included."""

_ROTATION_ERROR = 1e-6


@dataclass(frozen=True, slots=True)
class RigCamera:
    """One camera of a rig.

    Attributes:
        model: projection of points in the camera frame (z forward, x to the right, y down).
        T_imu_camera: (4, 4), camera coordinates to IMU coordinates.
        width, height: of its images [px].
        line_delay_s: time from row to row of a rolling shutter, negative from below; the middle row is taken at the stamp [s].
    """

    model: CameraModel
    T_imu_camera: NDArray[np.float64]
    width: int
    height: int
    line_delay_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Rig:
    """One or more cameras and an IMU, rigidly connected.

    Attributes:
        cameras: in the order of `CameraImage.camera`.
        noise: of the IMU, as the calibration states it.
        mountings: (c, 7) T_imu_camera, wxyz and xyz.

    Example:
        >>> camera = bp.Pinhole(458.7, 457.3, 367.2, 248.4)
        >>> left, right = np.eye(4), np.eye(4)
        >>> right[0, 3] = 0.11
        >>> rig = bp.Rig.of([camera, camera], [left, right], [(752, 480)] * 2)
        >>> rig.mountings[1]
        array([1.  , 0.  , 0.  , 0.  , 0.11, 0.  , 0.  ])
    """

    cameras: tuple[RigCamera, ...]
    noise: ImuNoise
    mountings: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        models: Sequence[CameraModel],
        T_imu_camera: Sequence[ArrayLike],
        sizes: Sequence[tuple[int, int]],
        noise: ImuNoise | None = None,
        line_delays_s: Sequence[float] | None = None,
    ) -> Rig:
        """From models, mountings (4, 4) and sizes (width, height) of the cameras, in the order of `CameraImage.camera`.

        Args:
            noise: of the IMU; that of a cheap one where it is not known.
            line_delays_s: of each camera with a rolling shutter, from row to row [s]; 0 where all rows are taken at once, as they
                are if left out.

        Raises:
            InputError: no camera, lists of different lengths, a mounting that is no rigid transform, a size that is not positive;
                a shutter that takes longer than 0.2 s.
        """
        delays = [0.0] * len(models) if line_delays_s is None else list(line_delays_s)
        if not models or not len(models) == len(T_imu_camera) == len(sizes) == len(delays):
            got = f"{len(models)} models, {len(T_imu_camera)} mountings, {len(sizes)} sizes, {len(delays)} line delays"
            raise InputError("a model, a mounting and a size for each camera, one at least", got, "complete the calibration")
        cameras = []
        for number, (model, mounting, size, delay) in enumerate(zip(models, T_imu_camera, sizes, delays, strict=True)):
            T = np.array(as_floats(mounting, f"T_imu_camera of camera {number}"))
            rigid = T.shape == (4, 4) and np.isfinite(T).all() and np.allclose(T[3], (0, 0, 0, 1))
            if not rigid or np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > _ROTATION_ERROR or np.linalg.det(T[:3, :3]) < 0:
                got = f"{T.tolist()} for camera {number}"
                raise InputError("T_imu_camera as a rotation and a translation (4, 4)", got, "check the calibration")
            if min(size) < 1:
                raise InputError("a size (width, height) of one pixel at least", f"{size}", "give that of the images")
            if not abs(delay) * size[1] <= LONGEST_READOUT_S:
                got = f"{delay} s from row to row of {size[1]} rows of camera {number}"
                raise InputError(f"a shutter of at most {LONGEST_READOUT_S} s", got, "line delays are in seconds")
            cameras.append(RigCamera(model, T, int(size[0]), int(size[1]), float(delay)))
        mountings = np.array([[*quaternion.from_matrix(c.T_imu_camera[:3, :3]), *c.T_imu_camera[:3, 3]] for c in cameras])
        return cls(tuple(cameras), CAUTIOUS_NOISE if noise is None else noise, mountings)
