"""Grey values in 8 bits, as optical flow takes them, by one scale for a whole recording."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_FULL = (1.0, 255.0, 1023.0, 4095.0, 16383.0, 65535.0)


class EightBits:
    """Converts images to 8 bits; keep one for all images of a recording.

    Cameras of 10, 12 or 14 bits deliver them in 16, and recordings do not say so. The range is taken for the smallest usual one
    that holds the largest value seen so far: it never shrinks, so that light and dark of two images mean the same.

    Attributes:
        full: the grey value that becomes 255: 1, or the largest of 8, 10, 12, 14 or 16 bits, or a larger value that was seen.

    Example:
        >>> to_8_bits = EightBits()
        >>> to_8_bits(np.array([[0, 2048, 4095]], np.uint16)), to_8_bits.full
        (array([[  0, 128, 255]], dtype=uint8), 4095.0)
    """

    def __init__(self) -> None:
        self.full = 0.0

    def __call__(self, grey: NDArray[Any]) -> NDArray[np.uint8]:
        """(H, W) of unsigned integers or floats; those of 8 bits stay as they are, and what is below zero is black."""
        if grey.dtype == np.uint8:
            return np.ascontiguousarray(grey)
        largest = float(grey.max())
        if largest > self.full:
            self.full = next((full for full in _FULL if largest <= full), largest)
        scaled = grey * np.float32(255.0 / self.full if self.full else 0.0)
        return np.asarray(np.clip(scaled + np.float32(0.5), 0.0, 255.0).astype(np.uint8))
