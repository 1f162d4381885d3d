"""Bags (ROS 1, ROS 2, MCAP) as images and IMU samples in the order of time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from boxplus.recordings.bags.container import Container, interval
from boxplus.recordings.bags.messages import MalformedMessageError, parse_imu
from boxplus.recordings.bags.open_container import open_container
from boxplus.recordings.cameras.bag_probe import IMAGE_PARSERS, IMU_TYPE, find_out
from boxplus.recordings.cameras.events import IMU, CameraEvent, CameraRecording, Pending, StampFilter, assembled, in_order
from boxplus.recordings.cameras.info import CameraRecordingInfo
from boxplus.recordings.cameras.options import CameraRecordingOptions
from boxplus.recordings.recording import Tally

_MOST_REASONS = 50


def open_camera_bag(path: Path, options: CameraRecordingOptions) -> CameraRecording:
    """Open a bag with images. Raises RecordingError and AmbiguityError as `open_camera_recording` does."""
    container = open_container(path)
    try:
        info, topics = find_out(path, container, options)
    except BaseException:
        container.close()
        raise
    start_ns, stop_ns = interval(container, options.start_s, options.duration_s)

    def read(tally: Tally) -> Iterator[CameraEvent]:
        container.damage.clear()
        names = {camera.index: camera.name for camera in info.cameras} | {IMU: "imu"}
        streams = [camera.index for camera in info.cameras] + ([IMU] if info.imu is not None else [])
        arrived = _items(container, info, topics, (start_ns, stop_ns), names, tally)
        yield from assembled(in_order(arrived, streams, tally, names), info.cameras, info.imu, tally)
        tally.damage += container.damage

    return CameraRecording(info, read, container.close)


def _items(
    container: Container,
    info: CameraRecordingInfo,
    topics: list[str],
    interval_ns: tuple[int, int],
    names: dict[int, str],
    tally: Tally,
) -> Iterator[Pending]:
    """Messages in the order of reception, those with wrong stamps left out."""
    stamps = StampFilter(names, tally)
    index_of = {topic: index for index, topic in enumerate(topics)}
    shift_ns = [round((camera.time_offset_s or 0.0) * 1e9) for camera in info.cameras]
    wanted = frozenset(topics) | (frozenset((info.imu.source,)) if info.imu is not None else frozenset())
    for channel, _, data in container.messages(wanted, *interval_ns):
        tally.done += 1
        stream = IMU if channel.type == IMU_TYPE else index_of[channel.topic]
        try:
            if stream == IMU:
                stamp_ns, _, gyro, accel = parse_imu(data, channel.encoding)
                item = Pending(stamp_ns, IMU, None, gyro + accel)
            else:
                image = IMAGE_PARSERS[channel.type](data, channel.encoding)
                stamp_ns = image.stamp_ns
                item = Pending(stamp_ns + shift_ns[stream], stream, image.pixels)
        except MalformedMessageError as error:
            reason = str(error) if len(tally.rejected) < _MOST_REASONS else "other reasons"
            tally.rejected[f"messages: malformed message of {names[stream]} ({reason})"] += 1
            continue
        if stamps.takes(stream, stamp_ns):
            yield item
