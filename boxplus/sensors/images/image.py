"""What a camera delivers to direct methods: a grey image, and its pyramid."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus._numbers import as_array, is_array
from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.residuals.camera.photometric_sampling import checked_image
from boxplus.sensors.images.camera_image import LUMA


@dataclass(frozen=True, slots=True, eq=False)
class Image:
    """Grey values on a grid, u to the right, v down, pixel centres at integers.

    Attributes:
        grey: (height, width) float32, finite, in any unit, at least 2×2.

    Raises:
        InputError: another shape, fewer than 2×2 pixels, or values that are not finite.

    Example:
        >>> image = bp.Image(np.add.outer(np.arange(4.0), np.arange(6.0)).astype(np.float32))
        >>> image.grey.shape, float(image.grey[1, 2])
        ((4, 6), 3.0)
    """

    grey: NDArray[np.float32]

    def __post_init__(self) -> None:
        grey = self.grey
        whole = is_array(grey, np.float32, 2) and min(grey.shape) >= 2
        # The sum of squares is finite where all values are, but beyond all floats: a tenth of the time of looking at each.
        if not (whole and math.isfinite(np.vdot(grey, grey))):
            object.__setattr__(self, "grey", checked_image("grey", grey))

    @classmethod
    def from_array(cls, values: ArrayLike) -> Image:
        """From grey values (H, W), or from colours (H, W, 3 or 4): red, green, blue, and an alpha that is left out.

        Raises:
            InputError: another shape, fewer than 2×2 pixels, or values that are not finite.
        """
        array = as_array(values, "image")
        if array.ndim == 3 and array.shape[2] in (3, 4):
            array = array[..., :3].astype(np.float32) @ LUMA
        return cls(checked_image("image", array))

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.grey.shape[0], self.grey.shape[1]

    def half(self) -> Image:
        """The image at half the resolution: means of 2×2 pixels; an odd last row or column is left out."""
        half = np.empty((self.shape[0] // 2, self.shape[1] // 2), dtype=np.float32)
        _mean_of_two_by_two(self.grey, half)
        return Image(half)

    def pyramid(self, levels: int) -> list[Image]:
        """This image and its halves, finest first.

        Raises:
            InputError: more levels than the image can be halved, or none.
        """
        if levels < 1 or min(self.shape) >> (levels - 1) < 2:
            raise InputError(
                f"1 to {min(self.shape).bit_length() - 1} levels of an image of {self.shape[1]}×{self.shape[0]} pixels",
                f"{levels}",
                "the coarsest level still needs 2×2 pixels",
            )
        images = [self]
        while len(images) < levels:
            images.append(images[-1].half())
        return images


def as_image(values: Image | ArrayLike) -> Image:
    """An image as it is, or from an array.

    Raises:
        InputError: as of `Image.from_array`.
    """
    return values if isinstance(values, Image) else Image.from_array(values)


@kernel
def _mean_of_two_by_two(grey: NDArray[np.float32], half: NDArray[np.float32]) -> None:
    for i in range(np.uint64(half.shape[0])):
        upper, lower, row = grey[np.uint64(2) * i], grey[np.uint64(2) * i + np.uint64(1)], half[i]
        for j in range(np.uint64(half.shape[1])):
            k = np.uint64(2) * j
            row[j] = np.float32(0.25) * ((upper[k] + upper[k + np.uint64(1)]) + (lower[k] + lower[k + np.uint64(1)]))


def half_camera(camera: Pinhole) -> Pinhole:
    """The camera of the image at half the resolution: u' = (u + ½)/2 − ½, as pixel centres are at integers."""
    return replace(
        camera, fx=0.5 * camera.fx, fy=0.5 * camera.fy, cx=0.5 * (camera.cx + 0.5) - 0.5, cy=0.5 * (camera.cy + 0.5) - 0.5
    )
