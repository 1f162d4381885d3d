"""Simulations as files: ROS 2 folders (MCAP) and ROS 1 bags, with the ground truth beside them.

Clouds have the layout of the Velodyne driver (x, y, z, intensity, ring, time [s] from the stamp of the message, which is that of
the first point). A message is stored at the time it would have arrived: a scan when it is complete. A fault of the stamps does
not change when messages arrive.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.output import atomic_file, make_folder, output_error
from boxplus.formats.trajectory_rows import tum_row
from boxplus.manifolds import quaternion
from boxplus.sensors.imu import ImuSamples
from boxplus.sensors.scan import Scan
from boxplus.simulation.faults import Fault
from boxplus.simulation.live_recording import IMU_FRAME, IMU_TOPIC, LIDAR_FRAME, LIDAR_TOPIC, as_recording
from boxplus.simulation.simulation import Simulation

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Format = Literal["ros2", "ros1"]

POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
        "offsets": [0, 4, 8, 12, 16, 18],
        "itemsize": 22,
    }
)
_ROS_TYPE = {"<f4": 7, "<u2": 4}
_CLOUD, _IMU, _TRANSFORMS = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Imu", "tf2_msgs/msg/TFMessage"
_IMU_DELAY_NS, _SCAN_DELAY_NS = 500_000, 3_000_000
_GROUND_TRUTH_NS = 10_000_000


def write_recording(
    simulation: Simulation,
    path: str | Path,
    format: Format = "ros2",
    fault: Fault | None = None,
    progress: Callable[[float], None] | None = None,
) -> Path:
    """Write a simulation to disk, scan by scan.

    Beside the recording `NAME` come `NAME.gt.tum` (pose of the IMU, 100 Hz, whatever the fault) and `NAME.json` (the parameters).

    Args:
        simulation: what to write.
        path: `ros2`: the folder to create; `ros1`: the file to create, its ending is set to `.bag`.
        format: `ros2` for a ROS 2 folder with MCAP storage, `ros1` for a ROS 1 bag.
        fault: what goes wrong.
        progress: called with the share of the recording that is written, 0 to 1.

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
        with _Bag(target, format) as bag:
            _write_messages(bag, simulation, fault, progress)
    except OSError as error:
        raise output_error(target, error) from error
    with atomic_file(f"{stem}.gt.tum") as file:
        for rows in _ground_truth(simulation):
            file.write(rows.encode())
    with atomic_file(f"{stem}.json") as file:
        file.write(simulation.config.model_dump_json(indent=2).encode())
    return target


class _Bag(AbstractContextManager["_Bag"]):
    """The two writers of rosbags behind one face."""

    def __init__(self, path: Path, format: Format) -> None:
        from rosbags.rosbag1 import Writer as Ros1Writer
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Ros2Writer
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._ros1 = format == "ros1"
        self.typestore: Typestore = get_typestore(Stores.ROS1_NOETIC if self._ros1 else Stores.ROS2_HUMBLE)
        if _TRANSFORMS not in self.typestore.types:
            definition = "geometry_msgs/TransformStamped[] transforms"
            self.typestore.register(get_types_from_msg(definition, _TRANSFORMS))
        self._writer: Any = Ros1Writer(path) if self._ros1 else Ros2Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._connections: dict[str, Any] = {}
        self._arrived_ns = 0

    def __enter__(self) -> _Bag:
        self._writer.open()
        for topic, kind in (("/tf_static", _TRANSFORMS), (IMU_TOPIC, _IMU), (LIDAR_TOPIC, _CLOUD)):
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self.typestore)
        return self

    def __exit__(self, *error: Any) -> None:
        self._writer.__exit__(*error)

    def message(self, kind: str, **fields: Any) -> Any:
        return self.typestore.types[kind](**fields)

    def header(self, stamp_ns: int, frame: str) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        stamp = self.message("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        extra = {"seq": 0} if self._ros1 else {}
        return self.message("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **extra)

    def write(self, topic: str, arrived_ns: int, message: Any) -> None:
        """Messages are stored in the order in which they come, whatever their stamps say."""
        self._arrived_ns = max(self._arrived_ns, arrived_ns)
        serialize = self.typestore.serialize_ros1 if self._ros1 else self.typestore.serialize_cdr
        self._writer.write(self._connections[topic], self._arrived_ns, serialize(message, message.__msgtype__))


def _write_messages(bag: _Bag, simulation: Simulation, fault: Fault | None, progress: Callable[[float], None] | None) -> None:
    T_imu_lidar = as_recording(simulation, fault).info.T_imu_lidar
    measured = _Measured(simulation)
    events = measured.events() if fault is None else fault.events(measured.events())
    if T_imu_lidar is not None:
        bag.write("/tf_static", simulation.start_ns, _transforms(bag, simulation.start_ns, T_imu_lidar))
    vector = "geometry_msgs/msg/Vector3"
    unknown, nowhere = np.zeros(9), bag.message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    no_orientation = np.array([-1.0, *np.zeros(8)])  # sensor_msgs/Imu: the first element −1 means there is no estimate
    for event in events:
        if isinstance(event, Scan):
            cloud = _cloud(bag, event, simulation.scenario.lidar.ring(event.p_lidar))
            bag.write(LIDAR_TOPIC, measured.at_ns + _SCAN_DELAY_NS, cloud)
            if progress is not None:
                progress(measured.scans / simulation.scan_count)
            continue
        columns = (event.time_ns, event.gyro, event.accel, measured.sample_times(event))
        for time_ns, gyro, accel, at_ns in zip(*(column.tolist() for column in columns), strict=True):
            sample = bag.message(
                _IMU,
                header=bag.header(time_ns, IMU_FRAME),
                orientation=nowhere,
                orientation_covariance=no_orientation,
                angular_velocity=bag.message(vector, x=gyro[0], y=gyro[1], z=gyro[2]),
                angular_velocity_covariance=unknown,
                linear_acceleration=bag.message(vector, x=accel[0], y=accel[1], z=accel[2]),
                linear_acceleration_covariance=unknown,
            )
            bag.write(IMU_TOPIC, at_ns + _IMU_DELAY_NS, sample)


class _Measured:
    """The events of a simulation, and when the one that a fault has just turned into another was measured.

    Attributes:
        at_ns: end of the last event [ns].
        scans: scans so far.
    """

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._sample_ns = np.empty(0, np.int64)
        self.at_ns = simulation.start_ns
        self.scans = 0

    def events(self) -> Iterator[Scan | ImuSamples]:
        for event in self._simulation.events():
            if isinstance(event, Scan):
                self.at_ns, self.scans = event.end_ns, self.scans + 1
            else:
                self.at_ns, self._sample_ns = int(event.time_ns[-1]), event.time_ns
            yield event

    def sample_times(self, samples: ImuSamples) -> NDArray[np.int64]:
        """When each of the samples was measured; by their stamps where some of the block are missing."""
        return self._sample_ns if len(self._sample_ns) == len(samples) else samples.time_ns


def _cloud(bag: _Bag, scan: Scan, ring: NDArray[np.uint16]) -> Any:
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
        header=bag.header(scan.start_ns, LIDAR_FRAME),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=POINT.itemsize,
        row_step=POINT.itemsize * len(points),
        data=points.view(np.uint8),
        is_dense=not lost,
    )


def _transforms(bag: _Bag, stamp_ns: int, T_imu_lidar: NDArray[np.float64]) -> Any:
    w, x, y, z = quaternion.from_matrix(T_imu_lidar[:3, :3]).tolist()
    px, py, pz = T_imu_lidar[:3, 3].tolist()
    transform = bag.message(
        "geometry_msgs/msg/TransformStamped",
        header=bag.header(stamp_ns, IMU_FRAME),
        child_frame_id=LIDAR_FRAME,
        transform=bag.message(
            "geometry_msgs/msg/Transform",
            translation=bag.message("geometry_msgs/msg/Vector3", x=px, y=py, z=pz),
            rotation=bag.message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        ),
    )
    return bag.message(_TRANSFORMS, transforms=[transform])


def _ground_truth(simulation: Simulation) -> Iterator[str]:
    """Lines of the TUM file, a block at a time."""
    times = np.arange(simulation.start_ns, simulation.end_ns + 1, _GROUND_TRUTH_NS)
    for begin in range(0, len(times), 1000):
        block = times[begin : begin + 1000]
        motion = simulation.ground_truth(block)
        q_wxyz = quaternion.from_matrix(motion.R_world_imu)
        yield "".join(map(tum_row, block.tolist(), motion.p_world_imu, q_wxyz))
