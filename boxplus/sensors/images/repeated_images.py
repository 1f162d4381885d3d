"""Images that a driver or a recording delivers again, with a new stamp.

No two images that a sensor takes of something with contrast are the same to the bit: its noise is not. Taken for new ones they
say that nothing moves, and an odometry would stop while its camera goes on. A source without noise (rendered, or coded by what
changed) has equal images at rest as well, and those are true: so equal images count as repeated only in motion.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_STRIDE = 16  # rows that are compared first
_LEAST_CONTRAST = 5.0  # standard deviation of grey values as recorded, below which there is nothing to see


class RepeatedImages:
    """Remembers the last image of each camera that was new."""

    def __init__(self) -> None:
        self._last: dict[int, NDArray[Any]] = {}

    def among(self, images: dict[int, NDArray[Any]]) -> set[int]:
        """The cameras whose image (H, W) is the one before."""
        return {camera for camera, image in images.items() if _same(image, self._last.get(camera))}

    def keep(self, images: dict[int, NDArray[Any]]) -> None:
        """These were new, or taken for new; copied, as a driver may write the next ones into the same memory."""
        self._last.update({camera: image.copy() for camera, image in images.items()})


def _same(image: NDArray[Any], before: NDArray[Any] | None) -> bool:
    if before is None or not np.array_equal(image[::_STRIDE], before[::_STRIDE]) or not np.array_equal(image, before):
        return False
    return float(image[::_STRIDE].std()) > _LEAST_CONTRAST
