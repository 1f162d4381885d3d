"""Whether the grey values contradict the calibration: wrong focal lengths bend the images of a turn, rolling shutters shear them.

What is asked for depends on where depths come from (`calibration_causes.py`). Depths of a sensor do not change with the
intrinsics. Those of a stereo pair do, with the focal lengths of both cameras, and with a turn of the second one as well, which
puts all disparities off alike; as they err pixel by pixel, a smooth surface through them gives instruments (`leftover.py`).
Depths by the motion follow the intrinsics in a way of their own: they are taken for known to a fifth only, so that pixels count
whose gradient runs across where the depth moves them.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.systems.direct_odometry.depth.sensed_depth import StereoPair
from boxplus.systems.direct_odometry.sensor_watches.calibration_causes import (
    by_focal_length,
    by_principal_point,
    by_readout,
    by_turn_of_second,
)
from boxplus.systems.direct_odometry.sensor_watches.leftover import Combined, Leftover

Matrix = NDArray[np.float64]
Depths = Literal["sensed", "stereo", "motion"]
Cause = Literal["focal length", "along u", "along v", "turn of the second camera", "readout"]

_CAUSES: dict[Depths, tuple[Cause, ...]] = {
    "sensed": ("focal length", "along u", "along v", "readout"),
    "stereo": ("focal length", "turn of the second camera", "readout"),
    "motion": ("focal length", "readout"),
}
_LEAST_SIGMAS = 5.0  # for a contradiction
_LEAST: dict[Cause, float] = {
    "focal length": 0.02,
    "along u": 0.02,
    "along v": 0.02,
    "turn of the second camera": 0.004,
    "readout": 0.006,
}
"""Smaller errors than these do not need to be told: shares of the focal length, radians, seconds."""
_OWN_ERROR: dict[Cause, float] = {
    "focal length": 0.003,
    "along u": 0.003,
    "along v": 0.003,
    "turn of the second camera": 0.001,
    "readout": 0.001,
}
"""Standard deviations of one frame that its scatter does not show: interpolation, vignetting, a velocity that changes."""
_SHOWN_PX = 0.01  # by which the least of a cause has to move the pixels of a frame that is asked for it
_ERROR_BY_MOTION = 0.2  # share of an inverse depth by the motion that it may be off


class CalibrationWatch:
    """What the frames so far say of the calibration.

    Args:
        depths: where those of the keyframes come from.
        stereo: the second camera, where they come from it.

    Raises:
        InputError: depths of a stereo pair without its second camera, or other depths with one.
    """

    def __init__(self, depths: Depths = "sensed", stereo: StereoPair | None = None) -> None:
        if (depths == "stereo") != (stereo is not None):
            got = f"depths {depths!r} {'without one' if stereo is None else 'with one'}"
            raise InputError("a second camera if, and only if, depths are 'stereo'", got, "give both or none")
        self._depths, self._stereo, self._causes = depths, stereo, _CAUSES[depths]
        self._found = Combined(len(self._causes), [_OWN_ERROR[cause] for cause in self._causes])

    def add(self, leftover: Leftover, camera: Pinhole, height: int, velocities: tuple[Matrix, Matrix] | None) -> None:
        """A frame that was aligned to a keyframe.

        Args:
            height: of the image [pixels].
            velocities: (6,) [w, u] of the camera at the keyframe and at the frame, in itself [rad/s, m/s]; None where they are
                not known: then nothing is asked of the shutter.
        """
        share = leftover.share_without(_ERROR_BY_MOTION) if self._depths == "motion" else None
        asked: dict[int, Matrix] = {}
        for k, cause in enumerate(self._causes):
            moved = self._moved(cause, leftover, camera, height, velocities)
            if moved is not None and _LEAST[cause] * np.sqrt(np.mean(moved**2)) > _SHOWN_PX:
                asked[k] = moved
        if not asked:
            return
        instruments = None
        if self._stereo is not None:
            smooth = leftover.smoothed()
            of_smooth = [self._moved(self._causes[k], smooth, camera, height, velocities) for k in asked]
            instruments = smooth.columns([moved for moved in of_smooth if moved is not None])
        found = leftover.explained_by(list(asked.values()), share, instruments)
        if found is not None:
            self._found.add(*found, list(asked))

    def _moved(
        self, cause: Cause, leftover: Leftover, camera: Pinhole, height: int, velocities: tuple[Matrix, Matrix] | None
    ) -> Matrix | None:
        """(n, 2) ∂p₂ by a cause; None where it is not known."""
        if cause == "readout":
            return None if velocities is None else by_readout(leftover, height, velocities)
        if cause == "turn of the second camera":
            return None if self._stereo is None else by_turn_of_second(leftover, self._stereo)
        if cause in ("along u", "along v"):
            return by_principal_point(leftover, camera, 0 if cause == "along u" else 1)
        return by_focal_length(leftover, camera, self._stereo)

    @property
    def contradiction(self) -> str:
        """What of the calibration must be wrong, in a sentence; empty where nothing is."""
        return self._said([cause for cause in self._causes if cause != "readout"])

    @property
    def remark(self) -> str:
        """A rolling shutter, in a sentence, which makes poses worse and not wrong; empty where there is none."""
        return self._said(["readout"])

    def _said(self, causes: list[Cause]) -> str:
        least = [_LEAST[cause] if cause in causes else np.inf for cause in self._causes]
        found = self._found.strongest(least, _LEAST_SIGMAS)
        return "" if found is None else _sentence(self._causes[found[0]], *found[1:])


def _sentence(cause: Cause, q: float, sigma: float) -> str:
    if cause == "readout":
        return (
            f"grey values look like those of a rolling shutter with {1e3 * q:.0f} ms from the first row to the last, with a "
            f"standard deviation of {1e3 * sigma:.1f} ms, and direct odometry takes images for taken at once: where the camera "
            "moves fast, it errs; use a camera with a global shutter, or 'boxplus vio' with line_delay"
        )
    if cause == "turn of the second camera":
        return (
            f"depths by the motion contradict those of the stereo pair: they ask for a second camera that is turned by "
            f"{np.degrees(abs(q)):.2f} degrees in the plane of the baseline, with a standard deviation of "
            f"{np.degrees(sigma):.2f}; check the stereo calibration"
        )
    name = "the focal length" if cause == "focal length" else f"the principal point {cause}"
    kind = "" if cause == "focal length" else " of the focal length"
    return (
        f"grey values contradict {name}: they ask for {100.0 * q:+.1f} %{kind}, with a standard deviation of "
        f"{100.0 * sigma:.1f} %; check the calibration, and whether the images were scaled or cropped"
    )
