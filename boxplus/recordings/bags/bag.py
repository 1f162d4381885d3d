"""Bags (ROS 1, ROS 2, MCAP) as a stream of events."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from boxplus.recordings import point_time
from boxplus.recordings.bags.clouds import coordinates, view_points
from boxplus.recordings.bags.container import Container, interval
from boxplus.recordings.bags.gnss import bag_fixes
from boxplus.recordings.bags.messages import (
    CloudMessage,
    MalformedMessageError,
    parse_imu,
)
from boxplus.recordings.bags.open_container import open_container
from boxplus.recordings.bags.probe import CLOUD_PARSERS
from boxplus.recordings.imu_units import ACCEL_SCALE, GYRO_SCALE
from boxplus.recordings.info import PointTimeReading, RecordingInfo
from boxplus.recordings.options import RecordingOptions
from boxplus.recordings.other_lidars import LidarEvent, find_out_all, merged_events
from boxplus.recordings.recording import Event, Recording, Tally
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.satellites.gnss import GnssFixes

_LARGEST_IMU_BLOCK = 1000
_LARGEST_IMU_VALUE = 1e5
_MOST_REASONS = 50


def open_bag(path: Path, options: RecordingOptions) -> Recording:
    """Open a bag and find out how to read it. Raises RecordingError and AmbiguityError as `open_recording` does."""
    container = open_container(path)
    try:
        info = find_out_all(path, container, options)
    except BaseException:
        container.close()
        raise
    start_ns, stop_ns = interval(container, options.start_s, options.duration_s)

    def read(tally: Tally) -> Iterator[Event]:
        events = _events(container, info, options, start_ns, stop_ns, tally)
        if info.other_lidars:
            return merged_events(events, info, tally)
        return (event if isinstance(event, ImuSamples) else event[1] for event in events)

    def read_fixes() -> GnssFixes:
        return bag_fixes(container, info.gnss_topic, start_ns, stop_ns)

    return Recording(info, read, container.close, read_fixes if info.gnss_topic else None)


class _ImuBlock:
    """IMU samples gathered until the next scan, in SI units on delivery."""

    def __init__(self, info: RecordingInfo) -> None:
        self._gyro_scale = GYRO_SCALE[info.gyro_unit]
        self._accel_scale = ACCEL_SCALE[info.accel_unit]
        self._time_ns: list[int] = []
        self._rows: list[tuple[float, ...]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, stamp_ns: int, gyro: tuple[float, ...], accel: tuple[float, ...]) -> None:
        self._time_ns.append(stamp_ns)
        self._rows.append(gyro + accel)

    def take(self, tally: Tally) -> ImuSamples:
        """The samples so far; NaN are delivered (the sequencer counts them), what no sensor can measure is dropped here."""
        rows, time_ns = np.array(self._rows, np.float64).reshape(-1, 6), np.array(self._time_ns, np.int64)
        self._time_ns, self._rows = [], []
        wild = (np.abs(rows) > _LARGEST_IMU_VALUE).any(axis=1)
        if wild.any():
            tally.rejected["messages: IMU values beyond any sensor"] += int(wild.sum())
            rows, time_ns = rows[~wild], time_ns[~wild]
        return ImuSamples.from_arrays(time_ns, rows[:, :3] * self._gyro_scale, rows[:, 3:] * self._accel_scale)


def _events(
    container: Container, info: RecordingInfo, options: RecordingOptions, start_ns: int, stop_ns: int, tally: Tally
) -> Iterator[LidarEvent]:
    container.damage.clear()
    imu = _ImuBlock(info)
    lidars = {info.lidar_topic: (0, info.point_time, options)}
    for number, (found, other) in enumerate(zip(info.other_lidars, options.other_lidars or (), strict=True), 1):
        lidars[found.topic] = number, found.point_time, options.alone(other)
    for channel, _, data in container.messages(frozenset((*lidars, info.imu_topic)), start_ns, stop_ns):
        tally.done += 1
        scan = None
        try:
            if channel.topic == info.imu_topic:
                stamp_ns, _, gyro, accel = parse_imu(data, channel.encoding)
                imu.add(stamp_ns, gyro, accel)
            else:
                lidar, reading, own = lidars[channel.topic]
                scan = scan_from_cloud(CLOUD_PARSERS[channel.type](data, channel.encoding), reading, own, tally)
        except MalformedMessageError as error:
            what = "IMU message" if channel.topic == info.imu_topic else "cloud"
            reason = str(error) if len(tally.rejected) < _MOST_REASONS else "other reasons"
            tally.rejected[f"messages: malformed {what} ({reason})"] += 1
        if (scan is not None or len(imu) >= _LARGEST_IMU_BLOCK) and len(block := imu.take(tally)):
            yield block
        if scan is not None:
            yield lidar, scan
    if len(block := imu.take(tally)):
        yield block
    tally.damage += container.damage


def scan_from_cloud(cloud: CloudMessage, reading: PointTimeReading, options: RecordingOptions, tally: Tally) -> Scan:
    """The scan of one cloud. A scan without points keeps the stamp of its message.

    Raises:
        MalformedMessageError: the cloud lacks the time field, or its sizes do not match.
    """
    points = view_points(cloud, reading.field)
    names = points.dtype.names or ()
    if reading.field is not None and "time" not in names:
        raise MalformedMessageError(f"no field {reading.field}")
    if not len(points):
        empty = np.empty(0, np.int64)
        return Scan(np.empty((0, 3), np.float32), empty, None, cloud.stamp_ns, cloud.stamp_ns, {})
    p_lidar = coordinates(points)
    intensity = points["intensity"].astype(np.float32) if "intensity" in names else None
    if reading.field is None:
        time_ns = np.full(len(points), cloud.stamp_ns, np.int64)
    else:
        time_ns, valid = point_time.absolute_times(reading, cloud.stamp_ns, points["time"])
        if not valid.all():
            tally.rejected["points: time not finite or outside the scan"] += int(len(valid) - valid.sum())
            p_lidar, time_ns = p_lidar[valid], time_ns[valid]
            intensity = None if intensity is None else intensity[valid]
    if not len(time_ns):
        return Scan(np.empty((0, 3), np.float32), time_ns, None, cloud.stamp_ns, cloud.stamp_ns, {})
    return Scan.from_arrays(p_lidar, time_ns, intensity, min_range=options.min_range, max_range=options.max_range)
