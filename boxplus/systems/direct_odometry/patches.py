"""The points of a keyframe that the window adjusts: patches of eight pixels with one inverse depth each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.pinhole import Pinhole
from boxplus.residuals.camera.photometric import DSO_PATTERN
from boxplus.systems.direct_alignment.keyframe_kernel import select_pixels
from boxplus.systems.direct_odometry.depth.sensed_depth import SensedDepth

Matrix = NDArray[np.float64]
_OFFSETS = np.array(DSO_PATTERN)
_CENTRE = int(np.flatnonzero(~_OFFSETS.any(axis=1))[0])
_GUESSED = 0.5  # standard deviation, by the depth, of one that came from the images themselves
_KNOWN = 0.1  # standard deviation of a depth, by the depth, up to which a point enters the map
_REACH = 2  # pixels of the pattern, and one more for gradients
_SAME_SURFACE = 0.1  # share of the depth by which pixels of a patch may differ
_STEEP = 50.0 / 255.0  # of the range of grey values and pixel: from there on a gradient says less of geometry than of its errors


@dataclass(slots=True, eq=False)
class Patches:
    """Patches of one keyframe.

    Attributes:
        pixels: (n, 2) u, v of the centres.
        rays: (n, 8, 2) of z = 1; grey, share: (n, 8) of each pixel, and its weight, c²/(c² + |∇I|²).
        tilt: (n, 8) inverse depth of each pixel by that of the centre.
        rho: (n,) inverse depth [1/m], estimated.
        measured: (n,) as the sensor measured it; information: (n,) of that [m²].
        deviation: (n,) standard deviation of the depth that it began with, by the depth.
    """

    pixels: Matrix
    rays: Matrix
    grey: Matrix
    share: Matrix
    tilt: Matrix
    rho: Matrix
    measured: Matrix
    information: Matrix
    deviation: Matrix

    def __len__(self) -> int:
        return len(self.rho)

    def points(self) -> Matrix:
        """(k, 3) centres of those whose depth is known to a tenth, in the camera's frame [m]."""
        known = self.deviation < _KNOWN
        rays = self.rays[known, _CENTRE]
        return np.column_stack([rays, np.ones(len(rays))]) / self.rho[known, None]

    def keep(self, kept: NDArray[np.bool_]) -> None:
        """Forget the others."""
        for name in ("pixels", "rays", "grey", "share", "tilt", "rho", "measured", "information", "deviation"):
            setattr(self, name, np.ascontiguousarray(getattr(self, name)[kept]))


def choose_patches(grey: NDArray[np.float32], sensed: SensedDepth, camera: Pinhole, count: int) -> Patches:
    """About `count` patches with depth, of steep gradients, spread over the image.

    Args:
        grey: (H, W); sensed: depths, measured or not; those that are not say next to nothing beside the images.
    """
    depth = sensed.z
    height, width = grey.shape
    inner = np.zeros_like(depth)
    border = _REACH + 1
    inner[border:-border, border:-border] = depth[border:-border, border:-border]
    cell = max(int(np.sqrt(height * width / max(count, 1))), 1)
    most = -(-height // cell) * -(-width // cell)
    pixels, gradients, values = (np.empty((most, 2)) for _ in range(3))
    found = select_pixels(grey, inner, cell, False, pixels, gradients, values)
    centres = pixels[:found].astype(np.int64)
    of_pattern = centres[:, None, :] + _OFFSETS
    u, v = of_pattern[..., 0], of_pattern[..., 1]
    slope = np.hypot(grey[v, u + 1] - grey[v, u - 1], grey[v + 1, u] - grey[v - 1, u]).astype(np.float64) / 2.0
    steep = max(_STEEP * float(grey.max() - grey.min()), 1e-30)
    rays, seen = camera.unproject(of_pattern.astype(np.float64))
    kept = np.asarray(seen.all(axis=1) & (slope.max(axis=1) > 0.0))
    row, column = centres[:, 1], centres[:, 0]
    z, sigma = depth[row, column].astype(np.float64), sensed.sigma[row, column].astype(np.float64)
    prior = np.where(sensed.is_measured[row, column], sigma, _GUESSED * z)
    rho = 1.0 / z
    tilt = _tilt(depth[v, u].astype(np.float64), z)
    patches = Patches(
        pixels[:found], rays[..., :2], grey[v, u].astype(np.float64), 1.0 / (1.0 + (slope / steep) ** 2), tilt, rho, rho.copy(),
        (z * z / prior) ** 2, sigma / z,
    )  # fmt: skip
    patches.keep(kept)
    return patches


def _tilt(z: Matrix, centre: Matrix) -> Matrix:
    """Inverse depths (n, 8) by that of the centre, 1 + α du + β dv as on a plane, by least squares; 1 where one is missing."""
    same: NDArray[np.bool_] = (z > 0.0) & (np.abs(z - centre[:, None]) < _SAME_SURFACE * centre[:, None])
    ratio = np.where(same, centre[:, None] / np.where(same, z, 1.0) - 1.0, 0.0)
    D = _OFFSETS.astype(np.float64)
    slope = ratio @ D @ np.linalg.inv(D.T @ D)
    is_plane = np.asarray(np.all(same, axis=1))
    return np.where(is_plane[:, None], 1.0 + slope @ D.T, 1.0)
