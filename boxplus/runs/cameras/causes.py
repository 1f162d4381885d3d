"""What may be the cause of a run that fails, or contradicts itself: the checks of `boxplus inspect` on the part where it did.

An odometry sees that its sensors do not go together, not why. How camera and gyroscope turn, one beside the other, and where
the corners of two cameras lie, tells clocks apart from mountings, and both from an IMU that is another's.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from boxplus.errors import RecordingError
from boxplus.recordings.cameras.events import CameraEvent, time_of
from boxplus.recordings.cameras.info import CameraRecordingInfo, CameraStream
from boxplus.recordings.info import Evidence
from boxplus.recordings.stream_checks import check_rate
from boxplus.runs.inspection.cameras.comparison import Comparison
from boxplus.runs.inspection.cameras.stereo import check_synchronisation
from boxplus.runs.inspection.cameras.views import GAP_FACTOR, Views, check_corners, check_views
from boxplus.runs.inspection.imu_checks import check_repeats, check_saturation
from boxplus.sensors.images.eight_bits import EightBits
from boxplus.sensors.inertial.imu import ImuSamples

MAY_BE = "this may be the cause"
_CALIBRATION = ("_shutter", "_focal_length", "_imu_time_offset")  # what an odometry may take for a motion, and say nothing
_MOUNTING = "R_imu_"
_APART = "deg apart"
BEFORE_S = 14.0
"""How much of a recording before an instant is looked at [s]."""

_AFTER_S = 2.0
_MARGIN_NS = 500_000_000  # of IMU samples on both sides


def likely_causes(
    info: CameraRecordingInfo, events: Iterator[CameraEvent], cameras: int, around_ns: int | None, *, with_imu: bool = True
) -> list[Evidence]:
    """What does not go together, by readings that need no odometry; nothing where these find nothing.

    Args:
        info: of the recording.
        events: of it, from the beginning; sixteen seconds are looked at.
        cameras: how many of them the run uses.
        around_ns: when the run contradicted itself [ns]; None where it never began, and its beginning is looked at.
        with_imu: whether the run uses the IMU as well.
    """
    views = {camera.index: Views() for camera in _pictures(info, cameras)}
    compared = _compared(info, events, cameras, around_ns, views)
    if compared is None:
        return []
    comparison, imu, origin_ns = compared
    pictures = _pictures(info, cameras)
    found = [finding for camera in pictures for finding in _of_images(camera.name, views[camera.index])]
    found += check_corners(pictures[0].name, comparison.turns.followed, views[pictures[0].index])
    found += comparison.of_view(origin_ns)
    if len(pictures) > 1:
        found.append(check_synchronisation(pictures[:2], [views[camera.index].time_ns for camera in pictures[:2]]))
    found += comparison.of_cameras()
    if with_imu and len(imu):
        found += [*check_repeats(imu), check_saturation(imu), *comparison.with_imu(imu)]
    return _wrong(found)


def calibration_doubts(
    info: CameraRecordingInfo, events: Iterator[CameraEvent], around_ns: int, *, time_offset_s: float = 0.0
) -> list[str]:
    """Sentences about clock, mounting, shutter and focal length of the first camera, by how the gyroscope turns.

    Of a run that saw no trouble: a motion that changes little hides all of them in velocity, scale and biases.

    Args:
        info, events: as of `likely_causes`.
        around_ns: the end of fourteen seconds in which the camera turns [ns].
        time_offset_s: what the run found that is to be added to the times of the images, beside what the recording knows [s].
    """
    compared = _compared(info, events, 1, around_ns, {}, round(1e9 * time_offset_s))
    if compared is None or not len(compared[1]):
        return []
    comparison, imu, _ = compared
    return [sentence(finding) for finding in _wrong(comparison.with_imu(imu)) if _is_of_calibration(finding)]


def _is_of_calibration(finding: Evidence) -> bool:
    """Whether it is about what a calibration states; that both turn unlike may be too few corners, and a run without trouble."""
    return finding.key.endswith(_CALIBRATION) or (finding.key.startswith(_MOUNTING) and finding.value.endswith(_APART))


def _pictures(info: CameraRecordingInfo, cameras: int) -> list[CameraStream]:
    return [camera for camera in info.cameras if camera.kind == "intensity"][:cameras]


def _compared(
    info: CameraRecordingInfo,
    events: Iterator[CameraEvent],
    cameras: int,
    around_ns: int | None,
    views: Mapping[int, Views],
    late_ns: int = 0,
) -> tuple[Comparison, ImuSamples, int] | None:
    """The first cameras around an instant, the samples there, and when the recording begins [ns]; None where it cannot be read.

    Args:
        views: of each camera, where its images are to be noted as well.
        late_ns: added to the times of the images that are compared [ns].
    """
    pictures = _pictures(info, cameras)
    rate_hz = pictures[0].count / max(info.duration_s, 1e-3)
    compared = Comparison(pictures, min(pictures[0].count, round(rate_hz * (BEFORE_S + _AFTER_S))))
    begin_ns, origin_ns = None, 0
    to_8_bits, imu = EightBits(), []
    try:
        for event in events:
            time_ns = time_of(event)
            if begin_ns is None:
                origin_ns = time_ns
                begin_ns = time_ns if around_ns is None else max(time_ns, around_ns - round(1e9 * BEFORE_S))
                end_ns = begin_ns + round(1e9 * (BEFORE_S + _AFTER_S))
            if time_ns > end_ns + _MARGIN_NS:
                break
            if isinstance(event, ImuSamples):
                if event.time_ns[-1] > begin_ns - _MARGIN_NS:
                    imu.append(event)
            elif not event.is_depth and event.camera < cameras and time_ns >= begin_ns:
                grey = to_8_bits(event.grey())
                compared.note(replace(event, time_ns=event.time_ns + late_ns), grey)
                if event.camera in views:
                    views[event.camera].note(event, grey)
    except RecordingError:
        return None
    return compared, ImuSamples.joined(imu), origin_ns


def _of_images(name: str, seen: Views) -> list[Evidence]:
    """Images that are missing, dark, or show nothing; nothing of a camera that has none there."""
    if len(seen.time_ns) < 2:
        return []
    return check_rate(name, np.array(seen.time_ns, np.int64), gap_factor=GAP_FACTOR) + check_views(name, seen)


def sentence(finding: Evidence) -> str:
    """What was found, with its numbers."""
    return f"{finding.key} {finding.value}: {finding.text}"


def _wrong(found: list[Evidence]) -> list[Evidence]:
    """Those that are not as they should be."""
    return [finding for finding in found if finding.verdict != "ok" and finding.value != "unchecked"]
