"""A simulation in the place of an opened recording: same interface, no file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from boxplus.manifolds import quaternion
from boxplus.recordings.info import Evidence, PointTimeReading, RecordingInfo, Topic
from boxplus.recordings.recording import Event, Recording, Tally
from boxplus.sensors.geodesy import EnuFrame
from boxplus.sensors.gnss import GnssFixes
from boxplus.sensors.scan import Scan
from boxplus.simulation.faults import Fault
from boxplus.simulation.gnss import GnssConfig, simulate_gnss
from boxplus.simulation.simulation import Simulation

LIDAR_TOPIC, IMU_TOPIC, GNSS_TOPIC = "/lidar/points", "/imu/data", "/gnss/fix"
GNSS_ORIGIN = EnuFrame(49.0, 8.4, 115.0)
_GNSS_STEP_NS = 50_000_000
LIDAR_FRAME, IMU_FRAME = "lidar", "imu"


def as_recording(simulation: Simulation, fault: Fault | None = None, gnss: GnssConfig | None = None) -> Recording:
    """The simulation as a `Recording`; what a fault spoils arrives spoilt, units and mounting as (wrongly) declared.

    With `gnss` a receiver takes part, whose lever arm is known; the world lies at `GNSS_ORIGIN` then, x east and y north.
    """
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

    if gnss is None:
        return Recording(info, read, lambda: None)
    info.gnss_topic, info.p_imu_antenna = GNSS_TOPIC, np.array(gnss.lever)
    return Recording(info, read, lambda: None, lambda: fixes_of(simulation, gnss))


def fixes_of(simulation: Simulation, gnss: GnssConfig) -> GnssFixes:
    """The fixes of a receiver along a simulation, which the seed of the simulation decides."""
    times = np.arange(simulation.start_ns, simulation.end_ns + 1, _GNSS_STEP_NS)
    motion = simulation.scenario.trajectory.evaluate(times)
    poses = np.hstack([quaternion.from_matrix(motion.R_world_imu), motion.p_world_imu])
    return simulate_gnss(times, poses, GNSS_ORIGIN, gnss, simulation.config.seed)
