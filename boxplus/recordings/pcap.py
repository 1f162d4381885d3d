"""Captures of a LiDAR's network packets, through the vendors' decoders (extra `sensors`, and ouster-sdk).

Ouster: the capture and the sensor's metadata (.json) beside it; LiDAR and IMU share the sensor's clock, and the metadata gives
the extrinsic. Velodyne: the capture alone; it holds no IMU.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus._extras import require
from boxplus.errors import RecordingError
from boxplus.recordings.bags.container import READ_ERRORS
from boxplus.recordings.info import Evidence, PointTimeReading, RecordingInfo, Topic, no_imu
from boxplus.recordings.options import NO_IMU, RecordingOptions, check_start
from boxplus.recordings.recording import Event, Recording, Tally
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan

_LOG = logging.getLogger(__name__)

_IN_THE_SENSOR = PointTimeReading("timestamp", "ns", "absolute", "clock")


def open_pcap(path: Path, options: RecordingOptions) -> Recording:
    """Open a capture: Ouster when a metadata .json lies beside it, else Velodyne.

    Raises:
        RecordingError: the decoder is not installed, or the capture cannot be decoded.
    """
    metadata = _ouster_metadata(path)
    return _open_ouster(path, metadata, options) if metadata is not None else _open_velodyne(path, options)


def _ouster_metadata(path: Path) -> Path | None:
    """The .json whose name begins like the capture's; the longest such name."""
    fitting = [file for file in path.parent.glob("*.json") if path.stem.startswith(file.stem)]
    return max(fitting, key=lambda file: len(file.stem), default=None)


def _decoder(module: str) -> Any:
    return require(module, "which decodes this capture", RecordingError)


def _interval(first_ns: int, options: RecordingOptions) -> tuple[int, int]:
    start_ns = first_ns + round(options.start_s * 1e9)
    return start_ns, 2**63 - 1 if options.duration_s is None else start_ns + round(options.duration_s * 1e9)


def _recording(
    info: RecordingInfo,
    events: Callable[[Tally], Iterator[tuple[int, Event]]],
    first_ns: int,
    options: RecordingOptions,
    errors: tuple[type[Exception], ...] = READ_ERRORS,
) -> Recording:
    """A recording over (reception time, event) pairs, cut to the wanted interval; a capture that breaks off ends there."""
    start_ns, stop_ns = _interval(first_ns, options)

    def read(tally: Tally) -> Iterator[Event]:
        try:
            for received_ns, event in events(tally):
                if received_ns >= stop_ns:
                    return
                if received_ns >= start_ns:
                    yield event
        except errors as error:
            tally.damage.append(f"decoding stopped: {str(error) or type(error).__name__}")

    return Recording(info, read, lambda: None)


# --- Ouster ---


def _ouster_errors() -> tuple[type[Exception], ...]:
    """What ouster-sdk raises on metadata that it cannot use, which derives from no built-in class."""
    import importlib

    try:
        found: type[Exception] = importlib.import_module("ouster.sdk.open_source").SourceURLException
    except (ImportError, AttributeError):  # other versions raise the built-in ones
        return ()
    return (found,)


def _open_ouster(path: Path, metadata: Path, options: RecordingOptions) -> Recording:
    core = _decoder("ouster.sdk.core")
    sdk = _decoder("ouster.sdk")

    def packets() -> Iterator[Any]:
        for _, packet in sdk.open_packet_source(str(path), meta=[str(metadata)]):
            yield packet

    try:
        sensor = sdk.open_packet_source(str(path), meta=[str(metadata)]).sensor_info[0]
        counts = {"lidar": 0, "imu": 0}
        first_ns, last_ns = 0, 0
        for packet in packets():
            kind = "imu" if isinstance(packet, core.ImuPacket) else "lidar"
            counts[kind] += 1
            first_ns = first_ns or int(packet.host_timestamp)
            last_ns = int(packet.host_timestamp)
    except READ_ERRORS + _ouster_errors() as error:
        reason = " ".join(str(error).split())
        raise RecordingError(
            "an Ouster capture with its metadata",
            f"{path.name}: {reason}",
            f"check that {metadata.name} is whole and belongs to it",
        ) from error
    check_start(options.start_s, (last_ns - first_ns) * 1e-9)
    T_sensor_imu = np.array(sensor.imu_to_sensor_transform, dtype=np.float64)
    T_imu_lidar = np.eye(4)
    T_imu_lidar[:3, :3] = T_sensor_imu[:3, :3].T
    T_imu_lidar[:3, 3] = -T_sensor_imu[:3, :3].T @ T_sensor_imu[:3, 3] * 1e-3
    source = f"metadata {metadata.name}"
    evidence = [
        Evidence("point_time_reference", "absolute", "ok", "times of the columns in the sensor's clock, shared with its IMU"),
        Evidence("T_imu_lidar", source, "ok", "points are in the sensor's frame; imu_to_sensor_transform gives the IMU in it"),
    ]
    with_imu = counts["imu"] > 0 and options.imu_topic != NO_IMU
    if not with_imu:
        evidence.append(no_imu(options.imu_topic == NO_IMU))
    info = RecordingInfo(
        path=path,
        format=f"Ouster pcap ({sensor.prod_line})",
        topics=[Topic("lidar packets", "Ouster", counts["lidar"]), Topic("imu packets", "Ouster", counts["imu"])],
        duration_s=(last_ns - first_ns) * 1e-9,
        message_count=sum(counts.values()),
        lidar_topic="lidar packets",
        imu_topic="imu packets" if with_imu else "",
        lidar_frame="os_sensor",
        imu_frame="os_imu",
        point_time=_IN_THE_SENSOR,
        gyro_unit="rad/s",
        accel_unit="m/s2",
        T_imu_lidar=T_imu_lidar,
        T_imu_lidar_source=source,
        evidence=evidence,
    )

    def events(tally: Tally) -> Iterator[tuple[int, Event]]:
        batcher, frame = core.FrameBatcher(sensor), core.LidarFrame(sensor)
        table = core.XYZLut(sensor, use_extrinsics=False)
        received_ns = 0
        for packet in packets():
            tally.done += 1
            received_ns = int(packet.host_timestamp)
            if isinstance(packet, core.ImuPacket):
                if with_imu:
                    yield received_ns, _ouster_imu(packet)
            elif batcher.batch(packet, frame):
                yield received_ns, _ouster_scan(frame, table, options)
                frame = core.LidarFrame(sensor)

    return _recording(info, events, first_ns, options)


def _ouster_imu(packet: Any) -> ImuSamples:
    gyro = np.asarray(packet.gyro(), dtype=np.float64).reshape(-1, 3)
    accel = np.asarray(packet.accel(), dtype=np.float64).reshape(-1, 3)
    return ImuSamples.from_arrays(np.atleast_1d(np.asarray(packet.timestamp())).astype(np.int64), gyro, accel)


def _ouster_scan(frame: Any, table: Any, options: RecordingOptions) -> Scan:
    """A frame's valid columns; columns that never arrived have status 0 and no time."""
    valid = (np.asarray(frame.status) & 1).astype(bool)
    points = np.asarray(table(frame), dtype=np.float32)[:, valid].reshape(-1, 3)
    time_ns = np.broadcast_to(np.asarray(frame.timestamp)[valid].astype(np.int64), (frame.h, int(valid.sum()))).reshape(-1)
    strength = next((name for name in ("SIGNAL", "REFLECTIVITY") if name in frame.fields), None)
    intensity = None if strength is None else np.asarray(frame.field(strength), dtype=np.float32)[:, valid].reshape(-1)
    return Scan.from_arrays(points, time_ns, intensity, min_range=options.min_range, max_range=options.max_range)


# --- Velodyne ---


def _open_velodyne(path: Path, options: RecordingOptions) -> Recording:
    decoder = _decoder("velodyne_decoder")
    errors = (*READ_ERRORS, _decoder("dpkt").dpkt.Error)
    stamps: list[float] = []
    packets = 0
    try:
        for stamp, data in decoder.util.iter_pcap(path):
            if len(data) == decoder.PACKET_SIZE:
                packets += 1
                stamps = [stamps[0] if stamps else stamp, stamp]
    except errors as error:
        if not packets:
            raise RecordingError(
                "a capture of network packets", f"{path.name}: {error}", "capture with tcpdump or the vendor's tool"
            ) from error
        _LOG.warning("%s breaks off: %s", path.name, error)
    if not packets:
        raise RecordingError(
            "an Ouster capture with its metadata .json beside it, or Velodyne packets of 1206 bytes",
            f"neither with {path.name}",
            "put the sensor's metadata beside an Ouster capture, under a name the capture's begins with; convert others to a bag",
        )
    check_start(options.start_s, stamps[1] - stamps[0])
    evidence = [
        no_imu(options.imu_topic == NO_IMU),
        Evidence(
            "point_time_reference", "scan_start", "ok", "firing times of the packets, from the reception of the first of a scan"
        ),
    ]
    info = RecordingInfo(
        path=path,
        format="Velodyne pcap",
        topics=[Topic("data packets", "Velodyne", packets)],
        duration_s=stamps[1] - stamps[0],
        message_count=packets,
        lidar_topic="data packets",
        imu_topic="",
        lidar_frame="velodyne",
        imu_frame="",
        point_time=PointTimeReading("time", "s", "scan_start", "stamp"),
        gyro_unit="rad/s",
        accel_unit="m/s2",
        evidence=evidence,
    )

    def events(tally: Tally) -> Iterator[tuple[int, Event]]:
        stream = decoder.StreamDecoder(decoder.Config(model=_velodyne_model(decoder, path), timestamp_first_packet=True))
        for stamp, data in decoder.util.iter_pcap(path):
            if len(data) != decoder.PACKET_SIZE:
                continue
            tally.done += 1
            result = stream.decode(stamp, data, False)
            if result is not None:
                yield _velodyne_scan(result, options)
        result = stream.finish(False)
        if result is not None:
            yield _velodyne_scan(result, options)

    return _recording(info, events, round(stamps[0] * 1e9), options, errors)


def _velodyne_model(decoder: Any, path: Path) -> Any:
    """HDL-64E captures carry their model and calibration across packets; the others name their model in each."""
    model, _ = decoder.hdl64e.detect_hdl64e(str(path))
    return model


def _velodyne_scan(result: Any, options: RecordingOptions) -> tuple[int, Scan]:
    stamp, points = result
    points = np.asarray(points)
    host = stamp.host if hasattr(stamp, "host") else stamp
    stamp_ns = round(float(host) * 1e9)
    offset: NDArray[np.float64] = points[:, 4].astype(np.float64)
    time_ns = stamp_ns + np.rint(offset * 1e9).astype(np.int64)
    scan = Scan.from_arrays(points[:, :3], time_ns, points[:, 3], min_range=options.min_range, max_range=options.max_range)
    return scan.end_ns, scan
