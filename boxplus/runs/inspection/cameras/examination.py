"""Findings about a recording of cameras, from one pass over it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from boxplus.errors import RecordingError
from boxplus.recordings.cameras.events import CameraRecording, time_of
from boxplus.recordings.info import Evidence
from boxplus.recordings.stream_checks import check_rate, check_rejected
from boxplus.runs.inspection.cameras.comparison import Comparison
from boxplus.runs.inspection.cameras.stereo import check_synchronisation
from boxplus.runs.inspection.cameras.views import GAP_FACTOR, Views, check_blur, check_corners, check_views
from boxplus.runs.inspection.imu_checks import check_saturation, check_values
from boxplus.sensors.images.eight_bits import EightBits
from boxplus.sensors.inertial.imu import ImuSamples

_SLOW_IMU_HZ = 50.0


def examine_cameras(recording: CameraRecording, report: Callable[[float], None]) -> list[Evidence]:
    """Read a recording once and say what was found; nothing is raised for bad data."""
    info = recording.info
    views = {camera.index: Views() for camera in info.cameras}
    imu: list[ImuSamples] = []
    pictures = [camera for camera in info.cameras if camera.kind == "intensity"]
    to_8_bits = EightBits()
    compared = Comparison(pictures, pictures[0].count if pictures else 0)
    found: list[Evidence] = []
    origin_ns: int | None = None
    try:
        for event in recording:
            report(recording.progress)
            if origin_ns is None:
                origin_ns = time_of(event)
            if isinstance(event, ImuSamples):
                imu.append(event)
                continue
            grey = None if event.is_depth else to_8_bits(event.grey())
            views[event.camera].note(event, grey)
            if grey is None:
                continue
            compared.note(event, grey)
    except RecordingError as error:
        return [*info.evidence, Evidence("recording", "cannot be read", "error", str(error))]
    found += [*info.evidence, *check_rejected(recording.rejected)]
    for camera in info.cameras:
        found += check_rate(camera.name, np.array(views[camera.index].time_ns, np.int64), gap_factor=GAP_FACTOR)
        if camera.kind == "intensity":
            found += check_views(camera.name, views[camera.index])
            found += check_blur(camera.name, views[camera.index])
    if pictures:
        found += check_corners(pictures[0].name, compared.turns.followed, views[pictures[0].index])
        found += compared.of_view(origin_ns or 0)
    if len(pictures) > 1:
        found.append(check_synchronisation(pictures[:2], [views[camera.index].time_ns for camera in pictures[:2]]))
        found += compared.of_cameras()
    if imu:
        samples = ImuSamples.joined(imu)
        found += check_rate("imu", samples.time_ns, gap_factor=3.0, slow_hz=_SLOW_IMU_HZ)
        found += check_values(samples)
        found.append(check_saturation(samples))
        found += compared.with_imu(samples)
    return found
