"""What is known about a recording, and on which evidence."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import printable
from boxplus.recordings.options import AccelUnit, GyroUnit, TimeReference, TimeUnit

Verdict = Literal["ok", "warning", "error"]


@dataclass(frozen=True, slots=True)
class Evidence:
    """One finding: what was looked at, what came out, and whether it is fine.

    Attributes:
        key: what the finding is about, stable (`point_time_unit`).
        value: the result, short (`ns`).
        verdict: `ok`, `warning` (works, look at it) or `error` (the result cannot be trusted).
        text: one sentence with the numbers, and what to do if it is not fine.

    Value and text may quote a file; what would steer a terminal is written out in them (`boxplus.errors.printable`).

    Example:
        >>> with bp.open_recording("flight.bag") as recording:
        ...     print([finding.value for finding in recording.info.evidence if finding.key == "point_time_unit"])
        ['s']
    """

    key: str
    value: str
    verdict: Verdict
    text: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "value", printable(self.value))
        object.__setattr__(self, "text", printable(self.text))


@dataclass(frozen=True, slots=True)
class Topic:
    """One stream of messages of a recording.

    Example:
        >>> with bp.open_recording("flight.bag") as recording:
        ...     print(sorted(topic.type for topic in recording.info.topics))
        ['sensor_msgs/Imu', 'sensor_msgs/PointCloud2', 'tf2_msgs/TFMessage']
    """

    name: str
    type: str
    count: int


@dataclass(frozen=True, slots=True)
class PointTimeReading:
    """How the point times of a recording are read.

    Attributes:
        field: name of the field, or None when every point is taken at the stamp of its message.
        unit: unit of its values.
        reference: instant from which they count.
        anchor: what is added to the values: `stamp` (times relative to the message's stamp), `first` or `last` (the first
            or last point of each scan is moved onto the stamp), `clock` (the values are absolute).

    Example:
        >>> from boxplus.recordings import PointTimeReading
        >>> PointTimeReading("t", "ns", "scan_start", "stamp").unit  # nanoseconds since the stamp, in a field t
        'ns'
    """

    field: str | None
    unit: TimeUnit
    reference: TimeReference
    anchor: Literal["stamp", "first", "last", "clock"]


@dataclass(frozen=True, slots=True)
class OtherLidarInfo:
    """A LiDAR that is merged with the first one.

    Attributes:
        topic, frame: its topic, and the name of its frame.
        point_time: how its point times are read.
        T_lidar_other: (4, 4) float64, its coordinates to those of the first LiDAR; source: where that comes from.
        time_offset_s: added to its times [s].
        messages: that will be read.

    Example:
        >>> from boxplus.recordings import OtherLidarInfo, PointTimeReading
        >>> reading = PointTimeReading("t", "ns", "scan_start", "stamp")
        >>> OtherLidarInfo("/rear", "rear", reading, np.eye(4), "given", 0.0, 120).source
        'given'
    """

    topic: str
    frame: str
    point_time: PointTimeReading
    T_lidar_other: NDArray[np.float64]
    source: str
    time_offset_s: float
    messages: int


def no_imu(given: bool) -> Evidence:
    """What is said of a recording without an IMU, or one that is to be read without it."""
    why = "left out, as asked for" if given else "the recording holds none"
    text = f"{why}: odometry of the LiDAR alone, in a world that does not know where down is"
    return Evidence("imu_topic", "none", "ok" if given else "warning", text)


@dataclass(slots=True)
class RecordingInfo:
    """What a recording contains and how it is read.

    Attributes:
        path: the file or folder.
        format: `ROS 1 bag`, `ROS 2 bag (mcap)`, `KITTI raw folder` …
        topics: all streams found.
        duration_s: time between the first and the last message [s].
        message_count: messages that will be read (LiDAR and IMU).
        lidar_topic, imu_topic: the streams in use; no IMU takes part where the latter is empty.
        lidar_frame, imu_frame: the names of their frames, empty when the format has none.
        point_time: how point times are read.
        gyro_unit, accel_unit: units in the recording (samples are delivered in SI units).
        T_imu_lidar: (4, 4) float64, LiDAR coordinates to IMU coordinates, or None when the recording does not say.
        T_imu_lidar_source: where it comes from; empty when unknown.
        gnss_topic: stream of positions by satellite in use; empty where there is none.
        p_imu_antenna: (3,) the antenna in the IMU's frame [m], or None when the recording does not say.
        evidence: every decision with its reasons; grows while a damaged file is read.
        stamp_delay_s: median time from the stamp of a cloud to its reception, where it is known [s].
        other_lidars: those that are merged with the first one.

    Example:
        >>> with bp.open_recording("flight.bag") as recording:
        ...     info = recording.info
        >>> info.lidar_topic, info.imu_topic, info.accel_unit, info.T_imu_lidar.shape
        ('/lidar/points', '/imu/data', 'm/s2', (4, 4))
    """

    path: Path
    format: str
    topics: list[Topic]
    duration_s: float
    message_count: int
    lidar_topic: str
    imu_topic: str
    lidar_frame: str
    imu_frame: str
    point_time: PointTimeReading
    gyro_unit: GyroUnit
    accel_unit: AccelUnit
    T_imu_lidar: NDArray[np.float64] | None = None
    T_imu_lidar_source: str = ""
    gnss_topic: str = ""
    p_imu_antenna: NDArray[np.float64] | None = None
    evidence: list[Evidence] = field(default_factory=list)
    stamp_delay_s: float = 0.0
    other_lidars: list[OtherLidarInfo] = field(default_factory=list)
