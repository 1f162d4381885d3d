"""Findings about a recording of cameras, from one pass over it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import RecordingError
from boxplus.recordings.cameras.events import CameraRecording
from boxplus.recordings.cameras.info import CameraStream
from boxplus.recordings.info import Evidence
from boxplus.recordings.stream_checks import check_rate, check_rejected
from boxplus.runs.inspection.cameras.readout import check_readout
from boxplus.runs.inspection.cameras.rotation import Turns, align, check_rotation
from boxplus.runs.inspection.cameras.stereo import Corners, check_calibration, check_synchronisation
from boxplus.runs.inspection.cameras.tracking import Turned, follow, rotation_between
from boxplus.runs.inspection.cameras.views import Views, check_blur, check_corners, check_views
from boxplus.runs.inspection.imu_checks import check_finite, check_saturation
from boxplus.sensors.camera_image import CameraImage
from boxplus.sensors.eight_bits import EightBits
from boxplus.sensors.imu import ImuSamples

_SLOW_IMU_HZ = 50.0
_STEREO_PAIRS = 12
_MOST_TURNS = 240
_APART = 3


def examine_cameras(recording: CameraRecording, report: Callable[[float], None]) -> list[Evidence]:
    """Read a recording once and say what was found; nothing is raised for bad data."""
    info = recording.info
    views = {camera.index: Views() for camera in info.cameras}
    imu: list[ImuSamples] = []
    pictures = [camera for camera in info.cameras if camera.kind == "intensity"]
    turns = Turns(images=deque(maxlen=_APART))
    corners, to_8_bits = Corners(), EightBits()
    last: dict[int, tuple[int, NDArray[np.uint8]]] = {}
    every = max(1, pictures[0].count // _STEREO_PAIRS) if pictures else 1
    found: list[Evidence] = []
    try:
        for event in recording:
            report(recording.progress)
            if isinstance(event, ImuSamples):
                imu.append(event)
                continue
            grey = None if event.is_depth else to_8_bits(event.grey())
            views[event.camera].note(event, grey)
            if grey is None:
                continue
            _turn(event, grey, pictures[0], turns)
            second = len(pictures) > 1 and event.camera == pictures[1].index
            if second and len(views[event.camera].time_ns) % every == 0:
                _pair_up(last.get(pictures[0].index), event.time_ns, grey, corners)
            last[event.camera] = event.time_ns, grey
    except RecordingError as error:
        return [*info.evidence, Evidence("recording", "cannot be read", "error", str(error))]
    found += [*info.evidence, *check_rejected(recording.rejected)]
    for camera in info.cameras:
        found += check_rate(camera.name, np.array(views[camera.index].time_ns, np.int64), gap_factor=1.5)
        if camera.kind == "intensity":
            found += check_views(camera.name, views[camera.index])
            found += check_blur(camera.name, views[camera.index])
    if pictures:
        found += check_corners(pictures[0].name, turns.followed, views[pictures[0].index])
    if len(pictures) > 1:
        found.append(check_synchronisation(pictures[:2], [views[camera.index].time_ns for camera in pictures[:2]]))
        found.append(check_calibration(pictures[:2], corners))
    if imu:
        samples = ImuSamples.joined(imu)
        found += check_rate("imu", samples.time_ns, gap_factor=3.0, slow_hz=_SLOW_IMU_HZ)
        found += check_finite(samples)
        found.append(check_saturation(samples))
        found += _compared(pictures[0], turns, samples)
    return found


def _compared(camera: CameraStream, turns: Turns, imu: ImuSamples) -> list[Evidence]:
    """Whether camera and IMU turn alike, and whether all rows of an image do."""
    aligned = align(turns, imu)
    found = check_rotation(camera, aligned)
    if not isinstance(aligned, str) and camera.model is not None and not any(e.value == "unlike" for e in found):
        found += check_readout(camera, turns, imu, aligned)
    return found


def _turn(image: CameraImage, grey: NDArray[np.uint8], first: CameraStream, turns: Turns) -> None:
    """Note how the first camera turned since its last image."""
    if image.camera != first.index or first.model is None or turns.tried >= _MOST_TURNS:
        return
    # Over a few images the turn is larger and its error the same.
    if len(turns.images) == _APART:
        before_ns, before = turns.images[0]
        turns.tried += 1
        turned = rotation_between(first.model, before, grey)
        turns.followed.append(turned.followed if isinstance(turned, Turned) else turned)
        if isinstance(turned, Turned):
            turns.add(before_ns, image.time_ns, turned.R_2_1, turned.before, turned.after)
    turns.images.append((image.time_ns, grey))


def _pair_up(one: tuple[int, NDArray[np.uint8]] | None, time_ns: int, grey: NDArray[np.uint8], corners: Corners) -> None:
    """Note corners that both cameras see at one instant."""
    if one is not None and one[0] == time_ns:
        before, after = follow(one[1], grey)
        corners.first.append(before)
        corners.second.append(after)
