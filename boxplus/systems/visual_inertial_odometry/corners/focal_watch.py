"""Whether the focal lengths of two cameras go together, as the corners show that both of them see.

By how far corners lie off their epipolar lines (`epipolar_offsets.py`), least squares over those of the last keyframes tell a
focal length that is off by ε from a mounting that is turned by θ. Corners that lie farther off than `VioConfig.epipolar` were
taken for mistakes and are not among them. Those near the middle of the image tell of ε then, and the noisier they are, the
smaller it looks.

Source: docs/visual_inertial_odometry.md, "What counts as a contradiction".
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus.systems.visual_inertial_odometry.corners.epipolar_offsets import TURN_SIGMA, offset_sigmas, offsets, pairs_of_rays
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks
from boxplus.systems.visual_inertial_odometry.rig import Rig

_MEMORY = 0.9  # of the sums, per keyframe
_FEWEST = 30  # pairs of corners, as the sums remember them
_LEAST, _SIGMAS = 0.01, 6.0  # of ε: calibrations are exact to a few thousandths

Floats = NDArray[np.float64]


class FocalWatch:
    """Compares the focal length of every camera with that of the first, over the keyframes of the last seconds.

    Args:
        rig: one camera has nothing to be compared with.
        pixel_sigma: standard deviation of a corner along each axis [px].

    Attributes:
        longer: ε of every camera but the first (c − 1,), and sigma: (c − 1,) its standard deviation, infinite where too little
            was seen.
    """

    def __init__(self, rig: Rig, pixel_sigma: float) -> None:
        T = [camera.T_imu_camera for camera in rig.cameras]
        self._to_others = [np.linalg.inv(t) @ T[0] for t in T[1:]]
        self._sigmas = offset_sigmas(rig, pixel_sigma)
        self._H = np.zeros((len(self._to_others), 4, 4))  # of ε and θ
        self._b = np.zeros((len(self._to_others), 4))
        self._count = np.zeros(len(self._to_others))
        self.longer, self.sigma = np.zeros(len(self._to_others)), np.full(len(self._to_others), np.inf)

    def add(self, tracks: Tracks) -> None:
        """The corners of a keyframe."""
        for k, (T, sigma) in enumerate(zip(self._to_others, self._sigmas, strict=True)):
            _, rays, normals, seen = pairs_of_rays(tracks, k + 1, T)
            a, e = offsets(rays, normals)
            self._H[k] = _MEMORY * self._H[k] + a.T @ a / sigma**2
            self._b[k] = _MEMORY * self._b[k] + a.T @ e / sigma**2
            self._count[k] = _MEMORY * self._count[k] + seen
            if self._count[k] >= _FEWEST:
                P = np.linalg.inv(self._H[k] + np.diag([1.0, *[TURN_SIGMA**-2] * 3]))
                self.longer[k], self.sigma[k] = P[0] @ self._b[k], math.sqrt(P[0, 0])
            else:
                self.longer[k], self.sigma[k] = 0.0, np.inf

    @property
    def contradiction(self) -> str | None:
        """What contradicts, in a sentence; None where nothing does."""
        for k, (epsilon, sigma) in enumerate(zip(self.longer, self.sigma, strict=True), start=1):
            if abs(epsilon) > max(_LEAST, _SIGMAS * sigma):
                are = "longer" if epsilon > 0.0 else "shorter"
                return (
                    f"corners that cameras 0 and {k} both see fit a focal length of camera {k} that is "
                    f"about {100.0 * abs(epsilon):.1f} % {are} than calibrated, beside that of camera 0 (standard deviation "
                    f"{100.0 * sigma:.2f} %): check the focal lengths, and the image sizes they are for"
                )
        return None
