"""Do the sensors of a recording go together?

The first two cameras by their calibration, the first one and the IMU by how both turn.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras import CameraModel
from boxplus.recordings.cameras.info import CameraStream
from boxplus.recordings.info import Evidence
from boxplus.runs.inspection.cameras.carried import Followed, check_carried
from boxplus.runs.inspection.cameras.focal_length import check_focal_length
from boxplus.runs.inspection.cameras.known_turns import known_turns
from boxplus.runs.inspection.cameras.readout import check_readout
from boxplus.runs.inspection.cameras.rotation import Turns, align, check_rotation, measured_turns
from boxplus.runs.inspection.cameras.stereo import Corners, check_baseline, check_calibration
from boxplus.runs.inspection.cameras.tracking import Turned, follow, rotation_between
from boxplus.runs.inspection.cameras.two_motions import check_motions
from boxplus.sensors.images.camera_image import CameraImage
from boxplus.sensors.inertial.imu import ImuSamples

_STEREO_PAIRS = 12
_MOST_TURNS, _MOST_STILL = 240, 2000  # pairs of images in which the camera moves, and rests
_STILL_PX = 0.5  # median of the corners of images that stand: between them any rotation fits, beside some translation
_APART = 3
_SHOWN = 16  # grey values between the darkest and the brightest pixel of an image that shows something


class Comparison:
    """Notes images one by one, and says at the end what does not go together.

    Args:
        pictures: the cameras that deliver intensities.
        images: of each that will be noted, about.

    Attributes:
        turns: of the first camera.
    """

    def __init__(self, pictures: Sequence[CameraStream], images: int) -> None:
        self._pictures = list(pictures)
        self._every = max(1, images // _STEREO_PAIRS)
        self._still = 0  # pairs of images of the first camera between which it rests
        self._seconds = 0  # images of the second camera so far
        self._same = 0  # of the pairs that were compared
        self._last: tuple[int, NDArray[np.uint8]] | None = None
        self._corners = Corners()
        self._followed: list[Followed] = []
        self.turns = Turns(images=deque(maxlen=_APART))

    def note(self, image: CameraImage, grey: NDArray[np.uint8]) -> None:
        """The next image, and its grey values (H, W)."""
        if image.camera == self._pictures[0].index:
            self._turn(image.time_ns, grey)
            self._last = image.time_ns, grey
        elif len(self._pictures) > 1 and image.camera == self._pictures[1].index:
            self._seconds += 1
            if self._seconds % self._every == 0 and self._last is not None and self._last[0] == image.time_ns:
                self._same += bool(np.ptp(grey[::8, ::8]) > _SHOWN and np.array_equal(self._last[1], grey))
                before, after = follow(self._last[1], grey)
                self._corners.first.append(before)
                self._corners.second.append(after)

    def _turn(self, time_ns: int, grey: NDArray[np.uint8]) -> None:
        """Note how the first camera turned since its last image."""
        model, turns = self._pictures[0].model, self.turns
        if model is None or turns.tried >= _MOST_TURNS:
            return
        if turns.images and np.array_equal(turns.images[-1][1], grey):
            return  # the image before with another stamp: no turn between them is one of the camera
        # Over a few images the turn is larger and its error the same.
        if len(turns.images) == _APART:
            before_ns, before = turns.images[0]
            corners = follow(before, grey)
            if self._still < _MOST_STILL and _stand(*corners):
                self._still += 1
                turns.followed.append(len(corners[0]))
            else:
                self._turned(Followed(before_ns, time_ns, *corners), model)
        turns.images.append((time_ns, grey))

    def _turned(self, pair: Followed, model: CameraModel) -> None:
        """Note how the first camera turned between two images."""
        self._followed.append(pair)
        self.turns.tried += 1
        turned = rotation_between(model, pair.before, pair.after)
        self.turns.followed.append(turned.followed if isinstance(turned, Turned) else turned)
        if isinstance(turned, Turned):
            self.turns.add(pair.begin_ns, pair.end_ns, turned.R_2_1, turned.before, turned.after)

    def of_cameras(self) -> list[Evidence]:
        """Whether the stereo calibration fits, and its lengths are metres; nothing of one camera alone."""
        if len(self._pictures) < 2:
            return []
        pair = self._pictures[:2]
        return [*check_baseline(pair), check_calibration(pair, self._corners, self._same)]

    def of_view(self, origin_ns: int) -> list[Evidence]:
        """Whether something large moves by itself before the first camera; times count from `origin_ns`."""
        return check_motions(self._pictures[0], self._followed, origin_ns) if self._pictures else []

    def with_imu(self, imu: ImuSamples) -> list[Evidence]:
        """Whether camera and IMU turn alike and as far, and whether all rows of an image do; nothing without a camera."""
        if not self._pictures:
            return []
        camera = self._pictures[0]
        turns = measured_turns(self.turns, imu)
        aligned = align(turns, imu)
        found = check_rotation(camera, aligned)
        carried = check_carried(camera, self._followed, imu)
        if carried:  # which explains why both turn unlike
            return carried + [finding for finding in found if finding.value != "unlike"]
        if isinstance(aligned, str) or camera.model is None or any(e.value == "unlike" for e in found):
            return found
        if np.isfinite(aligned.offset_std_s):  # otherwise the clocks are so far apart that no turn is known
            known, *apart = (known_turns(camera, turns, imu, aligned, side) for side in (0.0, -1.0, 1.0))
            found += [check_readout(camera, known, apart), check_focal_length(camera, known)]
        return found


def _stand(before: NDArray[np.float64], after: NDArray[np.float64]) -> bool:
    """Whether images with these corners (N, 2) are of a camera that rests."""
    return len(before) > 0 and float(np.median(np.linalg.norm(after - before, axis=1))) < _STILL_PX
