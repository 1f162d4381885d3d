"""What the keyframes of an RGB-D camera say of its calibration: of intrinsics, of where depths lie, and of depths themselves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.sensors.image import Image
from boxplus.systems.direct_alignment.tracking import Alignment
from boxplus.systems.direct_odometry.calibration_watch import CalibrationWatch
from boxplus.systems.direct_odometry.depth.sensed_depth import SensedDepth
from boxplus.systems.direct_odometry.depth_watch import DepthWatch, Surfaces
from boxplus.systems.direct_odometry.leftover import Leftover
from boxplus.systems.direct_odometry.registration_watch import RegistrationWatch
from boxplus.systems.direct_odometry.window_system import WindowKeyframe

Matrix = NDArray[np.float64]


class SensorWatch:
    """Keyframe after keyframe; each is known by its number until it leaves the window."""

    def __init__(self) -> None:
        self._intrinsics, self._depths, self._registration = CalibrationWatch(), DepthWatch(), RegistrationWatch()
        self._surfaces: dict[int, Surfaces] = {}

    def frame(self, keyframe: WindowKeyframe, image: Image, depth: SensedDepth, alignment: Alignment) -> None:
        """A frame that shall become a keyframe, as it was aligned to another one."""
        self._registration.add(image, _measured(depth))
        leftover = Leftover.of(keyframe, image.grey, alignment)
        if leftover is None:
            return
        self._intrinsics.add(leftover, keyframe.tracker.camera)
        surfaces = self._surfaces.get(keyframe.number)
        if surfaces is not None:
            self._depths.add(leftover, surfaces, keyframe.tracker)

    def keyframe(self, keyframes: Sequence[WindowKeyframe], depth: SensedDepth, moved: Matrix, elapsed_s: float) -> None:
        """The keyframe it became.

        Args:
            keyframes: that frames may be aligned to, this one the last.
            moved: (7,) from the camera's last pose to this one, T_last_now, in `elapsed_s` [s].
        """
        added, kept = keyframes[-1], {each.number for each in keyframes}
        self._surfaces = {number: known for number, known in self._surfaces.items() if number in kept}
        if elapsed_s > 0.0 and added.tracker.levels[-1].octave == 0:
            self._surfaces[added.number] = Surfaces.around(added.tracker, _measured(depth), se3.log(moved) / elapsed_s)

    @property
    def contradiction(self) -> str:
        """What contradicts the calibration, in a sentence; empty where nothing does."""
        return self._intrinsics.contradiction or self._depths.contradiction or self._registration.contradiction


def _measured(depth: SensedDepth) -> NDArray[np.float32]:
    return np.where(depth.is_measured, depth.z, np.float32(0.0))
