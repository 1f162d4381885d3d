"""What the keyframes say of the calibration: of intrinsics and shutter, of a stereo pair, of where depths lie, and of depths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.pinhole import Pinhole
from boxplus.manifolds import se3
from boxplus.sensors.images.image import Image
from boxplus.systems.direct_alignment.tracking import Alignment
from boxplus.systems.direct_odometry.depth.sensed_depth import SensedDepth, StereoPair
from boxplus.systems.direct_odometry.sensor_watches.calibration_watch import CalibrationWatch, Depths
from boxplus.systems.direct_odometry.sensor_watches.carried_pixels import CarriedPixels
from boxplus.systems.direct_odometry.sensor_watches.depth_watch import DepthWatch, Surfaces
from boxplus.systems.direct_odometry.sensor_watches.leftover import Leftover
from boxplus.systems.direct_odometry.sensor_watches.registration_watch import RegistrationWatch
from boxplus.systems.direct_odometry.sensor_watches.stereo_watch import StereoWatch
from boxplus.systems.direct_odometry.two_view_start import TwoViews
from boxplus.systems.direct_odometry.window_system import WindowKeyframe

Matrix = NDArray[np.float64]
_RECENT_S = 0.25  # within which a motion is that of an instant


class Motion(NamedTuple):
    """How a camera moved since its last pose.

    Attributes:
        velocity: (6,) [w, v] of it in itself [rad/s, m/s], in the mean.
        elapsed_s: since then [s].
    """

    velocity: Matrix
    elapsed_s: float

    @classmethod
    def between(cls, T_before: Matrix, T_now: Matrix, elapsed_s: float) -> Motion:
        """From two poses (7,) T_world_camera, one later than the other by `elapsed_s` > 0."""
        return cls(se3.log(se3.compose(se3.inverse(T_before), T_now)) / elapsed_s, elapsed_s)

    @property
    def at_once(self) -> Matrix | None:
        """The velocity (6,) while an image is read out; None where the last pose is too long ago to tell it."""
        return self.velocity if self.elapsed_s < _RECENT_S else None


class SensorWatch:
    """Keyframe after keyframe; each is known by its number until it leaves the window.

    Args:
        stereo: the second camera of a stereo pair, None where there is none.
        is_alone: one camera alone, whose depths come from its motion.
    """

    def __init__(self, stereo: StereoPair | None = None, *, is_alone: bool = False) -> None:
        self._is_sensed = stereo is None and not is_alone
        depths: Depths = "motion" if is_alone else "sensed" if stereo is None else "stereo"
        self._calibration = CalibrationWatch(depths, stereo)
        self._depths, self._registration = DepthWatch(), RegistrationWatch()
        self._pair = None if stereo is None else StereoWatch(stereo)
        self._carried = CarriedPixels()
        self._surfaces: dict[int, Surfaces] = {}
        self._velocities: dict[int, Matrix] = {}

    def pair(self, left: Image, right: Image, depth: SensedDepth, camera: Pinhole, motion: Motion | None) -> None:
        """Both images of a keyframe of a stereo pair, and the depths that were found in them; motion: as in `frame`."""
        if self._pair is not None:
            self._pair.add(left, right, depth, camera, None if motion is None else motion.at_once)

    def begin_alone(self, views: TwoViews) -> None:
        """The start of one camera alone: where a part of the view is carried along, all that stands still in it is."""
        if views.is_partly_carried:
            self._carried.begin(views.first, views.second)

    def of_world(self, image: Image, depth: SensedDepth, T_world_camera: Matrix, log_gain: float, camera: Pinhole) -> SensedDepth:
        """Depths of a new keyframe without those of pixels that the camera carries along."""
        carried = self._carried.find(image, T_world_camera, log_gain, camera)
        return depth if carried is None else replace(depth, z=np.where(carried, np.float32(0.0), depth.z))

    def frame(self, keyframe: WindowKeyframe, image: Image, depth: SensedDepth, alignment: Alignment, motion: Motion) -> None:
        """A frame that shall become a keyframe, as it was aligned to another one."""
        if self._is_sensed:
            self._registration.add(image, _measured(depth))
        leftover = Leftover.of(keyframe, image.grey, alignment)
        if leftover is None:
            return
        before, now = self._velocities.get(keyframe.number), motion.at_once
        velocities = None if before is None or now is None else (before, now)
        self._calibration.add(leftover, keyframe.tracker.camera, image.shape[0], velocities)
        surfaces = self._surfaces.get(keyframe.number)
        if surfaces is not None:
            self._depths.add(leftover, surfaces, keyframe.tracker)

    def keyframe(self, keyframes: Sequence[WindowKeyframe], depth: SensedDepth, motion: Motion) -> None:
        """The keyframe it became.

        Args:
            keyframes: that frames may be aligned to, this one the last.
            motion: as in `frame`.
        """
        added, kept = keyframes[-1], {each.number for each in keyframes}
        self._surfaces = {number: known for number, known in self._surfaces.items() if number in kept}
        self._velocities = {number: known for number, known in self._velocities.items() if number in kept}
        if motion.at_once is not None:
            self._velocities[added.number] = motion.at_once
        if self._is_sensed and added.tracker.levels[-1].octave == 0 and added.tracker.camera.distortion is None:
            self._surfaces[added.number] = Surfaces.around(added.tracker, _measured(depth), motion.velocity)

    @property
    def remarks(self) -> dict[str, str]:
        """What makes poses worse than they have to be, a sentence for "shutter" and "carried" each where something does."""
        told = {"shutter": self._calibration.remark, "carried": self._carried.remark}
        return {about: remark for about, remark in told.items() if remark}

    @property
    def contradiction(self) -> str:
        """What contradicts the calibration, or drew the poses, in a sentence; empty where nothing does."""
        pair = "" if self._pair is None else self._pair.contradiction
        calibration = pair or self._calibration.contradiction or self._depths.contradiction
        return self._carried.contradiction or calibration or self._registration.contradiction


def _measured(depth: SensedDepth) -> NDArray[np.float32]:
    return np.where(depth.is_measured, depth.z, np.float32(0.0))
