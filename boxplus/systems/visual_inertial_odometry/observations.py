"""What the window holds of images: frames, and which landmarks each of them saw where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks
from boxplus.systems.visual_inertial_odometry.lines.landmarks import NO_LINES, LineFit

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(slots=True)
class Frame:
    """One instant in the window.

    Attributes:
        number: id of its pose and state in their blocks.
        time_ns: of the images.
        tracks: what was seen.
        is_keyframe: whether it stays until it is the oldest.
    """

    number: int
    time_ns: int
    tracks: Tracks
    is_keyframe: bool


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """How well the newest frame, and the IMU before it, fit the window.

    Attributes:
        agreed, not_agreed: landmarks that the first camera saw where they should be, and elsewhere.
        given_up: corners of landmarks that turned out to be none.
        reprojection_px: standard deviation of the residuals of the newest frame, from their median [px]; NaN without any.
        imu_ratio: residuals of the IMU over the last intervals, over what its noise explains; 1 is noise.
        lines: the same of lines.
    """

    agreed: int
    not_agreed: int
    given_up: Ints
    reprojection_px: float
    imu_ratio: float
    lines: LineFit = NO_LINES


@dataclass(slots=True)
class Seen:
    """Observations of landmarks, a row each: frame and landmark by their ids, camera, pixel."""

    frame: Ints
    landmark: Ints
    camera: Ints
    pixel: Floats

    @classmethod
    def none(cls) -> Seen:
        return cls(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)))

    def keep(self, kept: NDArray[np.bool_]) -> None:
        self.frame, self.landmark = self.frame[kept], self.landmark[kept]
        self.camera, self.pixel = self.camera[kept], self.pixel[kept]

    def add(self, frame: Ints, landmark: Ints, camera: Ints, pixel: Floats) -> None:
        self.frame, self.landmark = np.append(self.frame, frame), np.append(self.landmark, landmark)
        self.camera, self.pixel = np.append(self.camera, camera), np.concatenate([self.pixel, pixel])
