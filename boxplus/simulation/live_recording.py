"""A simulation in the place of an opened recording: same interface, no file."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.manifolds import quaternion
from boxplus.recordings.info import Evidence, OtherLidarInfo, PointTimeReading, RecordingInfo, Topic
from boxplus.recordings.other_lidars import LidarEvent, merged_events
from boxplus.recordings.recording import Event, Recording, Tally
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.satellites.geodesy import EnuFrame
from boxplus.sensors.satellites.gnss import GnssFixes
from boxplus.simulation.faults import Fault
from boxplus.simulation.gnss import GnssConfig, simulate_gnss
from boxplus.simulation.several_lidars import Measured, MountedLidar, other_events
from boxplus.simulation.simulation import Simulation

LIDAR_TOPIC, IMU_TOPIC, GNSS_TOPIC = "/lidar/points", "/imu/data", "/gnss/fix"
GNSS_ORIGIN = EnuFrame(49.0, 8.4, 115.0)
_GNSS_STEP_NS = 50_000_000
LIDAR_FRAME, IMU_FRAME = "lidar", "imu"


def as_recording(
    simulation: Simulation,
    fault: Fault | None = None,
    gnss: GnssConfig | None = None,
    others: tuple[MountedLidar, ...] = (),
) -> Recording:
    """The simulation as a `Recording`; what a fault spoils arrives spoilt, units and mounting as (wrongly) declared.

    Args:
        simulation: of the first LiDAR and the IMU.
        fault: what goes wrong with these.
        gnss: a receiver that takes part, whose lever arm is known; the world lies at `GNSS_ORIGIN` then, x east and y north.
        others: LiDARs to merge with the first one.

    Raises:
        InputError: other LiDARs, where a fault leaves the mounting of one undeclared.
    """
    config = simulation.config
    imu_count = round((simulation.end_ns - simulation.start_ns) * 1e-9 * config.imu.rate_hz) + 1
    T_imu_lidar = simulation.T_imu_lidar if fault is None else fault.declared_extrinsic(simulation.T_imu_lidar)
    text = f"seed {config.seed}" if fault is None else f"seed {config.seed}, {fault.description}"
    reading = PointTimeReading("time", "ns", "absolute", "clock")
    merged = [_declared(mounted, T_imu_lidar, simulation, reading) for mounted in others]
    info = RecordingInfo(
        path=Path(f"{config.scenario} (simulated)"),
        format="simulation",
        topics=[
            Topic(LIDAR_TOPIC, "simulated LiDAR", simulation.scan_count),
            *(Topic(other.topic, "simulated LiDAR", other.messages) for other in merged),
            Topic(IMU_TOPIC, "simulated IMU", imu_count),
        ],
        duration_s=(simulation.end_ns - simulation.start_ns) * 1e-9,
        message_count=simulation.scan_count + imu_count + sum(other.messages for other in merged),
        lidar_topic=LIDAR_TOPIC,
        imu_topic=IMU_TOPIC,
        lidar_frame=LIDAR_FRAME,
        imu_frame=IMU_FRAME,
        point_time=reading,
        gyro_unit="rad/s",
        accel_unit="m/s2",
        T_imu_lidar=T_imu_lidar,
        T_imu_lidar_source="" if T_imu_lidar is None else "the simulation",
        evidence=[Evidence("scenario", config.scenario, "ok", text)],
        other_lidars=merged,
    )

    def events(tally: Tally) -> Iterator[LidarEvent]:
        for measured in measured_events(simulation, fault, others):
            event = measured.event
            tally.done += 1 if isinstance(event, Scan) else len(event)
            yield (measured.lidar, event) if isinstance(event, Scan) else event

    def read(tally: Tally) -> Iterator[Event]:
        if info.other_lidars:
            return merged_events(events(tally), info, tally)
        return (event[1] if isinstance(event, tuple) else event for event in events(tally))

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


def measured_events(
    simulation: Simulation, fault: Fault | None = None, others: tuple[MountedLidar, ...] = ()
) -> Iterator[Measured]:
    """The events of all sensors in the order in which they were measured, whatever a fault does to their stamps."""
    return heapq.merge(_first(simulation, fault), *other_events(simulation, others), key=lambda measured: measured.at_ns)


def _first(simulation: Simulation, fault: Fault | None) -> Iterator[Measured]:
    at_ns, sample_ns = simulation.start_ns, np.empty(0, np.int64)

    def events() -> Iterator[Event]:
        nonlocal at_ns, sample_ns
        for event in simulation.events():
            if isinstance(event, Scan):
                at_ns = event.end_ns
            else:
                at_ns, sample_ns = int(event.time_ns[-1]), event.time_ns
            yield event

    for event in events() if fault is None else fault.events(events()):
        yield Measured(at_ns, 0, event, None if isinstance(event, Scan) else sample_ns)


def _declared(
    mounted: MountedLidar, T_imu_lidar: NDArray[np.float64] | None, simulation: Simulation, reading: PointTimeReading
) -> OtherLidarInfo:
    T_other = mounted.T_declared
    if T_imu_lidar is None or T_other is None:
        raise InputError("LiDARs whose mounting is declared", "none", "leave the fault of the mounting out")
    messages = round(simulation.config.duration_s * mounted.lidar.rate_hz)
    relative = np.linalg.inv(T_imu_lidar) @ T_other
    return OtherLidarInfo(mounted.topic, mounted.frame, reading, relative, "the simulation", 0.0, messages)
