"""Images and IMU samples of all streams in the order of their stamps, images decoded when they are handed on."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np

from boxplus.errors import InputError
from boxplus.recordings.cameras.decode import MalformedImageError, Pixels
from boxplus.recordings.cameras.info import CameraRecordingInfo, CameraStream, ImuStream
from boxplus.recordings.imu_units import ACCEL_SCALE, GYRO_SCALE
from boxplus.recordings.recording import EventStream, Tally
from boxplus.sensors.images.camera_image import CameraImage
from boxplus.sensors.inertial.imu import ImuSamples

CameraEvent = CameraImage | ImuSamples

IMU = -1
"""Number of the IMU among the streams; cameras have their index."""

_LARGEST_IMU_BLOCK = 1000
_LARGEST_IMU_VALUE = 1e5
_JUMP_NS = 10_000_000_000
_LATE_NS = 1_000_000_000
_MOST_REASONS = 50


def time_of(event: CameraEvent) -> int:
    """When an image was taken, or the first of some samples [ns]."""
    return int(event.time_ns[0]) if isinstance(event, ImuSamples) else event.time_ns


class CameraRecording(EventStream[CameraRecordingInfo, CameraEvent]):
    """An opened camera recording. Iterating yields its images and blocks of IMU samples in the order of time.

    Before an image come all IMU samples up to its time, and none later; images of one instant come in the order of their
    cameras. One image at a time is decoded. Every iteration starts at the beginning and resets the counters.

    Example:
        >>> from boxplus.simulation.cameras import as_camera_recording, make_rig, simulate_cameras
        >>> rig = make_rig("mono", scale=0.25, rate_hz=5.0)
        >>> recording = as_camera_recording(simulate_cameras("room", duration_s=1.0, rig=rig))
        >>> images = [event for event in recording if isinstance(event, bp.CameraImage)]
        >>> len(images), images[0].grey().shape
        (4, (120, 188))
    """

    delivers = "images"


class Pending(NamedTuple):
    """An image that is not decoded yet, or an IMU sample.

    Attributes:
        time_ns: stamp, in the clock of the IMU.
        stream: index of the camera, or `IMU`.
        load: gives the pixels; raises MalformedImageError.
        values: angular velocity and acceleration as recorded.
        exposure_s: of an image, where known.
    """

    time_ns: int
    stream: int
    load: Callable[[], Pixels] | None = None
    values: tuple[float, ...] = ()
    exposure_s: float | None = None


class StampFilter:
    """Drops and counts what a stream stamps wrongly: steps back, repeated stamps, and single wild jumps ahead.

    A jump of more than 10 s ahead is believed when the next stamp goes on from there.
    """

    def __init__(self, names: dict[int, str], tally: Tally) -> None:
        self._names, self._tally = names, tally
        self._last: dict[int, int] = {}
        self._jump: dict[int, int] = {}

    def takes(self, stream: int, time_ns: int) -> bool:
        """Whether this stamp goes on from those before."""
        last = self._last.get(stream)
        if last is None:
            self._last[stream] = time_ns
            return True
        jumped = self._jump.pop(stream, None)
        if jumped is not None and 0 < time_ns - jumped < _JUMP_NS:
            last = jumped
        elif time_ns - last > _JUMP_NS:
            self._jump[stream] = time_ns
            self._tally.rejected[f"messages: {self._names[stream]}: stamp jumps ahead by more than 10 s"] += 1
            return False
        if time_ns <= last:
            how = "repeats the one before" if time_ns == last else "steps back"
            self._tally.rejected[f"messages: {self._names[stream]}: stamp {how}"] += 1
            return False
        self._last[stream] = time_ns
        return True


def in_order(items: Iterable[Pending], streams: Iterable[int], tally: Tally, names: dict[int, str]) -> Iterator[Pending]:
    """Items that arrive stream by stream in order, in the order of time over all streams.

    An item waits until every stream has passed its time, but no longer than one second of the streams' time; what
    arrives later than that is dropped and counted.
    """
    waiting: list[tuple[int, int, int, Pending]] = []
    newest = dict.fromkeys(streams, -(2**62))
    front = handed_on = -(2**62)
    for number, item in enumerate(items):
        if item.time_ns < handed_on:
            tally.rejected[f"messages: {names[item.stream]}: more than 1 s later than the other streams"] += 1
            continue
        heapq.heappush(waiting, (item.time_ns, item.stream, number, item))
        newest[item.stream] = item.time_ns
        front = max(front, item.time_ns)
        passed = max(min(newest.values()), front - _LATE_NS)
        # Of a stream that stands at `passed`, nothing as early can follow; of another one, an item of the same instant may.
        while waiting and (waiting[0][0] < passed or waiting[0][:2] == (passed, IMU)):
            handed_on, _, _, first = heapq.heappop(waiting)
            yield first
    while waiting:
        yield heapq.heappop(waiting)[3]


def assembled(
    items: Iterable[Pending], cameras: list[CameraStream], imu: ImuStream | None, tally: Tally
) -> Iterator[CameraEvent]:
    """Ordered items as events: IMU samples in blocks in SI units, images decoded and checked against their camera's size."""
    scale = np.ones(6)
    if imu is not None:
        scale = np.repeat((GYRO_SCALE[imu.gyro_unit], ACCEL_SCALE[imu.accel_unit]), 3)
    times: list[int] = []
    rows: list[tuple[float, ...]] = []
    for item in items:
        if item.load is None:
            times.append(item.time_ns)
            rows.append(item.values)
            if len(times) < _LARGEST_IMU_BLOCK:
                continue
        if times:
            block = _imu_block(times, rows, scale, tally)
            times, rows = [], []
            if len(block):
                yield block
        if item.load is not None:
            image = _image(item, item.load, cameras[item.stream], tally)
            if image is not None:
                yield image
    if times and len(block := _imu_block(times, rows, scale, tally)):
        yield block


def _imu_block(times: list[int], rows: list[tuple[float, ...]], scale: np.ndarray, tally: Tally) -> ImuSamples:
    time_ns, values = np.array(times, np.int64), np.array(rows, np.float64)
    usable = (np.abs(values) <= _LARGEST_IMU_VALUE).all(axis=1)  # False for NaN, too
    if not usable.all():
        tally.rejected["messages: IMU values not finite or beyond any sensor"] += int((~usable).sum())
        time_ns, values = time_ns[usable], values[usable]
    values = values * scale
    return ImuSamples.from_arrays(time_ns, values[:, :3], values[:, 3:])


def _image(item: Pending, load: Callable[[], Pixels], camera: CameraStream, tally: Tally) -> CameraImage | None:
    try:
        pixels = load()
        if pixels.shape[:2] != (camera.height, camera.width):
            got = f"{pixels.shape[1]}x{pixels.shape[0]}"
            raise MalformedImageError(f"{got} pixels where the first image has {camera.width}x{camera.height}")
        return CameraImage(camera.index, camera.name, item.time_ns, pixels, item.exposure_s, camera.depth_unit_m)
    except (MalformedImageError, OSError) as error:
        reason = str(error) if isinstance(error, MalformedImageError) else error.strerror or "not readable"
    except InputError as error:
        reason = error.got
    if len(tally.rejected) >= _MOST_REASONS:
        reason = "other reasons"
    tally.rejected[f"messages: image of {camera.name} ({reason})"] += 1
    return None
