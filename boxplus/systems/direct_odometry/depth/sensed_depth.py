"""Depths of a frame with their standard deviations: measured by the sensor, or found in the second image of a stereo camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.cameras.model import CameraModel, check_pinhole
from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.manifolds.se3 import SE3Left
from boxplus.sensors.images.image import Image
from boxplus.systems.direct_odometry.depth.agreement import agreed
from boxplus.systems.direct_odometry.depth.epipolar_kernel import FOUND
from boxplus.systems.direct_odometry.depth.epipolar_search import View, cell_size, choose_candidates, search

Depths = NDArray[np.float32]

_NEAREST, _FARTHEST = 0.05, 100.0  # [m] between which the median of measured depths must lie
_LEAST_NOISE = 1e-3  # share of the depth
_WIDEST = 0.12  # disparities looked at, by the width of the image
_MOST_SHARE = 0.3  # of a depth that its standard deviation may be


@dataclass(frozen=True, slots=True, eq=False)
class SensedDepth:
    """Depths of a frame.

    Attributes:
        z: (H, W) along the optical axis [m], 0 where there is none; sigma: (H, W) standard deviations [m].
        is_measured: (H, W) whether a sensor says so, and not the images that the window adjusts anyway.
    """

    z: Depths
    sigma: Depths
    is_measured: NDArray[np.bool_]

    def filled(self, other: SensedDepth) -> SensedDepth:
        """With another's depths where there are none."""
        empty = self.z == 0.0
        z, sigma = np.where(empty, other.z, self.z), np.where(empty, other.sigma, self.sigma)
        return SensedDepth(z, sigma, np.where(empty, other.is_measured, self.is_measured))


def rgbd_depth(depth: ArrayLike, image: Image, noise: tuple[float, float, float]) -> SensedDepth:
    """Depths that a sensor measured, with σ_z = a + b (z − c)² above c (Nguyen, Izadi and Lovell, 3DIMPVT 2012).

    Raises:
        InputError: another shape than the image's, negative, or depths that are no metres.
    """
    z = np.array(depth, dtype=np.float32)
    if z.shape != image.shape:
        raise InputError(f"depth of shape {image.shape}, as the image", f"shape {z.shape}", "register the depth to the image")
    z[~np.isfinite(z)] = 0.0
    if z.min() < 0.0:
        raise InputError("depth not negative [m]", f"{z.min()}", "mark pixels without depth by 0 or NaN")
    known = z[::4, ::4]
    known = known[known > 0.0]
    if len(known) and not _NEAREST <= (typical := float(np.median(known))) <= _FARTHEST:
        these = "millimetres" if typical > _FARTHEST else "metres that were divided by 1000"
        raise InputError(
            f"depths [m] with a median of {_NEAREST:g} to {_FARTHEST:g}",
            f"a median of {typical:.4g}",
            f"check the unit of the depth: are these {these}?",
        )
    a, b, c = noise
    sigma = a + b * np.maximum(z - c, 0.0) ** 2
    return SensedDepth(z, np.maximum(sigma, _LEAST_NOISE * z).astype(np.float32), z > 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class StereoPair:
    """The second camera of a stereo pair.

    Attributes:
        camera: of the right images, a pinhole, with lens distortion or without; images need not be rectified.
        T_right_left: (7,) wxyz and xyz, maps points in the left camera to the right one [m].
        candidates: pixels of the left image whose depth is looked for.

    Raises:
        InputError: a camera that is no pinhole, no pose, cameras in one place.

    Example:
        >>> pair = bp.StereoPair(bp.Pinhole(700.0, 700.0, 600.0, 180.0), (1, 0, 0, 0, -0.54, 0, 0))
        >>> round(pair.baseline_m, 2)
        0.54
    """

    camera: CameraModel
    T_right_left: ArrayLike
    candidates: int = 8000

    def __post_init__(self) -> None:
        check_pinhole(self.camera, "direct odometry")
        if not np.linalg.norm(SE3Left.check("T_right_left", self.T_right_left)[0, 4:]) > 0.0:
            raise InputError("two cameras apart from each other", "a baseline of 0 m", "give T_right_left [m]")

    @property
    def baseline_m(self) -> float:
        """Distance between the cameras [m]."""
        return float(np.linalg.norm(np.asarray(self.T_right_left, dtype=np.float64)[4:]))

    def depth(self, left: Image, right: Image, camera: Pinhole) -> SensedDepth:
        """Depths of pixels of steep gradient, by a search along their epipolar lines in the right image.

        Args:
            camera: of the left image.
        """
        z, sigma = np.zeros(left.shape, np.float32), np.zeros(left.shape, np.float32)
        centres, width = choose_candidates(left, self.candidates), left.shape[1]
        model = check_pinhole(self.camera, "direct odometry")
        near = np.full(len(centres), _WIDEST * width / (model.fx * self.baseline_m))
        view = View(right, model, SE3Left.check("T_right_left", self.T_right_left)[0])
        rho, sigma_rho, state = search(left, camera, centres, view, near, np.zeros(len(centres)), least_disparity=0.0)
        found = state == FOUND
        rho, sigma_rho = agreed(centres[found], rho[found], sigma_rho[found], left.shape, cell_size(left, self.candidates))
        good = sigma_rho < _MOST_SHARE * rho
        u, v = centres[found][good].T
        z[v, u] = 1.0 / rho[good]
        sigma[v, u] = sigma_rho[good] / rho[good] ** 2
        return SensedDepth(z, sigma, is_measured=z > 0.0)
