"""A simulation in the place of an opened recording: same interface, no file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from boxplus.recordings.info import Evidence, PointTimeReading, RecordingInfo, Topic
from boxplus.recordings.recording import Event, Recording, Tally
from boxplus.sensors.scan import Scan
from boxplus.simulation.faults import Fault
from boxplus.simulation.simulation import Simulation

LIDAR_TOPIC, IMU_TOPIC = "/lidar/points", "/imu/data"
LIDAR_FRAME, IMU_FRAME = "lidar", "imu"


def as_recording(simulation: Simulation, fault: Fault | None = None) -> Recording:
    """The simulation as a `Recording`; what a fault spoils arrives spoilt, units and mounting as (wrongly) declared."""
    config = simulation.config
    imu_count = round((simulation.end_ns - simulation.start_ns) * 1e-9 * config.imu.rate_hz) + 1
    T_imu_lidar = simulation.T_imu_lidar if fault is None else fault.declared_extrinsic(simulation.T_imu_lidar)
    text = f"seed {config.seed}" if fault is None else f"seed {config.seed}, {fault.description}"
    info = RecordingInfo(
        path=Path(f"{config.scenario} (simulated)"),
        format="simulation",
        topics=[Topic(LIDAR_TOPIC, "simulated LiDAR", simulation.scan_count), Topic(IMU_TOPIC, "simulated IMU", imu_count)],
        duration_s=(simulation.end_ns - simulation.start_ns) * 1e-9,
        message_count=simulation.scan_count + imu_count,
        lidar_topic=LIDAR_TOPIC,
        imu_topic=IMU_TOPIC,
        lidar_frame=LIDAR_FRAME,
        imu_frame=IMU_FRAME,
        point_time=PointTimeReading("time", "ns", "absolute", "clock"),
        gyro_unit="rad/s",
        accel_unit="m/s2",
        T_imu_lidar=T_imu_lidar,
        T_imu_lidar_source="" if T_imu_lidar is None else "the simulation",
        evidence=[Evidence("scenario", config.scenario, "ok", text)],
    )

    def read(tally: Tally) -> Iterator[Event]:
        events = simulation.events()
        for event in events if fault is None else fault.events(events):
            tally.done += 1 if isinstance(event, Scan) else len(event)
            yield event

    return Recording(info, read, lambda: None)
