"""A keyframe: what direct alignment needs of an image with depth, prepared once for all images that are aligned to it.

An image of the same camera, with T = T_21 from keyframe to image and the brightness (a, b) of the image, has the residuals

    e = I₁(p₁) − (eᵃ I₂(π(T X₁)) + b)        at pixels p₁ of the keyframe, X₁ = m/ρ their points

Inverse compositional (Baker and Matthews 2004): it is the keyframe that is moved and brightened a little,

    I₁(π(Exp(ξ) X₁)) (1 + α) + β − (eᵃ I₂(π(T X₁)) + b)  ≈  e + J [ξ, α, β],   J = [∇I₁ ∂π(Exp(ξ) X₁)/∂ξ,  I₁,  1]

and then the image follows, T ← T Exp(ξ)⁻¹, eᵃ ← eᵃ/(1 + α), b ← (b − β)/(1 + α). J depends on nothing that is estimated.

Source: Baker and Matthews, Lucas-Kanade 20 Years On, IJCV 2004; the brightness as in Engel, Koltun and Cremers, Direct Sparse
Odometry, PAMI 2018.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats
from boxplus.cameras.model import check_pinhole
from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.sensors.images.image import Image, as_image, half_camera
from boxplus.systems.direct_alignment.keyframe_kernel import half_depth, pixel_jacobians, select_pixels

FEWEST_PIXELS = 100
_NOISE_STEP = 4  # rows of the image from one that its noise is measured in to the next
_OF_NOISE = 10  # pixels of an image of noise alone whose gradient is taken for texture, on average
_QUARTER_OF_NORMAL = 0.31864  # |x| below which a quarter of a normal distribution lies
_STEPS_ABOVE = 2  # octaves; pixels at steps of the depth stay, as on coarse levels nearly all of them are at one


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """Pixels of one level of the pyramid.

    Attributes:
        octave: how often the image was halved.
        pixels: (n, 2) u, v; rays: (n, 2) of z = 1; inverse_depth: (n,) [1/m]; grey: (n,) of the keyframe.
        share: (n,) by which a pixel counts, less the steeper its gradient is, so that a few edges do not outweigh all others.
        J: (n, 6) of the keyframe's grey values by ξ = [w, v] [grey values/rad, grey values/m].
        intrinsics: (9,) of the camera at this level.
        gradient_noise: variance that noise of the image gives to a component of the gradients, chosen as they are [1/px²].
        above_noise: how many pixels have a gradient that noise and steps of the grey values hardly make.
    """

    octave: int
    pixels: NDArray[np.float64]
    rays: NDArray[np.float64]
    inverse_depth: NDArray[np.float64]
    grey: NDArray[np.float64]
    J: NDArray[np.float64]
    share: NDArray[np.float64]
    intrinsics: NDArray[np.float64]
    gradient_noise: float
    above_noise: int


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """An image with depth, ready for images to be aligned to it by `track`.

    Attributes:
        camera: of the keyframe, and of all images that are aligned to it.
        shape: (height, width).
        levels: of the pyramid, coarsest first; those with fewer than 100 pixels with depth are left out.
        halvings: of the image, from the finest level to the coarsest.
        median_depth: of the pixels [m], what translations are measured by.
        contrast: range of the grey values.

    Example:
        >>> v, u = np.mgrid[:120, :160]
        >>> image = 100.0 + 40.0 * np.sin(0.2 * u) * np.cos(0.15 * v)
        >>> keyframe = bp.Keyframe.prepare(image, np.full((120, 160), 2.0), bp.Pinhole(150.0, 150.0, 79.5, 59.5), levels=3)
        >>> [level.octave for level in keyframe.levels]
        [2, 1, 0]
    """

    camera: Pinhole
    shape: tuple[int, int]
    levels: tuple[Level, ...]
    halvings: int
    median_depth: float
    contrast: float

    @classmethod
    def prepare(
        cls, image: Image | ArrayLike, depth: ArrayLike, camera: Pinhole, *, levels: int = 5, points: int | None = 3000
    ) -> Keyframe:
        """Choose the pixels to compare, and compute all that does not depend on the image to be aligned.

        Every level is divided into square cells, of which each gives the pixel with the steepest gradient, among those that
        have a depth and, at the two finest levels, no neighbour on another surface.

        Args:
            image: grey values (H, W), or colours.
            depth: (H, W) z in the camera [m]; 0 or NaN where there is none.
            camera: intrinsics.
            levels: of the pyramid, each half the resolution of the one before.
            points: about as many pixels a level at most; None for all.

        Raises:
            InputError: depth of another shape or negative, too many levels, fewer than 100 pixels with depth, a camera
                that is no pinhole.
        """
        camera = check_pinhole(camera, "direct alignment")
        first = as_image(image)
        if points is not None and points < FEWEST_PIXELS:
            raise InputError(
                f"at least {FEWEST_PIXELS} points a level", f"{points}", "leave it out for 3000, or give None for all"
            )
        z = _checked_depth(depth, first)
        median_depth = float(np.median(z[z > 0.0]))
        found: list[Level] = []
        scaled, step = camera, _step(first.grey)
        for octave, grey in enumerate(first.pyramid(levels)):
            if octave > 0:
                finer, z = z, np.empty(grey.shape, dtype=np.float32)
                half_depth(finer, z)
                scaled = half_camera(scaled)
            level = _level(octave, grey.grey, z, scaled, points, step)
            if len(level.grey) >= FEWEST_PIXELS:
                found.append(level)
        if not found:
            raise InputError(
                f"at least {FEWEST_PIXELS} pixels with depth that are not at steps of the depth",
                "fewer at every level",
                "check the unit and the noise of the depth",
            )
        contrast = float(first.grey.max() - first.grey.min())
        return cls(camera, first.shape, tuple(found[::-1]), levels - 1, median_depth, contrast)


def _level(
    octave: int, grey: NDArray[np.float32], depth: NDArray[np.float32], camera: Pinhole, points: int | None, step: float
) -> Level:
    with_depth = int(np.count_nonzero(depth))
    cell = 1 if points is None else max(int(np.ceil(np.sqrt(with_depth / points))), 1)
    most = with_depth if cell == 1 else -(-grey.shape[0] // cell) * -(-grey.shape[1] // cell)
    pixels, gradients, values = (np.empty((most, 2)) for _ in range(3))
    count = select_pixels(grey, depth, cell, octave >= _STEPS_ABOVE, pixels, gradients, values)
    rays, seen = camera.unproject(pixels[:count])
    rays = np.ascontiguousarray(rays[seen, :2])
    inverse_depth = 1.0 / values[:count][seen, 1]
    J, c = np.empty((len(rays), 6)), camera.padded_parameters
    pixel_jacobians(rays, inverse_depth, gradients[:count][seen], c, J)
    # Half the variance of grey values; the steepest of m gradients of noise is longer by the m-th harmonic number (exponential).
    variance = image_noise(grey) ** 2
    gradient_noise = 0.5 * variance * float(np.sum(1.0 / np.arange(1.0, cell * cell + 1.0)))
    # Squares of gradients of noise have an exponential distribution with mean σ², but for those at the border.
    limit = max(np.log(count * cell * cell / _OF_NOISE), 1.0) * max(variance, (step / 2**octave) ** 2) if count else 0.0
    inner = np.all((pixels[:count] > 0) & (pixels[:count] < np.array(grey.shape[::-1]) - 1), axis=1) & seen
    above_noise = int(np.count_nonzero(np.sum(gradients[:count][inner] ** 2, axis=1) > limit))
    grey_1 = np.ascontiguousarray(values[:count][seen, 0])
    return Level(
        octave, pixels[:count][seen], rays, inverse_depth, grey_1, J, _share(gradients[:count][seen]), c, gradient_noise,
        above_noise,
    )  # fmt: skip


def _share(gradients: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) by which pixels with these gradients (n, 2) count: c²/(c² + |∇I|²) with c² the mean of |∇I|²."""
    square = np.sum(gradients**2, axis=1)
    mean = max(float(square.mean()), 1e-30) if len(square) else 1.0
    return np.asarray(mean / (mean + square), dtype=np.float64)


def _step(grey: NDArray[np.float32]) -> float:
    """Smallest difference of neighbours that differ: what they are rounded to. Noise below it is not measured well."""
    steps = np.abs(np.diff(grey[::_NOISE_STEP], axis=1))
    return float(np.min(steps, initial=np.inf, where=steps > 0.0)) if steps.any() else 0.0


def image_noise(grey: NDArray[np.float32]) -> float:
    """Standard deviation of the noise of grey values, by the quarter of the image that is smoothest.

    Source: Immerkær, Fast Noise Variance Estimation, CVIU 1996: a difference of two Laplacians is blind to planes of grey values.
    """
    rows = [grey[k : len(grey) - 2 + k : _NOISE_STEP] for k in range(3)]
    across = [row[:, :-2] - 2.0 * row[:, 1:-1] + row[:, 2:] for row in rows]
    rough = np.abs(across[0] - 2.0 * across[1] + across[2])
    return float(np.quantile(rough, 0.25)) / _QUARTER_OF_NORMAL / 6.0 if rough.size else 0.0


def _checked_depth(depth_1: ArrayLike, image: Image) -> NDArray[np.float32]:
    depth = np.array(as_floats(depth_1, "depth_1"), dtype=np.float32)
    if depth.shape != image.shape:
        raise InputError(f"depth_1 of shape {image.shape}, as image 1", f"shape {depth.shape}", "register the depth to the image")
    depth[~np.isfinite(depth)] = 0.0
    if depth.min() < 0.0:
        raise InputError("depth_1 not negative [m]", f"{depth.min()}", "mark pixels without depth by 0 or NaN")
    if np.count_nonzero(depth) < FEWEST_PIXELS:
        raise InputError(
            f"at least {FEWEST_PIXELS} pixels with depth",
            f"{np.count_nonzero(depth)}",
            "check the unit and the file of the depth",
        )
    return depth
