"""Simulations as files: ROS 2 folders (MCAP) and ROS 1 bags, with the ground truth beside them.

Clouds have the layout of the Velodyne driver (x, y, z, intensity, ring, time [s] from the stamp of the message, which is that of
the first point). A message is stored at the time it would have arrived: a scan when it is complete. A fault of the stamps does
not change when messages arrive.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.output import atomic_file, make_folder, output_error
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation.bag_writer import (
    FIX_TYPE,
    IMU_DELAY_NS,
    IMU_TYPE,
    TRANSFORMS_TYPE,
    BagFormat,
    BagWriter,
    ground_truth_lines,
)
from boxplus.simulation.faults import Fault
from boxplus.simulation.gnss import GnssConfig
from boxplus.simulation.live_recording import (
    GNSS_TOPIC,
    IMU_FRAME,
    IMU_TOPIC,
    LIDAR_FRAME,
    LIDAR_TOPIC,
    as_recording,
    fixes_of,
    measured_events,
)
from boxplus.simulation.several_lidars import MountedLidar
from boxplus.simulation.simulation import Simulation

POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
        "offsets": [0, 4, 8, 12, 16, 18],
        "itemsize": 22,
    }
)
_ROS_TYPE = {"<f4": 7, "<u2": 4}
_CLOUD = "sensor_msgs/msg/PointCloud2"
_TOPICS = {"/tf_static": TRANSFORMS_TYPE, IMU_TOPIC: IMU_TYPE, LIDAR_TOPIC: _CLOUD}
_SCAN_DELAY_NS = 3_000_000
_ANTENNA_FRAME = "antenna"


def write_recording(
    simulation: Simulation,
    path: str | Path,
    format: BagFormat = "ros2",
    fault: Fault | None = None,
    progress: Callable[[float], None] | None = None,
    gnss: GnssConfig | None = None,
    others: tuple[MountedLidar, ...] = (),
) -> Path:
    """Write a simulation to disk, scan by scan.

    Beside the recording `NAME` come `NAME.gt.tum` (pose of the IMU, 100 Hz, whatever the fault) and `NAME.json` (the parameters).

    Args:
        simulation: what to write.
        path: `ros2`: the folder to create; `ros1`: the file to create, its ending is set to `.bag`.
        format: `ros2` for a ROS 2 folder with MCAP storage, `ros1` for a ROS 1 bag.
        fault: what goes wrong.
        progress: called with the share of the recording that is written, 0 to 1.
        gnss: a receiver that takes part, with its lever arm among the static transforms; see `as_recording`.
        others: LiDARs on board beside the simulation's own; each has a topic and a static transform.

    Returns:
        The path that was written.

    Raises:
        InputError: unknown format, or the path exists.
        OutputError: it cannot be written.
    """
    if format not in ("ros2", "ros1"):
        raise InputError("the format 'ros2' or 'ros1'", repr(format), "choose one of the two")
    target = Path(path)
    if format == "ros1":
        target = target.with_name(f"{target.name.removesuffix('.bag')}.bag")
    if target.exists():
        raise InputError("the path of a new recording", f"one that exists, {target}", "remove it or choose another name")
    make_folder(target.parent)
    stem = target.with_suffix("") if format == "ros1" else target
    try:
        topics = _TOPICS | {mounted.topic: _CLOUD for mounted in others}
        with BagWriter(target, format, topics if gnss is None else topics | {GNSS_TOPIC: FIX_TYPE}) as bag:
            _write_messages(bag, simulation, fault, progress, gnss, others)
    except OSError as error:
        raise output_error(target, error) from error
    with atomic_file(f"{stem}.gt.tum") as file:
        for rows in ground_truth_lines(simulation.scenario.trajectory, simulation.start_ns, simulation.end_ns):
            file.write(rows.encode())
    with atomic_file(f"{stem}.json") as file:
        file.write(simulation.config.model_dump_json(indent=2).encode())
    return target


def _write_messages(
    bag: BagWriter,
    simulation: Simulation,
    fault: Fault | None,
    progress: Callable[[float], None] | None,
    gnss: GnssConfig | None,
    others: tuple[MountedLidar, ...],
) -> None:
    T_imu_lidar = as_recording(simulation, fault).info.T_imu_lidar
    declared = {LIDAR_FRAME: T_imu_lidar} | {mounted.frame: mounted.T_declared for mounted in others}
    children = {frame: T for frame, T in declared.items() if T is not None}
    if children:
        if gnss is not None:
            children[_ANTENNA_FRAME] = np.eye(4)
            children[_ANTENNA_FRAME][:3, 3] = gnss.lever
        bag.write("/tf_static", simulation.start_ns, bag.transforms(simulation.start_ns, IMU_FRAME, children))
    if gnss is not None:  # stored first, as a receiver's file that is merged in would be
        fixes = fixes_of(simulation, gnss)
        for time_ns, place, covariance in zip(fixes.time_ns.tolist(), fixes.lat_lon_alt, fixes.covariance, strict=True):
            bag.write(GNSS_TOPIC, simulation.start_ns, bag.fix(time_ns, _ANTENNA_FRAME, place, covariance))
    models = [(LIDAR_TOPIC, LIDAR_FRAME, simulation.scenario.lidar), *((m.topic, m.frame, m.lidar) for m in others)]
    scans = 0
    for measured in measured_events(simulation, fault, others):
        event, at_ns = measured.event, measured.at_ns
        if isinstance(event, Scan):
            topic, frame, lidar = models[measured.lidar]
            bag.write(topic, at_ns + _SCAN_DELAY_NS, _cloud(bag, event, lidar.ring(event.p_lidar), frame))
            scans += measured.lidar == 0
            if progress is not None:
                progress(scans / simulation.scan_count)
            continue
        columns = (event.time_ns, event.gyro, event.accel, measured.sample_times())
        for time_ns, gyro, accel, sample_ns in zip(*(column.tolist() for column in columns), strict=True):
            bag.write(IMU_TOPIC, sample_ns + IMU_DELAY_NS, bag.imu(time_ns, IMU_FRAME, gyro, accel))


def _cloud(bag: BagWriter, scan: Scan, ring: NDArray[np.uint16], frame: str) -> Any:
    """PointCloud2 of a scan; points a fault turned into NaN, which a `Scan` does not keep, are written as NaN at the end."""
    lost = scan.rejected.get("not finite", 0)
    points = np.zeros(len(scan) + lost, POINT)
    for axis, name in enumerate("xyz"):
        points[name][: len(scan)] = scan.p_lidar[:, axis]
        points[name][len(scan) :] = np.nan
    if scan.intensity is not None:
        points["intensity"][: len(scan)] = scan.intensity
    points["ring"][: len(scan)] = ring
    points["time"][: len(scan)] = (scan.time_ns - scan.start_ns) * 1e-9
    fields = [
        bag.message("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=_ROS_TYPE[kind.str], count=1)
        for name, (kind, offset) in ((name, entry[:2]) for name, entry in (POINT.fields or {}).items())
    ]
    return bag.message(
        _CLOUD,
        header=bag.header(scan.start_ns, frame),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=POINT.itemsize,
        row_step=POINT.itemsize * len(points),
        data=points.view(np.uint8),
        is_dense=not lost,
    )
