"""Photometric error: the grey value of a pixel in image 1 against that where it lands in image 2.

Derivation: docs/residuals/photometric.md and docs/residuals/inverse_depth.md.
With the ray m of pixel p₁, its inverse depth ρ in view 1, the projection π and the affine brightness (a, b):

    e = I₁(p₁) − (eᵃ I₂(p₂) + b),   p₂ = π(R m + ρ t),   (R, t) = T_21

Jacobians, ∇I₂ the exact gradient of the bilinear interpolant at p₂ and P_Y = ∂π/∂Y at Y = R m + ρ t:

    ∂e/∂[w, v] = −eᵃ ∇I₂ P_Y [−[Y]x  ρ I]       T_21 moved on the left
    ∂e/∂ρ      = −eᵃ ∇I₂ P_Y t
    ∂e/∂c      = −eᵃ ∇I₂ (∂π/∂c + P_Y R ∂m/∂c)   c = [fx, fy, cx, cy] of both views, p₁ and ρ held fixed
    ∂e/∂[a, b] = [−eᵃ I₂(p₂), −1]

I₁(p₁) depends on none of them. The gradient jumps where p₂ crosses a pixel centre. Invalid, as a whole patch: one of the four
pixels around p₂ is outside of the image, or the point is at z' ≤ z_min. ρ < 1e-6 1/m is a point at infinity.

Source: Engel, Koltun and Cremers, Direct Sparse Odometry, PAMI 2018; signs and entries corrected (see the page).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats
from boxplus.cameras.model import check_pinhole
from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.se3 import SE3Left
from boxplus.residuals.camera.photometric_kernel import photometric
from boxplus.residuals.camera.photometric_sampling import checked_image, sample
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.whitening import Whitening

DSO_PATTERN = ((0, 0), (0, -2), (-1, -1), (1, -1), (-2, 0), (2, 0), (-1, 1), (0, 2))
"""(u, v) offsets of the eight pixels that Direct Sparse Odometry compares."""

_SLOTS: tuple[tuple[str, Manifold], ...] = (
    ("T_21", SE3Left),
    ("rho", Euclidean(1)),
    ("intrinsics", Euclidean(4)),
    ("brightness", Euclidean(2)),
)


class Photometric(Residual):
    """Pixels, or patches of pixels, of image 1 looked up in image 2, as derived in the head of this file.

    Variables, in this order, the last three where asked for:
        `T_21` on `SE3Left` (7,): maps points in camera 1 to camera 2;
        `rho` (1,): inverse depth ρ in view 1 [1/m], shared by a patch;
        `intrinsics` (4,): fx, fy, cx, cy of both views [px];
        `brightness` (2,): a, b of image 2.

    Args:
        camera: of both images.
        image_1, image_2: (H, W) grey values, finite.
        pixels_1: (N, 2) u, v in image 1, at integers or between.
        depth_1: (N,) z in camera 1 [m]; None exactly when `inverse_depth` is a variable.
        pattern: (K, 2) offsets (u, v) [px] of the pixels of a patch; the residual has K rows.
        inverse_depth, intrinsics, brightness: whether these are variables.
        gradient: of image 2, that of the bilinear interpolant, or "smoothed", differences over two pixels: it does not jump where
            p₂ crosses a pixel centre, but is not the derivative of the residual; all residuals need a pixel more to the border.
        sigma, covariance, information: of a grey value's difference, as in `Whitening.of`.

    Raises:
        InputError: wrong shapes or values that are not finite; a pixel of a patch outside of image 1; a depth that is not
            positive; intrinsics as variables of a camera with distortion; a camera that is no pinhole.

    Example:
        >>> camera = bp.Pinhole(100.0, 100.0, 15.5, 15.5)
        >>> image = np.add.outer(np.arange(32.0), 2.0 * np.arange(32.0))  # brighter by 2 a pixel to the right
        >>> pixels = bp.residuals.Photometric(camera, image, image, [[10.0, 10.0]], [2.0])
        >>> pixels.evaluate(bp.SE3Left.boxplus(bp.SE3Left.identity(), [0, 0, 0, 0.02, 0, 0])).round(3)  # a pixel to the side
        array([[-2.]])
    """

    def __init__(
        self,
        camera: Pinhole,
        image_1: ArrayLike,
        image_2: ArrayLike,
        pixels_1: ArrayLike,
        depth_1: ArrayLike | None = None,
        *,
        pattern: ArrayLike = ((0, 0),),
        inverse_depth: bool = False,
        intrinsics: bool = False,
        brightness: bool = False,
        gradient: Literal["exact", "smoothed"] = "exact",
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
    ) -> None:
        if gradient not in ("exact", "smoothed"):
            raise InputError('gradient "exact" or "smoothed"', repr(gradient), 'leave it at "exact" unless the images are noisy')
        self.camera = camera = check_pinhole(camera, "photometric residuals")
        self.image_2 = checked_image("image_2", image_2)
        self.pixels_1 = _checked_patches(pixels_1, pattern)
        count, dim = self.pixels_1.shape[:2]
        self.grey_1, _, inside = sample(checked_image("image_1", image_1), self.pixels_1)
        if not inside.all():
            n, k = (int(i) for i in np.argwhere(~inside)[0])
            raise InputError(
                "patches inside of image 1", f"{self.pixels_1[n, k]} of patch {n}", "leave out pixels close to its border"
            )
        if intrinsics and camera.distortion is not None:
            raise InputError(
                "a camera without distortion where the intrinsics are variables",
                repr(camera.distortion),
                "undistort the images, or keep the intrinsics fixed",
            )
        rays, found = camera.unproject(self.pixels_1)
        if not found.all():
            n, k = (int(i) for i in np.argwhere(~found)[0])
            raise InputError("pixels that the camera can see", f"{self.pixels_1[n, k]} of patch {n}", "leave it out")
        is_variable = (True, inverse_depth, intrinsics, brightness)
        slots = [slot for slot, asked in zip(_SLOTS, is_variable, strict=True) if asked]
        super().__init__(
            dim=dim,
            count=count,
            manifolds=tuple(manifold for _, manifold in slots),
            roles=tuple(role for role, _ in slots),
            whitening=Whitening.of(dim, count, sigma=sigma, covariance=covariance, information=information),
        )
        parameters = camera.padded_parameters
        self._terms = (
            self.image_2, self.grey_1, self.pixels_1, np.ascontiguousarray(rays[..., :2]), parameters[4:], camera.z_min,
            intrinsics, gradient == "smoothed",
        )  # fmt: skip
        self._is_variable = is_variable
        self._no_jacobians = tuple(np.zeros((0, dim, manifold.dof)) for _, manifold in _SLOTS)
        # What is no variable stands in its place as a constant.
        once, each = np.zeros(count, dtype=np.uint32), np.arange(count, dtype=np.uint32)
        rho = None if inverse_depth else 1.0 / _checked_depth(depth_1, count)[:, None]
        if rho is None and depth_1 is not None:
            raise InputError("no depth_1 where the inverse depth is a variable", "both", "give the depth as its start value")
        self._constants = (None, rho, parameters[None, :4].copy(), np.zeros((1, 2)))
        self._constant_index = (once, each, once, once)

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """See `Residual.linearize_into`."""
        values, rows = self._all(x, self._constants), self._all(index, self._constant_index)
        photometric(begin, end, *values, *rows, *self._terms, r, *self._all(jacobians, self._no_jacobians), valid, True)

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """See `Residual.evaluate_into`."""
        values, rows = self._all(x, self._constants), self._all(index, self._constant_index)
        photometric(begin, end, *values, *rows, *self._terms, r, *self._no_jacobians, valid, False)

    def _all(self, given: tuple[object, ...], otherwise: tuple[object, ...]) -> tuple[object, ...]:
        """One array for each of the four slots: the next one given where it is a variable, else its constant."""
        following = iter(given)
        return tuple(next(following) if asked else constant for asked, constant in zip(self._is_variable, otherwise, strict=True))


def _checked_patches(pixels_1: ArrayLike, pattern: ArrayLike) -> NDArray[np.float64]:
    """Pixels (N, K, 2) of N patches."""
    pixels, offsets = as_floats(pixels_1, "pixels_1"), as_floats(pattern, "pattern")
    for name, array in (("pixels_1", pixels), ("pattern", offsets)):
        if array.ndim != 2 or array.shape[1] != 2 or not np.isfinite(array).all():
            raise InputError(f"{name} finite, of shape (N, 2)", f"shape {array.shape}", "give one row (u, v) for each pixel")
    return np.ascontiguousarray(pixels[:, None, :] + offsets)


def _checked_depth(depth_1: ArrayLike | None, count: int) -> NDArray[np.float64]:
    if depth_1 is None:
        raise InputError("depth_1", "none", "give the depth of every pixel, or make the inverse depth a variable")
    depth = as_floats(depth_1, "depth_1")
    if depth.shape != (count,):
        raise InputError(f"depth_1 of shape ({count},)", f"shape {depth.shape}", "give one depth for each pixel")
    good = np.isfinite(depth) & (depth > 0.0)
    if not good.all():
        n = int(np.argmin(good))
        raise InputError("depth_1 positive and finite", f"{depth[n]} for pixel {n}", "leave out pixels without depth")
    return depth
