"""Whether the map stands upright: z of a map is taken to be up, and an IMU knows where up is.

Registration has all six directions, so that a map that leans by some degrees is found and followed as a right one is. Up of the
odometry, seen from the map, is then off its z by as much, scan for scan.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MOST_TILT = np.deg2rad(1.5)
"""Between up and the z axis of a map [rad]: accelerometers of consumers are off by half of it, on both days."""

_FEWEST = 5  # scans


class MapTilt:
    """What the scans of a run say of up in the map, place by place."""

    def __init__(self) -> None:
        self._sum = np.zeros(3)
        self._count = 0
        self._before: str | None = None  # doubt of an earlier place

    def begin(self) -> None:
        """The next scans are of another place."""
        self._before = self.doubt
        self._sum, self._count = np.zeros(3), 0

    def see(self, up_map: NDArray[np.float64]) -> None:
        """Take up (3,), of a scan that was registered, in the map's frame; of any length."""
        self._sum += up_map / np.linalg.norm(up_map)
        self._count += 1

    @property
    def angle(self) -> float:
        """Between the mean of up and the map's z axis [rad]; 0 where no scan said anything."""
        return float(np.arctan2(np.hypot(self._sum[0], self._sum[1]), self._sum[2])) if self._count else 0.0

    @property
    def doubt(self) -> str | None:
        """Why the map's z axis is not to be trusted; None where nothing speaks against it."""
        if self._count < _FEWEST or self.angle <= MOST_TILT:
            return self._before
        return (
            f"up in the map is {np.rad2deg(self.angle):.2f}° off where the IMU has it, {np.rad2deg(MOST_TILT):.1f}° at most: the "
            "map leans, or the LiDAR is mounted on the IMU otherwise than stated; poses lie among what the map has around, but "
            "heights and slopes are those of a map that leans"
        )
