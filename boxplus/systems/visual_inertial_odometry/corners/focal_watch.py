"""Whether the focal lengths of two cameras go together, as the corners show that both of them see.

A camera whose focal length is 1 + ε times what it was calibrated for shows its rays (1 + ε) times as far from the middle. Across
the epipolar line with normal n = t × R m of a ray m of the first camera, y in the other one then lies off by

    e = n · y / |n_xy| ≈ ε (n_xy · y_xy) / |n_xy| + θ · (y × n) / |n_xy|

beside a mounting that is turned by θ. Least squares over the corners of the last keyframes tell ε from θ. Corners that lie
farther off than `VioConfig.epipolar` were taken for mistakes and are not among them. Those near the middle of the image tell of ε
then, and the noisier they are, the smaller it looks.

Source: docs/visual_inertial_odometry.md, "What counts as a contradiction".
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks
from boxplus.systems.visual_inertial_odometry.rig import Rig

_MEMORY = 0.9  # of the sums, per keyframe
_FEWEST = 30  # pairs of corners, as the sums remember them
_LEAST, _SIGMAS = 0.01, 6.0  # of ε: calibrations are exact to a few thousandths
_TURN_SIGMA = 0.05  # rad, of θ beforehand

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
        own = rig.cameras[0].model.fx
        self._sigmas = [pixel_sigma * math.hypot(1.0 / own, 1.0 / camera.model.fx) for camera in rig.cameras[1:]]
        self._H = np.zeros((len(self._to_others), 4, 4))  # of ε and θ
        self._b = np.zeros((len(self._to_others), 4))
        self._count = np.zeros(len(self._to_others))
        self.longer, self.sigma = np.zeros(len(self._to_others)), np.full(len(self._to_others), np.inf)

    def add(self, tracks: Tracks) -> None:
        """The corners of a keyframe."""
        for k, (T, sigma) in enumerate(zip(self._to_others, self._sigmas, strict=True)):
            self._H[k] *= _MEMORY
            self._b[k] *= _MEMORY
            both = np.isfinite(tracks.rays[:, k + 1, 0])
            self._count[k] = _MEMORY * self._count[k] + np.count_nonzero(both)
            first, other = tracks.rays[both, 0], tracks.rays[both, k + 1]
            _add_pairs(first @ T[:3, :3].T, np.ascontiguousarray(T[:3, 3]), other, 1.0 / sigma, self._H[k], self._b[k])
            if self._count[k] >= _FEWEST:
                P = np.linalg.inv(self._H[k] + np.diag([1.0, *[_TURN_SIGMA**-2] * 3]))
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


@kernel
def _add_pairs(turned: Floats, t: Floats, rays: Floats, weight: float, H: Floats, b: Floats) -> None:
    """H += Σ a aᵀ and b += Σ a e of pairs (n, 3) of rays, e and its slopes a (4,) times `weight`."""
    a = np.empty(4)
    for k in range(len(rays)):
        x, y, z = turned[k, 0], turned[k, 1], turned[k, 2]
        n0, n1, n2 = t[1] * z - t[2] * y, t[2] * x - t[0] * z, t[0] * y - t[1] * x
        length = math.sqrt(n0 * n0 + n1 * n1)
        if not length > 0.0:  # a ray along the baseline
            continue
        scale = weight / length
        u, v = rays[k, 0], rays[k, 1]
        e = scale * (n0 * u + n1 * v + n2)
        a[0] = scale * (n0 * u + n1 * v)
        a[1], a[2], a[3] = scale * (v * n2 - n1), scale * (n0 - u * n2), scale * (u * n1 - v * n0)
        for i in range(4):
            b[i] += a[i] * e
            for j in range(4):
                H[i, j] += a[i] * a[j]
