"""What direct odometry says about one frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion

Status = Literal["ok", "weak", "lost"]


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Pose, covariance and diagnosis of one frame.

    Attributes:
        time_ns: of the image [ns].
        T_world_camera: (7,) wxyz and xyz: the camera's pose. The world is the camera of the first frame, unless given.
        pose_covariance: (6, 6) of `[θ, p]`: rotation moved on the right (camera frame) [rad], position along the world's axes
            [m], relative to the first pose. It grows with the way. When lost, with time since the last pose.
        status: "ok"; "weak": the pose follows from the images, but there is a reason to doubt it; "lost": no pose follows,
            the last one is repeated.
        reasons: why the status is not "ok", one sentence each, with figures.
        keyframe: number of the keyframe that the frame was tracked against; is_keyframe: whether it became one itself.
        overlap: share of that keyframe's pixels seen; pixels: of them that were compared.
        sigma: robust standard deviation of the residuals [grey values of the keyframe]; residual_ratio: it by the median of
            frames before; NaN where there is none.
        brightness: (a, b) against the keyframe, I_keyframe = eᵃ I + b.
        finished_points: (n, 3) float32, of the map, in the world [m]: those of a keyframe that left the window with this frame,
            and that will not be adjusted any more.
        timing_s: seconds, by stage.

    Example:
        >>> camera, v = bp.Pinhole(100.0, 100.0, 63.5, 47.5), np.linspace(0.0, 20.0, 140)
        >>> wall = 100.0 + 40.0 * np.sin(v[None, :]) + 40.0 * np.cos(v[:96, None])
        >>> odometry = bp.DirectOdometry(camera)
        >>> estimate = odometry.push_rgbd(0, wall[:, :128], np.full((96, 128), 2.0))
        >>> estimate.status, estimate.is_keyframe, estimate.T_world_camera.shape, estimate.pose_covariance.shape
        ('ok', True, (7,), (6, 6))
    """

    time_ns: int
    T_world_camera: NDArray[np.float64]
    pose_covariance: NDArray[np.float64]
    status: Status
    reasons: tuple[str, ...]
    keyframe: int
    is_keyframe: bool
    overlap: float
    pixels: int
    sigma: float
    residual_ratio: float
    brightness: tuple[float, float]
    finished_points: NDArray[np.float32]
    timing_s: Mapping[str, float]

    @property
    def R_world_camera(self) -> NDArray[np.float64]:
        """(3, 3) rotation."""
        return quaternion.to_matrix(self.T_world_camera[:4])

    @property
    def p_world_camera(self) -> NDArray[np.float64]:
        """(3,) position [m]."""
        return self.T_world_camera[4:]
