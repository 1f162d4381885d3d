"""The box around the sensor within which the map is kept (docs/lidar_inertial_odometry.md, section 9)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

GAMMA = 1.5


class SlidingBox:
    """An axis-aligned cube that follows the sensor in steps, and the slabs it leaves behind.

    Args:
        side: side of the cube [m]; must exceed 3.5 × `detection_range`, or the cube would oscillate.
        detection_range: range of the sensor [m].
    """

    def __init__(self, side: float, detection_range: float) -> None:
        self._side = side
        self._margin = GAMMA * detection_range
        self._step = max(0.45 * (side - 2.0 * self._margin), (GAMMA - 1.0) * detection_range)
        self._low: NDArray[np.float64] | None = None

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Low and high corner (3,) in the world, or None before the first call of `follow`."""
        return None if self._low is None else (self._low.copy(), self._low + self._side)

    def follow(self, p_world_lidar: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Move the box after the sensor; returns the boxes (low, high) to delete from the map, old minus new."""
        if self._low is None:
            self._low = p_world_lidar - 0.5 * self._side
            return []
        old = self._low.copy()
        slabs = []
        for axis in range(3):
            to_low = p_world_lidar[axis] - old[axis]
            to_high = old[axis] + self._side - p_world_lidar[axis]
            if min(to_low, to_high) > self._margin:
                continue
            # A sensor that jumped may need several steps at once.
            shift = self._step * max(1.0, np.ceil((self._margin - min(to_low, to_high)) / self._step))
            low, high = old.copy(), old + self._side
            if to_low <= self._margin:
                self._low[axis] -= shift
                low[axis] = max(high[axis] - shift, old[axis])
            else:
                self._low[axis] += shift
                high[axis] = min(low[axis] + shift, high[axis])
            slabs.append((low, high))
        return slabs
