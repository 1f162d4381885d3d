"""Grey values between pixels: bilinear interpolation and the exact gradient of the interpolant (docs/residuals/photometric.md).

Images are (height, width) float32; u runs right, v down, pixel centres are at integers. The gradient jumps at integer
coordinates, where the interpolant has a kink.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus._numbers import as_numbers
from boxplus.errors import InputError
from boxplus.manifolds._batch import as_batch


@kernel(inline=True)
def sample_bilinear(image: NDArray[np.float32], u: float, v: float) -> tuple[bool, float, float, float]:
    """Whether the four pixels around (u, v) are there and finite; grey value, ∂/∂u, ∂/∂v [1/px]."""
    # Written so that a NaN coordinate is outside.
    if not (u >= 0.0 and v >= 0.0 and u < image.shape[1] - 1 and v < image.shape[0] - 1):
        return False, 0.0, 0.0, 0.0
    j, i = np.uint64(u), np.uint64(v)
    b, a = u - float(j), v - float(i)
    next_i, next_j = i + np.uint64(1), j + np.uint64(1)
    # Numba's float() keeps a float32.
    p00, p01 = np.float64(image[i, j]), np.float64(image[i, next_j])
    p10, p11 = np.float64(image[next_i, j]), np.float64(image[next_i, next_j])
    top, bottom = p01 - p00, p11 - p10
    upper, lower = p00 + b * top, p10 + b * bottom
    value = upper + a * (lower - upper)
    return math.isfinite(value), value, top + a * (bottom - top), lower - upper


@kernel(inline=True)
def sample_smoothed(image: NDArray[np.float32], u: float, v: float) -> tuple[bool, float, float, float]:
    """As `sample_bilinear`, with differences over two pixels, (I(u + 1, v) − I(u − 1, v))/2, in place of the exact gradient.

    They do not jump at integer coordinates; twelve pixels around (u, v) have to be there.
    """
    valid, value, _, _ = sample_bilinear(image, u, v)
    has_right, right, _, _ = sample_bilinear(image, u + 1.0, v)
    has_left, left, _, _ = sample_bilinear(image, u - 1.0, v)
    has_below, below, _, _ = sample_bilinear(image, u, v + 1.0)
    has_above, above, _, _ = sample_bilinear(image, u, v - 1.0)
    known = valid and has_right and has_left and has_below and has_above
    return known, value, 0.5 * (right - left), 0.5 * (below - above)


@kernel
def _sample_batch(
    image: NDArray[np.float32],
    pixels: NDArray[np.float64],
    values: NDArray[np.float64],
    gradients: NDArray[np.float64],
    valid: NDArray[np.bool_],
) -> None:
    for n in range(np.uint64(pixels.shape[0])):
        found, value, along_u, along_v = sample_bilinear(image, pixels[n, 0], pixels[n, 1])
        if found:
            values[n], gradients[n, 0], gradients[n, 1], valid[n] = value, along_u, along_v, True


def sample(image: ArrayLike, pixels: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Grey values (...), gradients (..., 2) [1/px] and validity (...) at pixels (..., 2).

    A pixel one of whose four neighbours lies outside of the image is not valid; its value and gradient are NaN.

    Raises:
        InputError: not an image (H, W) of finite numbers, or pixels of another shape.
    """
    batch, lead = as_batch("pixels", pixels, (2,))
    values, gradients = np.full(len(batch), np.nan), np.full((len(batch), 2), np.nan)
    valid = np.zeros(len(batch), dtype=np.bool_)
    _sample_batch(checked_image("image", image), batch, values, gradients, valid)
    return values.reshape(lead), gradients.reshape((*lead, 2)), valid.reshape(lead)


def checked_image(name: str, image: ArrayLike) -> NDArray[np.float32]:
    """An image as (H, W) float32, contiguous.

    Raises:
        InputError: not two axes, fewer than 2×2 pixels, or not finite.
    """
    array = np.ascontiguousarray(as_numbers(image, "image"), dtype=np.float32)
    if array.ndim != 2 or min(array.shape) < 2:
        raise InputError(
            f"{name} of shape (height, width), at least 2×2", f"shape {array.shape}", "convert colours to one grey value first"
        )
    finite = np.isfinite(array)
    if not finite.all():
        where = tuple(int(i) for i in np.argwhere(~finite)[0])
        raise InputError(f"{name} finite", f"{array[where]} at row and column {where}", "fill or crop what has no grey value")
    return array
