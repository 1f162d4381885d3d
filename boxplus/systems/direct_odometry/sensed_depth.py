"""Depths of a frame with their standard deviations: measured by the sensor, or found in the second image of a stereo camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.cameras.model import CameraModel, check_pinhole
from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.manifolds.se3 import SE3Left
from boxplus.sensors.image import Image, half_camera
from boxplus.systems.direct_alignment.keyframe_kernel import select_pixels
from boxplus.systems.direct_odometry.epipolar_kernel import FOUND, OUTSIDE, search_lines

Depths = NDArray[np.float32]
Matrix = NDArray[np.float64]
Pixels = NDArray[np.int64]

_NEAREST, _FARTHEST = 0.05, 100.0  # [m] between which the median of measured depths must lie
_LEAST_NOISE = 1e-3  # share of the depth
_DIAMOND = np.array([(u, v) for u in range(-2, 3) for v in range(-2, 3) if abs(u) + abs(v) <= 2])
_PATTERN = _DIAMOND[np.argsort(np.abs(_DIAMOND).sum(axis=1), kind="stable")]  # the centre first
_WIDEST = 0.12  # disparities looked at, by the width of the image
_LEAST_DISPARITY = 1.0  # [px]; farther points say little of translation, and their depth is not known
_AROUND = 3.0  # pixels of disparity that the search at half the resolution leaves open
_MOST_ERROR = 0.06  # mean |e| of a match, by the range of grey values
_RATIO = 0.8  # of the costs of the best and the second best match
_LEAST_ERROR = 0.01  # standard deviation of grey values, by their range
_CORRELATED = 2.0  # factor of σ: neighbouring pixels err together, and patches are not fronto-parallel


@dataclass(frozen=True, slots=True, eq=False)
class SensedDepth:
    """Depths of a frame.

    Attributes:
        z: (H, W) along the optical axis [m], 0 where there is none; sigma: (H, W) standard deviations [m].
    """

    z: Depths
    sigma: Depths


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
    if len(known) and not _NEAREST <= float(np.median(known)) <= _FARTHEST:
        raise InputError(
            f"depths [m] with a median of {_NEAREST:g} to {_FARTHEST:g}",
            f"a median of {float(np.median(known)):.4g}",
            "check the unit of the depth: are these millimetres?",
        )
    a, b, c = noise
    sigma = a + b * np.maximum(z - c, 0.0) ** 2
    return SensedDepth(z, np.maximum(sigma, _LEAST_NOISE * z).astype(np.float32))


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
        >>> pair = StereoPair(Pinhole(700.0, 700.0, 600.0, 180.0), (1, 0, 0, 0, -0.54, 0, 0))
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
        height, width = left.shape
        z, sigma = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
        cell = max(int(np.sqrt(height * width / self.candidates)), 1)
        inner = np.zeros((height, width), np.float32)
        inner[6:-6, 6:-6] = 1.0
        most = -(-height // cell) * -(-width // cell)
        pixels, gradients, values = (np.empty((most, 2)) for _ in range(3))
        count = select_pixels(left.grey, inner, cell, False, pixels, gradients, values)
        steep = np.linalg.norm(gradients[:count], axis=1) > _LEAST_ERROR * float(np.ptp(left.grey))
        centres = pixels[:count][steep].astype(np.int64)
        contrast = float(np.ptp(left.grey))
        model = check_pinhole(self.camera, "direct odometry")
        by_disparity = 1.0 / (model.fx * self.baseline_m)
        # At half the resolution along all of the line, then around what was found there.
        n, half_model = len(centres), half_camera(model)
        near, far = np.full(n, _WIDEST * width * by_disparity), np.zeros(n)
        rho, _, state = self._search(
            left.half(), right.half(), half_camera(camera), half_model, centres // 2, near, far, contrast
        )
        found = state == FOUND
        centres, rho = centres[found], rho[found]
        margin = _AROUND * by_disparity
        near, far = rho + margin, np.maximum(rho - margin, 0.0)
        rho, sigma_rho, state = self._search(left, right, camera, model, centres, near, far, contrast)
        good = (state == FOUND) & (rho > _LEAST_DISPARITY * by_disparity) & (_CORRELATED * sigma_rho < 0.3 * rho)
        u, v = centres[good].T
        z[v, u] = 1.0 / rho[good]
        sigma[v, u] = _CORRELATED * sigma_rho[good] / rho[good] ** 2
        return SensedDepth(z, sigma)

    def _search(
        self,
        left: Image,
        right: Image,
        camera: Pinhole,
        model: Pinhole,
        centres: Pixels,
        near: Matrix,
        far: Matrix,
        contrast: float,
    ) -> tuple[Matrix, Matrix, NDArray[np.uint8]]:
        """Inverse depths at `centres` (n, 2) of the left image between `far` and `near`, their σ, and whether they were found."""
        of_pattern = centres[:, None, :] + _PATTERN
        rays, seen = camera.unproject(of_pattern.astype(np.float64))
        grey = left.grey[of_pattern[..., 1], of_pattern[..., 0]].astype(np.float64)
        n = len(centres)
        rho, sigma_rho, state = np.empty(n), np.empty(n), np.empty(n, np.uint8)
        search_lines(
            SE3Left.check("T_right_left", self.T_right_left)[0], np.ascontiguousarray(rays[..., :2]), grey, near, far, right.grey,
            model.padded_parameters, _MOST_ERROR * contrast, _RATIO, _LEAST_ERROR * contrast, rho, sigma_rho, state,
        )  # fmt: skip
        state[~seen.all(axis=1)] = OUTSIDE
        return rho, sigma_rho, state
