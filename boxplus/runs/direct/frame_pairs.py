"""Streams of a camera recording as frames: an image with its depth, left with right, or one camera alone."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import RecordingError
from boxplus.manifolds import quaternion
from boxplus.recordings.cameras.info import CameraRecordingInfo, CameraStream
from boxplus.sensors.images.camera_image import CameraImage
from boxplus.systems.direct_odometry.depth.sensed_depth import StereoPair

_SAME_PLACE = 1e-6
_SHARE_OF_PERIOD = 0.5  # stamps of two streams may differ by this much of the time between images
_MOST_WAITING = 20

Kind = Literal["rgbd", "stereo", "mono"]
Frame = tuple[CameraImage, CameraImage | None]


@dataclass(frozen=True, slots=True)
class ChosenCameras:
    """Which streams an odometry takes, and what it has to know of them.

    Attributes:
        kind: `rgbd`, `stereo` or `mono`.
        first, second: the images that have the poses; their depths, the right images, or None.
        camera: of the first; stereo: of the second where it has intensities.
    """

    kind: Kind
    first: CameraStream
    second: CameraStream | None
    camera: Pinhole
    stereo: StereoPair | None

    @property
    def tolerance_ns(self) -> int:
        """By how much stamps of a frame may differ [ns]."""
        rate_hz = self.first.rate_hz if np.isfinite(self.first.rate_hz) else 10.0
        return round(_SHARE_OF_PERIOD * 1e9 / rate_hz)


def choose_cameras(info: CameraRecordingInfo, *, mono: bool = False) -> ChosenCameras:
    """Depth with the first camera where there is depth, else the first two cameras, else the only one.

    Args:
        mono: the first camera alone in any case.

    Raises:
        RecordingError: no camera; calibration that is not known; depths that are not registered.
    """
    intensity = [camera for camera in info.cameras if camera.kind == "intensity"]
    depths = [camera for camera in info.cameras if camera.kind == "depth"]
    if not intensity:
        found = ", ".join(f"{camera.name} ({camera.kind})" for camera in info.cameras) or "none"
        advice = "record images with it, grey ones of 16 bits as mono16: 16UC1 is depth (REP 118)"
        raise RecordingError("images of intensities", found, f"depth alone has no grey values to compare: {advice}")
    first = intensity[0]
    one = first.calibrated()
    if not isinstance(one.model, Pinhole):
        raise RecordingError(
            f"a pinhole for {first.name}", type(one.model).__name__, "undistort the images to those of a pinhole"
        )
    if mono or (not depths and len(intensity) < 2):
        return ChosenCameras("mono", first, None, one.model, None)
    if depths:
        second = depths[0]
        _check_registered(first, second)
        return ChosenCameras("rgbd", first, second, one.model, None)
    second = intensity[1]
    two = second.calibrated()
    T_right_left = np.linalg.inv(two.T_body_camera) @ one.T_body_camera
    pose = np.concatenate([quaternion.from_matrix(T_right_left[:3, :3]), T_right_left[:3, 3]])
    return ChosenCameras("stereo", first, second, one.model, StereoPair(two.model, pose))


def _check_registered(first: CameraStream, depth: CameraStream) -> None:
    """Refuse depths that are known to lie on other pixels than the images'."""
    if (first.width, first.height) != (depth.width, depth.height):
        raise RecordingError(
            f"depths of {first.width}x{first.height} pixels, as {first.name}",
            f"{depth.width}x{depth.height}",
            "register the depth to the images: each depth belongs to the pixel of the image",
        )
    same = True
    if first.T_body_camera is not None and depth.T_body_camera is not None:
        same = bool(np.abs(first.T_body_camera - depth.T_body_camera).max() < _SAME_PLACE)
    if isinstance(first.model, Pinhole) and isinstance(depth.model, Pinhole):
        same = same and np.allclose(first.model.padded_parameters, depth.model.padded_parameters)
    if not same:
        raise RecordingError(
            f"depths that are registered to {first.name}",
            f"{depth.name} with another calibration",
            "take the registered topic of the driver, or register the depth first",
        )


class FramePairs:
    """Images of the two streams whose stamps are closest, in the order of time.

    Args:
        cameras: which streams.

    Attributes:
        rejected: images without a partner, by stream.
    """

    def __init__(self, cameras: ChosenCameras) -> None:
        self._cameras = cameras
        self._first: deque[CameraImage] = deque()
        self._second: deque[CameraImage] = deque()
        self.rejected: Counter[str] = Counter()

    def snapshot(self) -> dict[str, object]:
        """The images that wait, and what was rejected; only to be read."""
        return {name: value for name, value in vars(self).items() if name != "_cameras"}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from a `snapshot`."""
        vars(self).update(snapshot)

    def push(self, image: CameraImage) -> list[Frame]:
        """Take an image of one of the streams; returns the frames that are complete."""
        if self._cameras.second is None:
            return [(image, None)]
        (self._first if image.camera == self._cameras.first.index else self._second).append(image)
        return list(self._matched(self._cameras.second.name, False))

    def flush(self) -> list[Frame]:
        """The frames that are left, when no image follows."""
        return [] if self._cameras.second is None else list(self._matched(self._cameras.second.name, True))

    def _matched(self, second_name: str, is_end: bool) -> Iterator[Frame]:
        first, second, names = self._first, self._second, (self._cameras.first.name, second_name)
        while first:
            time_ns = first[0].time_ns
            # A closer partner may still come until one is there that is as late as the image.
            if not is_end and (not second or second[-1].time_ns < time_ns) and len(first) < _MOST_WAITING:
                return
            closest = min(second, key=lambda image: abs(image.time_ns - time_ns), default=None)
            if closest is None or abs(closest.time_ns - time_ns) > self._cameras.tolerance_ns:
                self.rejected[f"images of {names[0]} without one of {names[1]}"] += 1
                first.popleft()
                continue
            while second[0] is not closest:
                self.rejected[f"images of {names[1]} without one of {names[0]}"] += 1
                second.popleft()
            second.popleft()
            yield first.popleft(), closest
