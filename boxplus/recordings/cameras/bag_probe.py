"""What the beginning of a bag shows of its cameras: topics, sizes, calibration, and the IMU's units."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from boxplus._extras import require
from boxplus.errors import AmbiguityError, RecordingError
from boxplus.recordings.bags.container import Channel, Container, interval, share
from boxplus.recordings.bags.messages import MalformedMessageError, parse_imu
from boxplus.recordings.cameras.bag_calibration import by_topic, given_for, plain_topic, stated_in_bag, static_messages
from boxplus.recordings.cameras.calibration import StatedRig, read_camchain, usable_mountings
from boxplus.recordings.cameras.decode import DEPTH_ENCODINGS, MalformedImageError
from boxplus.recordings.cameras.info import CameraRecordingInfo, ImuStream
from boxplus.recordings.cameras.messages import (
    COMPRESSED_TYPE,
    IMAGE_TYPE,
    ImageMessage,
    parse_compressed,
    parse_image,
)
from boxplus.recordings.cameras.options import CameraRecordingOptions
from boxplus.recordings.cameras.streams import FoundCamera, camera_streams, rate_hz
from boxplus.recordings.imu_units import read_accel_unit, read_gyro_unit
from boxplus.recordings.info import Evidence, Topic
from boxplus.recordings.options import RecordingOptions, check_start

IMAGE_PARSERS = {IMAGE_TYPE: parse_image, COMPRESSED_TYPE: parse_compressed}
IMU_TYPE = "sensor_msgs/Imu"
_TRANSFORM_TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")

_PROBE_NS = 4_000_000_000
_MOST_STATIC_MESSAGES = 1000
_MOST_PROBED_IMAGES = 20
_SAME_CLOCK_S = 2.0


@dataclass(slots=True)
class _Probe:
    """What the first messages of one topic show."""

    time_ns: list[int] = field(default_factory=list)
    received_ns: list[int] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)
    frame: str = ""
    first: ImageMessage | None = None
    size: tuple[int, int] = (0, 0)
    complaint: str = ""

    def delay_s(self) -> float:
        """Median time from stamp to reception [s]."""
        return float(np.median(np.array(self.received_ns) - np.array(self.time_ns))) * 1e-9


def find_out(path: Path, container: Container, options: CameraRecordingOptions) -> tuple[CameraRecordingInfo, list[str]]:
    """What a bag holds, and the topics of its cameras in the order of their indices."""
    channels = [channel for channel in container.channels if channel.count > 0]
    evidence = [Evidence("file", "damaged", "warning", text) for text in container.damage]
    images = _image_channels(channels, options, evidence)
    imu = _imu_channel(channels, options)
    check_start(options.start_s, (container.end_ns - container.start_ns) * 1e-9)
    probes = _probe(container, images, imu, options)
    infos, transforms = static_messages(container, channels)
    given = StatedRig({}, True)
    source = ""
    if options.calibration is not None:
        given, source = read_camchain(options.calibration), options.calibration.name
    rig = usable_mountings(given, imu is not None, by_topic(given.cameras, images[0].topic), source)
    for channel in images:
        _check_image(channel, probes[channel.topic])
    found = []
    for channel in images:
        probe = probes[channel.topic]
        stated = given_for(channel.topic, rig, source)
        body_frame = probes[imu.topic].frame if imu is not None else probes[images[0].topic].frame
        is_body = imu is None and channel is images[0]
        stated.append(stated_in_bag(channel.topic, probe.frame, infos, transforms, body_frame, is_body))
        unit, unit_source = _depth_unit(probe, options)
        found.append(
            FoundCamera(
                name=plain_topic(channel.topic),
                kind="intensity" if unit is None else "depth",
                source=channel.topic,
                time_ns=probe.time_ns,
                count=channel.count,
                size=probe.size,
                stated=stated,
                frame=probe.frame,
                depth_unit_m=unit,
                depth_unit_source=unit_source,
            )
        )
    stream: ImuStream | None = None
    if imu is not None:
        stream, findings = _imu_stream(imu, probes[imu.topic], given, source, options)
        evidence += findings
        evidence += [_clocks(channel.topic, probes[channel.topic].delay_s() - probes[imu.topic].delay_s()) for channel in images]
    cameras, findings = camera_streams(found, imu is not None)
    count = sum(channel.count for channel in images) + (imu.count if imu is not None else 0)
    info = CameraRecordingInfo(
        path=path,
        format=container.format,
        topics=[Topic(channel.topic, channel.type, channel.count) for channel in container.channels],
        duration_s=(container.end_ns - container.start_ns) * 1e-9,
        message_count=round(count * share(container, options.start_s, options.duration_s)),
        cameras=cameras,
        imu=stream,
        evidence=evidence + findings,
    )
    return info, [channel.topic for channel in images]


def _listed(channels: list[Channel]) -> str:
    return ", ".join(f"{channel.topic} [{channel.type}, {channel.count}]" for channel in channels) or "none"


def _image_channels(channels: list[Channel], options: CameraRecordingOptions, evidence: list[Evidence]) -> list[Channel]:
    found = {channel.topic: channel for channel in channels if channel.type in IMAGE_PARSERS}
    if options.image_topics is not None:
        absent = [topic for topic in options.image_topics if topic not in found]
        if absent or not options.image_topics or len(set(options.image_topics)) < len(options.image_topics):
            raise RecordingError(
                f"images ({', '.join(IMAGE_PARSERS)}) on {', '.join(options.image_topics) or 'at least one topic'}, each once",
                f"topics {_listed(channels)}",
                "choose other image_topics",
            )
        return [found[topic] for topic in options.image_topics]
    if not found:
        raise RecordingError(
            f"an image topic ({', '.join(IMAGE_PARSERS)})", f"topics {_listed(channels)}", "record the images, raw or compressed"
        )
    for topic in list(found):
        if topic != plain_topic(topic) and plain_topic(topic) in found:
            del found[topic]
            text = f"left out: {plain_topic(topic)} holds the same images without compression"
            evidence.append(Evidence("image_topics", topic, "ok", text))
    by_folder: dict[str, list[Channel]] = {}
    for channel in found.values():
        by_folder.setdefault(plain_topic(channel.topic).rpartition("/")[0], []).append(channel)
    for folder, several in by_folder.items():
        if folder and len(several) > 1:
            raise AmbiguityError(
                f"one image topic of the camera {folder}", f"several: {_listed(several)}", "choose with image_topics"
            )
    return [found[topic] for topic in sorted(found)]


def _imu_channel(channels: list[Channel], options: CameraRecordingOptions) -> Channel | None:
    found = [channel for channel in channels if channel.type == IMU_TYPE]
    if options.imu_topic is not None:
        found = [channel for channel in found if channel.topic == options.imu_topic]
        if not found:
            raise RecordingError(
                f"IMU messages ({IMU_TYPE}) on {options.imu_topic}", f"topics {_listed(channels)}", "choose another imu_topic"
            )
    if len(found) > 1:
        raise AmbiguityError("one IMU topic", f"several: {_listed(found)}", "choose one with imu_topic")
    return found[0] if found else None


def _probe(
    container: Container, images: list[Channel], imu: Channel | None, options: CameraRecordingOptions
) -> dict[str, _Probe]:
    """Read the first seconds: stamps, frames, the first image of each camera, IMU samples."""
    probes = {channel.topic: _Probe() for channel in [*images, *([imu] if imu is not None else [])]}
    start_ns, stop_ns = interval(container, options.start_s, options.duration_s)
    first_ns: int | None = None
    for channel, received_ns, data in container.messages(frozenset(probes), start_ns, stop_ns):
        first_ns = received_ns if first_ns is None else first_ns
        enough = all(len(probe.time_ns) >= 3 for probe in probes.values())
        if received_ns - first_ns > (_PROBE_NS if enough else 10 * _PROBE_NS):
            break
        probe = probes[channel.topic]
        if channel.type != IMU_TYPE and len(probe.time_ns) >= _MOST_PROBED_IMAGES:
            continue
        try:
            if channel.type == IMU_TYPE:
                stamp_ns, frame, gyro, accel = parse_imu(data, channel.encoding)
                probe.values.append(gyro + accel)
            else:
                image = IMAGE_PARSERS[channel.type](data, channel.encoding)
                stamp_ns, frame = image.stamp_ns, image.frame
                if probe.first is None:
                    _look_at(image, probe)
        except MalformedMessageError as error:
            probe.complaint = str(error)
            continue
        probe.time_ns.append(stamp_ns)
        probe.received_ns.append(received_ns)
        probe.frame = frame
    return probes


def _look_at(image: ImageMessage, probe: _Probe) -> None:
    if image.needs_opencv:
        require("cv2", "to decode compressed images and Bayer mosaics", RecordingError)
    try:
        pixels = image.pixels()
    except MalformedImageError as error:
        probe.complaint = str(error)
        return
    probe.first, probe.size = image, (int(pixels.shape[1]), int(pixels.shape[0]))


def _check_image(channel: Channel, probe: _Probe) -> None:
    if probe.first is None:
        raise RecordingError(
            f"images on {channel.topic}",
            f"none that can be read in the first seconds{f' ({probe.complaint})' if probe.complaint else ''}",
            "choose other topics with image_topics, or convert the recording",
        )
    if len(probe.time_ns) >= 3 and min(probe.time_ns) == max(probe.time_ns):
        raise RecordingError(
            f"stamps on {channel.topic} that go on from message to message",
            f"the same stamp {probe.time_ns[0] * 1e-9:.3f} s on the first {len(probe.time_ns)} messages",
            "let the driver fill in header.stamp; the times of reception are too rough to replace it",
        )


def _depth_unit(probe: _Probe, options: CameraRecordingOptions) -> tuple[float | None, str]:
    if probe.first is None or not probe.first.is_depth:
        return None, ""
    encoding = probe.first.encoding.split(";")[0].strip()
    if options.depth_unit_m is not None and encoding == "16UC1":
        return options.depth_unit_m, "the option depth_unit_m"
    return DEPTH_ENCODINGS[encoding], f"the encoding {encoding} (REP 118)"


def _imu_stream(
    channel: Channel, probe: _Probe, given: StatedRig, source: str, options: CameraRecordingOptions
) -> tuple[ImuStream, list[Evidence]]:
    if not probe.time_ns:
        raise RecordingError(
            f"IMU messages on {channel.topic}", "none that can be read in the first seconds", "choose another imu_topic"
        )
    stated = RecordingOptions(gyro_unit=options.gyro_unit, accel_unit=options.accel_unit)
    values = np.array(probe.values)
    accel_unit, accel_evidence = read_accel_unit(values[:, 3:], stated)
    gyro_unit, gyro_evidence = read_gyro_unit(values[:, :3], stated)
    noise = Evidence("imu_noise", "unknown", "warning", "the recording does not say: an estimator must be told")
    if given.noise is not None:
        noise = Evidence("imu_noise", "known", "ok", f"from {source}")
    rate = rate_hz(probe.time_ns)
    noise_source = source if given.noise is not None else ""
    stream = ImuStream(channel.topic, probe.frame, channel.count, rate, gyro_unit, accel_unit, given.noise, noise_source)
    return stream, [gyro_evidence, accel_evidence, noise]


def _clocks(topic: str, seconds: float) -> Evidence:
    text = f"images on {topic} arrive {seconds:+.3f} s after their stamps, compared with IMU messages"
    if abs(seconds) < _SAME_CLOCK_S:
        return Evidence("clocks", "one", "ok", text)
    advice = (
        "camera and IMU are stamped by different clocks: synchronise them (a hardware trigger, PTP, or the driver's host time)"
    )
    return Evidence("clocks", "differ", "error", f"{text}: {advice}")
