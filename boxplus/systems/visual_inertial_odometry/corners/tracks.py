"""What the images of one instant show of the corners that are followed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.systems.visual_inertial_odometry.corners.partners import Partners
from boxplus.systems.visual_inertial_odometry.lines.tracks import LineTracks

_MOST = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """The corners seen at one instant.

    Attributes:
        time_ns: of the images, in the clock of the IMU [ns].
        ids: (n,) int64, ascending; a corner keeps its id from image to image, and it is never given again.
        pixels: (n, c, 2) where each camera sees it, as recorded, distortion included [px]; NaN where a camera does not.
        rays: (n, c, 3) the same as [X/Z, Y/Z, 1] in the camera frame; NaN where a camera does not see it.
        is_new: (n,) bool, found in this image.
        rejected: corners of the image before that were lost, by reason.
        motion_px: median motion of the corners in the first camera since the image before [px]; NaN without any.
        brightness: (c,) mean grey value of each camera, NaN without an image.
        contrast: (c,) standard deviation of the grey values, NaN without an image.
        partners: what shares the other cameras find of those that they should; None where too few tell it, an image shows
            nothing, or there is one camera.
        lines: the lines seen beside the corners; None where none are looked for.
    """

    time_ns: int
    ids: NDArray[np.int64]
    pixels: NDArray[np.float64]
    rays: NDArray[np.float64]
    is_new: NDArray[np.bool_]
    rejected: Mapping[str, int]
    motion_px: float
    brightness: NDArray[np.float64]
    contrast: NDArray[np.float64]
    partners: Partners | None = None
    lines: LineTracks | None = None

    def __len__(self) -> int:
        return len(self.ids)


def shared_rows(ids: NDArray[np.int64], ascending: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Where the ids that both have stand in each of them, in the order of the second; no id stands twice in one."""
    rows, others = np.empty((2, min(len(ids), len(ascending))), dtype=np.intp)
    count = _share(ids, ascending, rows, others)
    return rows[:count], others[:count]


@kernel
def _share(ids: NDArray[np.int64], ascending: NDArray[np.int64], rows: NDArray[np.intp], others: NDArray[np.intp]) -> int:
    place = np.full(len(ascending), -1)
    for k in range(len(ids)):
        at = np.searchsorted(ascending, ids[k])
        if at < len(ascending) and ascending[at] == ids[k]:
            place[at] = k
    count = 0
    for at in range(len(ascending)):
        if place[at] >= 0:
            rows[count], others[count] = place[at], at
            count += 1
    return count


def motion_px(before: Tracks, now: Tracks) -> NDArray[np.float64]:
    """By how much each corner that both saw has moved in the first camera (n,) [px]."""
    then, there = shared_rows(before.ids, now.ids)
    return np.asarray(np.linalg.norm(now.pixels[there, 0] - before.pixels[then, 0], axis=1))


def most_are_below(values: NDArray[np.float64], limit: float) -> bool:
    """Whether the quantile of 80 % of the values (n,), n ≥ 1, is below the limit."""
    if np.count_nonzero(values < limit) < _MOST * (len(values) - 1):
        return False  # as mostly, and without the quantile: both values between which it lies reach the limit
    return float(np.quantile(values, _MOST)) < limit
