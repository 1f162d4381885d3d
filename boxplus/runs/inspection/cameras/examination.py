"""Findings about a recording of cameras, from one pass over it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import RecordingError
from boxplus.recordings.cameras.events import CameraRecording
from boxplus.recordings.cameras.info import CameraStream
from boxplus.recordings.info import Evidence, Verdict
from boxplus.recordings.stream_checks import check_rate, check_rejected
from boxplus.runs.inspection.cameras.rotation import Turns, check_rotation
from boxplus.runs.inspection.cameras.tracking import follow, grey_8_bit, rotation_between
from boxplus.runs.inspection.imu_checks import check_finite, check_saturation
from boxplus.sensors.camera_image import CameraImage
from boxplus.sensors.imu import ImuSamples

_SLOW_IMU_HZ = 50.0
_JUMP = 0.25  # of the mean brightness, between neighbours
_DARK, _BRIGHT = 15.0, 240.0
_STEREO_PAIRS = 12
_EPIPOLAR_PX = 1.5
_MOST_TURNS = 240
_APART = 3


@dataclass(slots=True)
class _Seen:
    """What is kept of one camera."""

    time_ns: list[int] = field(default_factory=list)
    brightness: list[float] = field(default_factory=list)


def examine_cameras(recording: CameraRecording, report: Callable[[float], None]) -> list[Evidence]:
    """Read a recording once and say what was found; nothing is raised for bad data."""
    info = recording.info
    seen = {camera.index: _Seen() for camera in info.cameras}
    imu: list[ImuSamples] = []
    pictures = [camera for camera in info.cameras if camera.kind == "intensity"]
    turns = Turns(images=deque(maxlen=_APART))
    errors_px: list[float] = []
    last: dict[int, tuple[int, NDArray[np.uint8]]] = {}
    every = max(1, pictures[0].count // _STEREO_PAIRS) if pictures else 1
    found: list[Evidence] = []
    try:
        for event in recording:
            report(recording.progress)
            if isinstance(event, ImuSamples):
                imu.append(event)
                continue
            _note(event, seen[event.camera])
            if event.is_depth:
                continue
            grey = grey_8_bit(event.grey())
            _turn(event, grey, pictures[0], turns, info.imu is not None)
            if len(pictures) > 1 and event.camera == pictures[1].index and len(seen[event.camera].time_ns) % every == 0:
                errors_px += _epipolar(pictures, last, event.time_ns, grey)
            last[event.camera] = event.time_ns, grey
    except RecordingError as error:
        return [*info.evidence, Evidence("recording", "cannot be read", "error", str(error))]
    found += [*info.evidence, *check_rejected(recording.rejected)]
    for camera in info.cameras:
        found += check_rate(camera.name, np.array(seen[camera.index].time_ns, np.int64), gap_factor=1.5)
        if camera.kind == "intensity":
            found.append(_brightness(camera, seen[camera.index]))
    if len(pictures) > 1:
        found.append(_synchronisation(pictures[:2], seen))
        found.append(_stereo(pictures[:2], errors_px))
    if imu:
        samples = ImuSamples.joined(imu)
        found += check_rate("imu", samples.time_ns, gap_factor=3.0, slow_hz=_SLOW_IMU_HZ)
        found += check_finite(samples)
        found.append(check_saturation(samples))
        found += check_rotation(pictures[0], turns, samples)
    return found


def _note(image: CameraImage, seen: _Seen) -> None:
    seen.time_ns.append(image.time_ns)
    seen.brightness.append(float(image.pixels[::4, ::4].mean()) / (257.0 if image.pixels.dtype == np.uint16 else 1.0))


def _turn(
    image: CameraImage,
    grey: NDArray[np.uint8],
    first: CameraStream,
    turns: Turns,
    with_imu: bool,
) -> None:
    """Note how the first camera turned since its last image."""
    if not with_imu or image.camera != first.index or first.model is None or turns.tried >= _MOST_TURNS:
        return
    # Over a few images the turn is larger and its error the same.
    if len(turns.images) == _APART:
        before_ns, before = turns.images[0]
        turns.tried += 1
        R = rotation_between(first.model, before, grey)
        if R is not None:
            turns.add(before_ns, image.time_ns, R)
    turns.images.append((image.time_ns, grey))


def _epipolar(
    pictures: list[CameraStream], last: dict[int, tuple[int, NDArray[np.uint8]]], time_ns: int, grey: NDArray[np.uint8]
) -> list[float]:
    """Distances [px] of corners in the second camera from their epipolar planes, for two images of one instant."""
    one, two = pictures[0], pictures[1]
    if one.index not in last or last[one.index][0] != time_ns:
        return []
    if one.model is None or two.model is None or one.T_body_camera is None or two.T_body_camera is None:
        return []
    before, after = follow(last[one.index][1], grey)
    bearings_1, found_1 = one.model.bearings(before)
    bearings_2, found_2 = two.model.bearings(after)
    kept = found_1 & found_2
    T_2_1 = np.linalg.inv(two.T_body_camera) @ one.T_body_camera
    normals = np.cross(T_2_1[:3, 3], bearings_1[kept] @ T_2_1[:3, :3].T)
    lengths = np.linalg.norm(normals, axis=1)
    usable = lengths > 1e-9
    sines = np.einsum("ni,ni->n", bearings_2[kept][usable], normals[usable]) / lengths[usable]
    return list(np.abs(sines) * two.model.fx)


def _brightness(camera: CameraStream, seen: _Seen) -> Evidence:
    values = np.array(seen.brightness)
    key = f"{camera.name}_brightness"
    if not len(values):
        return Evidence(key, "unknown", "warning", "no image could be decoded")
    steps = np.abs(np.diff(values)) / np.maximum(values[:-1], 1.0)
    jumps = int((steps > _JUMP).sum())
    outside = int(((values < _DARK) | (values > _BRIGHT)).sum())
    text = f"means from {values.min():.0f} to {values.max():.0f} of 255"
    verdict: Verdict = "ok"
    if jumps:
        verdict = "warning"
        where = (seen.time_ns[int(np.argmax(steps)) + 1] - seen.time_ns[0]) * 1e-9
        text += (
            f"; {jumps} jumps by more than {100 * _JUMP:.0f} % between neighbours, the largest {where:.2f} s after the start: "
        )
        text += "features are lost there; fix the exposure or let it change slowly"
    if outside:
        verdict = "warning"
        text += f"; {outside} of {len(values)} images are almost black or almost white"
    return Evidence(key, f"{np.median(values):.0f}", verdict, text)


def _synchronisation(pair: list[CameraStream], seen: dict[int, _Seen]) -> Evidence:
    one, two = (np.array(seen[camera.index].time_ns, np.int64) for camera in pair)
    key = f"{pair[0].name}_{pair[1].name}_synchronisation"
    if len(one) < 2 or not len(two):
        return Evidence(key, "unknown", "warning", f"{len(one)} and {len(two)} images: nothing to compare")
    period = float(np.median(np.diff(one)))
    at = np.clip(np.searchsorted(two, one), 1, max(len(two) - 1, 1))
    nearest = np.where(np.abs(two[at - 1] - one) <= np.abs(two[np.minimum(at, len(two) - 1)] - one), at - 1, at)
    nearest = np.minimum(nearest, len(two) - 1)
    apart = (two[nearest] - one) * 1e-6
    partners = np.abs(apart) < 0.25e-6 * period
    alone = int((~partners).sum())
    usual = float(np.median(np.abs(apart[partners]))) if partners.any() else float("inf")
    text = f"{len(one)} and {len(two)} images; {alone} without a partner; stamps of a pair are {usual:.3f} ms apart in the median"
    if not partners.any():
        return Evidence(key, "none", "error", f"{text}: these cameras are not synchronised, their images are no stereo pairs")
    if usual > 1.0 or alone > 0.1 * len(one):
        return Evidence(key, f"{usual:.3f} ms", "warning", f"{text}: trigger both cameras together, or treat them as two")
    return Evidence(key, f"{usual:.3f} ms", "ok", text)


def _stereo(pair: list[CameraStream], errors_px: list[float]) -> Evidence:
    key = f"{pair[0].name}_{pair[1].name}_epipolar"
    if len(errors_px) < 50:
        text = f"{len(errors_px)} corners of pairs of one instant, with calibration: too few to check the stereo calibration"
        return Evidence(key, "unchecked", "warning", text)
    median = float(np.median(errors_px))
    text = f"median distance of {len(errors_px)} corners from their epipolar lines with the calibration that is used"
    if median > _EPIPOLAR_PX:
        text += ": the stereo calibration does not fit these images (swapped cameras, an inverted transform, another rig?)"
        return Evidence(key, f"{median:.2f} px", "error", text)
    return Evidence(key, f"{median:.2f} px", "ok", text)
