"""What the first seconds of a bag show: topics, point times, units, extrinsic."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from boxplus.errors import AmbiguityError, RecordingError
from boxplus.recordings import point_time
from boxplus.recordings.bags.clouds import cloud_layout, coordinates, view_points
from boxplus.recordings.bags.container import Channel, Container, interval, share
from boxplus.recordings.bags.gnss import antenna_of, choose_gnss
from boxplus.recordings.bags.messages import (
    CloudMessage,
    MalformedMessageError,
    parse_imu,
    parse_livox,
    parse_point_cloud,
    parse_transforms,
)
from boxplus.recordings.bags.transforms import Chain, Transform, chain
from boxplus.recordings.imu_units import read_accel_unit, read_gyro_unit
from boxplus.recordings.info import Evidence, PointTimeReading, RecordingInfo, Topic, no_imu
from boxplus.recordings.options import NO_IMU, AccelUnit, GyroUnit, RecordingOptions, check_start

CLOUD_PARSERS = {
    "sensor_msgs/PointCloud2": parse_point_cloud,
    "livox_ros_driver/CustomMsg": parse_livox,
    "livox_ros_driver2/CustomMsg": parse_livox,
}
IMU_TYPE = "sensor_msgs/Imu"
TRANSFORM_TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")

_PROBE_NS = 6_000_000_000
_PROBE_SCANS = 30
_SAME_CLOCK_S = 2.0
_MOST_TRANSFORM_MESSAGES = 1000
_MOST_RENAMINGS = 2  # of a topic's frame


@dataclass(slots=True)
class _CloudProbe:
    """What the first clouds of one topic show."""

    fields: tuple[str, ...] = ()
    time_fields: tuple[str, ...] = ()
    times: list[point_time.CloudTimes] = field(default_factory=list)
    stamp_ns: list[int] = field(default_factory=list)
    received_ns: list[int] = field(default_factory=list)
    frames: list[str] = field(default_factory=list)
    seen: int = 0
    complaint: str = ""

    @property
    def frame(self) -> str:
        return self.frames[-1] if self.frames else ""


@dataclass(slots=True)
class _ImuProbe:
    """What the first samples of the IMU show."""

    time_ns: list[int] = field(default_factory=list)
    received_ns: list[int] = field(default_factory=list)
    gyro: list[tuple[float, ...]] = field(default_factory=list)
    accel: list[tuple[float, ...]] = field(default_factory=list)
    frames: list[str] = field(default_factory=list)

    @property
    def frame(self) -> str:
        return self.frames[-1] if self.frames else ""


def find_out(path: Path, container: Container, options: RecordingOptions) -> RecordingInfo:
    channels = [channel for channel in container.channels if channel.count > 0]
    evidence = [Evidence("file", "damaged", "warning", text) for text in container.damage]
    imu = _choose_imu(channels, options)
    clouds = _cloud_candidates(channels, options)
    check_start(options.start_s, (container.end_ns - container.start_ns) * 1e-9)
    cloud_probes, imu_probe, transforms = _probe(container, clouds, imu, options)
    lidar = _choose_lidar(clouds, cloud_probes, options)
    probe = cloud_probes[lidar.topic]
    evidence.append(_chosen("lidar_topic", lidar, [c for c in channels if c.type in CLOUD_PARSERS], options.lidar_topic))
    if imu is None:
        evidence.append(no_imu(options.imu_topic is not None))
    else:
        evidence.append(_chosen("imu_topic", imu, [c for c in channels if c.type == IMU_TYPE], options.imu_topic))

    if not probe.seen:
        raise RecordingError(
            f"point clouds on {lidar.topic}",
            f"none that can be read in the first seconds{f' ({probe.complaint})' if probe.complaint else ''}",
            "choose another --lidar-topic or convert the recording to sensor_msgs/PointCloud2",
        )
    _check_frames(lidar.topic, probe.frames)
    lidar_delay = _delay_ns(lidar.topic, probe.stamp_ns, probe.received_ns)
    delay: float | None = None
    if imu is not None:
        if not imu_probe.time_ns:
            raise RecordingError(
                f"IMU messages on {imu.topic}", "none that can be read in the first seconds", "choose another --imu-topic"
            )
        _check_frames(imu.topic, imu_probe.frames)
        delay = _delay_ns(imu.topic, imu_probe.time_ns, imu_probe.received_ns)
        evidence.append(_clocks(lidar_delay - delay))
    reading = PointTimeReading(None, "ns", "scan_start", "stamp")
    name = point_time.choose_time_field(probe.fields, probe.time_fields, options)
    if name is not None:
        reading, found = point_time.read_point_time(name, probe.times, delay, options)
        evidence += found
    else:
        text = "every point is taken at the stamp of its scan, as asked for: motion within a scan is not corrected"
        evidence.append(Evidence("point_time_field", "none", "warning", text))
    gyro_unit: GyroUnit = "rad/s"
    accel_unit: AccelUnit = "m/s2"
    T_imu_lidar, source = None, ""
    if imu is not None:
        gyro, accel = np.array(imu_probe.gyro), np.array(imu_probe.accel)
        accel_unit, accel_evidence = read_accel_unit(accel, options)
        gyro_unit, gyro_evidence = read_gyro_unit(gyro, options)
        evidence += [gyro_evidence, accel_evidence]
        T_imu_lidar, source, found_extrinsic = _extrinsic(container, transforms, imu_probe.frame, probe.frame)
        evidence.append(found_extrinsic)
    gnss, found_gnss = choose_gnss(channels, options.gnss_topic)
    evidence += found_gnss
    p_imu_antenna = None
    if gnss is not None and imu is not None:
        p_imu_antenna, found_antenna = antenna_of(container, gnss, transforms, imu_probe.frame)
        evidence.append(found_antenna)
    messages = lidar.count + (0 if imu is None else imu.count)
    return RecordingInfo(
        path=path,
        format=container.format,
        topics=[Topic(channel.topic, channel.type, channel.count) for channel in container.channels],
        duration_s=(container.end_ns - container.start_ns) * 1e-9,
        message_count=round(messages * share(container, options.start_s, options.duration_s)),
        lidar_topic=lidar.topic,
        imu_topic=imu.topic if imu is not None else "",
        lidar_frame=probe.frame,
        imu_frame=imu_probe.frame,
        point_time=reading,
        gyro_unit=gyro_unit,
        accel_unit=accel_unit,
        T_imu_lidar=T_imu_lidar,
        T_imu_lidar_source=source,
        gnss_topic=gnss.topic if gnss is not None else "",
        p_imu_antenna=p_imu_antenna,
        evidence=evidence,
        stamp_delay_s=lidar_delay * 1e-9,
    )


def _check_frames(topic: str, frames: list[str]) -> None:
    """Raise RecordingError when the messages are those of several sensors in turn; a frame may get another name once."""
    if sum(before != after for before, after in pairwise(frames)) > _MOST_RENAMINGS:
        raise RecordingError(
            f"the messages of one sensor on {topic}",
            f"those of several in turn, in the frames {', '.join(map(repr, dict.fromkeys(frames)))}",
            "record every sensor on a topic of its own, or take those of the others out of the recording",
        )


def _delay_ns(topic: str, stamp_ns: list[int], received_ns: list[int]) -> float:
    """Time from stamp to reception [ns]. Raises RecordingError when the stamps stand still."""
    if len(stamp_ns) >= 3 and min(stamp_ns) == max(stamp_ns):
        raise RecordingError(
            f"stamps on {topic} that go on from message to message",
            f"the same stamp {stamp_ns[0] * 1e-9:.3f} s on the first {len(stamp_ns)} messages",
            "let the driver fill in header.stamp; the times of reception are too rough to replace it",
        )
    return point_time.delay_ns(stamp_ns, received_ns)


def _clocks(difference_ns: float) -> Evidence:
    """Compares how long after their stamps the messages of LiDAR and IMU arrived."""
    seconds = difference_ns * 1e-9
    text = f"clouds arrive {seconds:+.3f} s after their stamps, compared with IMU messages"
    if abs(seconds) < _SAME_CLOCK_S:
        return Evidence("clocks", "one", "ok", text)
    advice = "LiDAR and IMU are stamped by different clocks: synchronise them (PTP, or the driver's host time)"
    return Evidence("clocks", "differ", "error", f"{text}: {advice}")


def _listed(channels: list[Channel]) -> str:
    return ", ".join(f"{channel.topic} [{channel.type}, {channel.count}]" for channel in channels) or "none"


def _choose_imu(channels: list[Channel], options: RecordingOptions) -> Channel | None:
    """The IMU in use; None where there is none, or none is wanted."""
    if options.imu_topic == NO_IMU:
        return None
    found = [channel for channel in channels if channel.type == IMU_TYPE]
    if options.imu_topic is not None:
        found = [channel for channel in found if channel.topic == options.imu_topic]
        if not found:
            raise RecordingError(
                f"IMU messages ({IMU_TYPE}) on {options.imu_topic}", f"topics {_listed(channels)}", "choose another --imu-topic"
            )
    if len(found) > 1:
        raise AmbiguityError("one IMU topic", f"several: {_listed(found)}", "choose one with --imu-topic")
    return found[0] if found else None


def _cloud_candidates(channels: list[Channel], options: RecordingOptions) -> list[Channel]:
    found = [channel for channel in channels if channel.type in CLOUD_PARSERS]
    if options.lidar_topic is not None:
        found = [channel for channel in found if channel.topic == options.lidar_topic]
        if not found:
            raise RecordingError(
                f"point clouds ({', '.join(CLOUD_PARSERS)}) on {options.lidar_topic}",
                f"topics {_listed(channels)}",
                "choose another --lidar-topic",
            )
    if not found:
        raise RecordingError(
            f"a LiDAR topic ({', '.join(CLOUD_PARSERS)})",
            f"topics {_listed(channels)}",
            "raw packet topics must be converted to clouds by the LiDAR's driver first; "
            "a recording of cameras without LiDAR is read by open_camera_recording",
        )
    return found


def _choose_lidar(candidates: list[Channel], probes: dict[str, _CloudProbe], options: RecordingOptions) -> Channel:
    """The only candidate, or the only one whose points have times."""
    if len(candidates) == 1:
        return candidates[0]
    timed = [channel for channel in candidates if probes[channel.topic].time_fields]
    if options.point_time_field is not None:
        timed = [channel for channel in candidates if options.point_time_field in probes[channel.topic].fields]
    if len(timed) == 1:
        return timed[0]
    raise AmbiguityError(
        "one LiDAR topic",
        f"several: {_listed(timed or candidates)}",
        "choose one with --lidar-topic; --other-lidars merges another one with it",
    )


def _chosen(key: str, chosen: Channel, candidates: list[Channel], given: str | None) -> Evidence:
    how = (
        "given" if given is not None else "the only one of its kind" if len(candidates) == 1 else "the only one with point times"
    )
    return Evidence(key, chosen.topic, "ok", f"{chosen.type}, {chosen.count} messages; {how}")


def _probe(
    container: Container, clouds: list[Channel], imu: Channel | None, options: RecordingOptions
) -> tuple[dict[str, _CloudProbe], _ImuProbe, list[Transform]]:
    """Read the first seconds: extents of the point times, IMU samples, static transforms."""
    probes = {channel.topic: _CloudProbe() for channel in clouds}
    samples = _ImuProbe()
    transforms: list[Transform] = []
    static = frozenset(c.topic for c in container.channels if c.type in TRANSFORM_TYPES and c.topic.endswith("tf_static"))
    start_ns, stop_ns = interval(container, options.start_s, options.duration_s)
    topics = {*probes, *static, *([] if imu is None else [imu.topic])}
    first_ns: int | None = None
    for channel, received_ns, data in container.messages(frozenset(topics), start_ns, stop_ns):
        first_ns = received_ns if first_ns is None else first_ns
        enough = (imu is None or samples.time_ns) and all(probe.seen >= 3 or probe.complaint for probe in probes.values())
        if received_ns - first_ns > (_PROBE_NS if enough else 10 * _PROBE_NS):
            break
        try:
            if channel.type in TRANSFORM_TYPES:
                transforms += parse_transforms(data, channel.encoding)
            elif imu is not None and channel.topic == imu.topic:
                stamp_ns, frame, gyro, accel = parse_imu(data, channel.encoding)
                samples.time_ns.append(stamp_ns)
                samples.received_ns.append(received_ns)
                samples.gyro.append(gyro)
                samples.accel.append(accel)
                samples.frames.append(frame)
            elif probes[channel.topic].seen < _PROBE_SCANS:
                _probe_cloud(probes[channel.topic], CLOUD_PARSERS[channel.type](data, channel.encoding), received_ns, options)
        except MalformedMessageError as error:
            if channel.topic in probes:
                probes[channel.topic].complaint = str(error)
    return probes, samples, transforms


def _probe_cloud(probe: _CloudProbe, cloud: CloudMessage, received_ns: int, options: RecordingOptions) -> None:
    layout = cloud_layout(cloud.fields, cloud.big_endian, cloud.point_step, None)
    probe.fields = tuple(field.name for field in cloud.fields)
    probe.time_fields = layout.time_fields
    probe.frames.append(cloud.frame)
    probe.stamp_ns.append(cloud.stamp_ns)
    probe.received_ns.append(received_ns)
    probe.seen += 1
    name = options.point_time_field or (layout.time_fields[0] if len(layout.time_fields) == 1 else None)
    if name in probe.fields:
        points = view_points(cloud, name)
        p_lidar = coordinates(points)
        measured = np.logical_and(np.isfinite(p_lidar).all(axis=1), p_lidar.any(axis=1))
        times = point_time.times_of_cloud(cloud.stamp_ns, received_ns, points["time"], measured)
        if times is not None:
            probe.times.append(times)


def static_chain(container: Container, transforms: list[Transform], target: str, source: str) -> Chain | None:
    """The transform between two frames from the static transforms, those known first; None: not connected."""
    found = chain(transforms, target, source)
    topics = frozenset(
        c.topic for c in container.channels if c.type in TRANSFORM_TYPES and c.topic.endswith("tf_static") and c.count
    )
    if found is not None or not topics:
        return found
    later: list[Transform] = []
    for number, (channel, _, data) in enumerate(container.messages(topics, container.start_ns, container.end_ns + 1)):
        if number >= _MOST_TRANSFORM_MESSAGES:
            break
        try:
            later += parse_transforms(data, channel.encoding)
        except MalformedMessageError:
            continue
    return chain(later, target, source)


def _extrinsic(
    container: Container, transforms: list[Transform], imu_frame: str, lidar_frame: str
) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.float64]] | None, str, Evidence]:
    key = "T_imu_lidar"
    if imu_frame == lidar_frame:
        text = f"LiDAR and IMU both name the frame {imu_frame!r}, which says nothing about their mounting: give --T-imu-lidar"
        return None, "", Evidence(key, "unknown", "warning", text)
    found = static_chain(container, transforms, imu_frame, lidar_frame)
    if found is None:
        what = (
            f"the static transforms do not connect {imu_frame!r} and {lidar_frame!r}"
            if any(c.type in TRANSFORM_TYPES and c.topic.endswith("tf_static") and c.count for c in container.channels)
            else "the recording has no static transforms"
        )
        return (
            None,
            "",
            Evidence(key, "unknown", "warning", f"{what}: give --T-imu-lidar, or the rotation is estimated from the data"),
        )
    T_imu_lidar, way, disagreement = found
    source = f"static transforms {' ← '.join(way)}"
    text = f"LiDAR pose in the IMU frame from the {source}"
    if disagreement:
        advice = "record one of them only, or say which holds with --T-imu-lidar"
        return T_imu_lidar, source, Evidence(key, "static transforms", "warning", f"{text}; {disagreement}: {advice}")
    return T_imu_lidar, source, Evidence(key, "static transforms", "ok", text)
