"""Whether the cameras of a rig take their images at one instant, whatever the stamps say: what the corners that two see show.

A second camera whose image is taken later by τ has moved on by then. By its angular velocity ω and velocity v, in its own axes,
a point Y = R m + ρ t of it, m the ray of the first camera and ρ its inverse depth, is Y − τ (ω × Y + ρ v). Across the epipolar
line with normal n its ray y lies off by (`epipolar_offsets.py`)

    e ≈ −τ n · (ω × Y + ρ v) / (Y_z |n_xy|)

A mounting that is turned and another focal length, which `focal_watch.py` asks for, put rays off by the same whatever the motion,
and are asked for beside τ: it is told from them by motions that change, and by nothing else. Another distortion is not asked for:
on a straight way at one speed it looks like τ (2 px in the corners of a drive at 15 m/s: 5 ms), and the sentence says so.

Source: docs/visual_inertial_odometry.md, "What counts as a contradiction".
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus.systems.visual_inertial_odometry.corners.epipolar_offsets import TURN_SIGMA, offset_sigmas, offsets, pairs_of_rays
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks
from boxplus.systems.visual_inertial_odometry.corners.triangulation import inverse_depths
from boxplus.systems.visual_inertial_odometry.rig import Rig

_MEMORY = 0.95  # of the sums, per keyframe
_FEWEST = 100  # pairs of corners, as the sums remember them
_LEAST_S, _SIGMAS = 0.0015, 10.0  # of τ: stamps up to 1 ms apart are one instant, and corners without texture err together
_LATE_SIGMA = 0.1  # s, of τ beforehand

Floats = NDArray[np.float64]


class InstantWatch:
    """Compares when every camera takes its images with when the first one does, over the keyframes of the last seconds.

    Args:
        rig: one camera has nothing to be compared with.
        pixel_sigma: standard deviation of a corner along each axis [px].

    Attributes:
        late_s: τ of every camera but the first (c − 1,) [s], and sigma_s: (c − 1,) its standard deviation, infinite where too
            little was seen.
    """

    def __init__(self, rig: Rig, pixel_sigma: float) -> None:
        self._T_imu_camera = [camera.T_imu_camera for camera in rig.cameras]
        self._sigmas = offset_sigmas(rig, pixel_sigma)
        others = len(self._sigmas)
        self._H = np.zeros((others, 5, 5))  # of τ, the focal length and the mounting
        self._b = np.zeros((others, 5))
        self._squares, self._count = np.zeros(others), np.zeros(others)
        self.late_s, self.sigma_s = np.zeros(others), np.full(others, np.inf)

    def add(self, tracks: Tracks, rate: Floats, velocity: Floats) -> None:
        """The corners of a keyframe.

        Args:
            rate, velocity: (3,) of the IMU at its time, in the axes of the IMU [rad/s, m/s].
        """
        for k, (T, sigma) in enumerate(zip(self._T_imu_camera[1:], self._sigmas, strict=True)):
            T_other_first = np.linalg.inv(T) @ self._T_imu_camera[0]
            turned, rays, normals, _ = pairs_of_rays(tracks, k + 1, T_other_first)
            R_other_imu = T[:3, :3].T
            w, v = R_other_imu @ rate, R_other_imu @ (velocity + np.cross(rate, T[:3, 3]))
            still, e = offsets(rays, normals)
            t = np.ascontiguousarray(T_other_first[:3, 3])
            rho, _ = inverse_depths(turned, t, rays)
            Y = turned + rho[:, None] * t
            late = -(normals * (np.cross(w, Y) + rho[:, None] * v)).sum(axis=1) / Y[:, 2]
            a, e = np.column_stack([late, still]) / sigma, e / sigma
            self._H[k] = _MEMORY * self._H[k] + a.T @ a
            self._b[k] = _MEMORY * self._b[k] + a.T @ e
            self._squares[k] = _MEMORY * self._squares[k] + e @ e
            self._count[k] = _MEMORY * self._count[k] + len(e)
            self.late_s[k], self.sigma_s[k] = self._solved(k)

    def _solved(self, k: int) -> tuple[float, float]:
        """τ of a camera and its standard deviation, by what is left of the corners where that is more than their noise."""
        if self._count[k] < _FEWEST:
            return 0.0, math.inf
        P = np.linalg.inv(self._H[k] + np.diag([_LATE_SIGMA**-2, 1.0, *[TURN_SIGMA**-2] * 3]))
        x = P @ self._b[k]
        left = (self._squares[k] - self._b[k] @ x) / self._count[k]
        return float(x[0]), math.sqrt(max(left, 1.0) * P[0, 0])

    @property
    def contradiction(self) -> str | None:
        """What contradicts, in a sentence; None where nothing does."""
        for k, (late, sigma) in enumerate(zip(self.late_s, self.sigma_s, strict=True), start=1):
            if abs(late) > max(_LEAST_S, _SIGMAS * sigma):
                return (
                    f"corners that cameras 0 and {k} both see fit images of camera {k} that are taken "
                    f"{1e3 * late:+.1f} ms after those of camera 0, whatever their stamps say (standard deviation "
                    f"{1e3 * sigma:.2f} ms): trigger the cameras together, or stamp each image when it is taken; on a steady way "
                    "a lens that is distorted otherwise than it was calibrated looks the same"
                )
        return None
