"""What the images of one instant show of the lines that are followed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class LineTracks:
    """The lines seen at one instant.

    Attributes:
        ids: (n,) int64, ascending; a line keeps its id from image to image, and it is never given again.
        segments: (n, c, 4) ends [x, y, x, y] of what each camera sees of it, as X/Z and Y/Z in the camera frame: without
            distortion; NaN where a camera does not see it. Ends of two images are not the same points of the line.
        rejected: lines of the image before that were lost, by reason.
    """

    ids: NDArray[np.int64]
    segments: NDArray[np.float64]
    rejected: Mapping[str, int]

    def __len__(self) -> int:
        return len(self.ids)
