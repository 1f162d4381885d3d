"""Small recordings for the tests, written with rosbags: one LiDAR layout, an IMU, optionally static transforms."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

Container = Literal["ros1", "mcap", "sqlite3"]
LAYOUTS = ("velodyne", "ouster", "hesai", "robosense", "generic", "livox_ros_driver", "livox_ros_driver2")
CONTAINERS: tuple[Container, ...] = ("ros1", "mcap", "sqlite3")

START_NS = 1_700_000_000_123_456_789
PERIOD_NS = 100_000_000
_DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
_LIVOX_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
_LIVOX_MESSAGE = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\nCustomPoint[] points\n"
)

POINT_TYPES = {
    "velodyne": np.dtype(
        {
            "names": ["x", "y", "z", "intensity", "ring", "time"],
            "formats": ["<f4"] * 4 + ["<u2", "<f4"],
            "offsets": [0, 4, 8, 12, 16, 18],
        }
    ),
    "ouster": np.dtype(
        {
            "names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"],
            "formats": ["<f4"] * 4 + ["<u4", "<u2", "<u2", "<u2", "<u4"],
            "offsets": [0, 4, 8, 16, 20, 24, 26, 28, 32],
            "itemsize": 48,
        }
    ),
    "hesai": np.dtype(
        {
            "names": ["x", "y", "z", "intensity", "timestamp", "ring"],
            "formats": ["<f4"] * 4 + ["<f8", "<u2"],
            "offsets": [0, 4, 8, 16, 24, 32],
            "itemsize": 48,
        }
    ),
    "robosense": np.dtype(
        {
            "names": ["x", "y", "z", "intensity", "ring", "timestamp"],
            "formats": ["<f4"] * 4 + ["<u2", "<f8"],
            "offsets": [0, 4, 8, 12, 16, 18],
        }
    ),
    "generic": np.dtype({"names": ["x", "y", "z", "time_offset"], "formats": [">f8"] * 3 + [">i4"], "itemsize": 40}),
}


@dataclass
class Content:
    """What a test recording holds.

    `times_ns` of a scan are absolute; `p_lidar` are not near the sensor.
    """

    layout: str = "velodyne"
    scans: int = 6
    points: int = 40
    imu_rate: int = 100
    frames: dict[str, tuple[str, ...]] = field(default_factory=dict)  # of the messages on a topic, in turn
    imu_burst: int = 1  # messages that arrive together, with the last of them
    accel: tuple[float, float, float] = (0.0, 0.0, 9.81)
    gyro: tuple[float, float, float] = (0.001, 0.0, 0.0)
    lidar_delay_ns: int = 102_000_000
    transforms: list[tuple[str, str, NDArray[np.float64]]] = field(default_factory=list)
    extra_topics: dict[str, str] = field(default_factory=dict)
    drop_fields: tuple[str, ...] = ()
    with_imu: bool = True
    static_time: bool = False
    fixes: list[tuple[int, tuple[float, float, float], int]] = field(default_factory=list)  # offset [ns], place, status
    fix_topics: tuple[str, ...] = ("/fix",)
    fix_covariance_type: int = 2

    def p_lidar(self, index: int) -> NDArray[np.float32]:
        rng = np.random.default_rng(index)
        directions = rng.normal(size=(self.points, 3))
        return (directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(2, 20, (self.points, 1))).astype(
            np.float32
        )

    def times_ns(self, index: int) -> NDArray[np.int64]:
        offsets = np.zeros(self.points) if self.static_time else np.linspace(0.0, 0.99, self.points)
        return self.stamp_ns(index) + np.rint(offsets * PERIOD_NS / 1000).astype(np.int64) * 1000

    def stamp_ns(self, index: int) -> int:
        return START_NS + index * PERIOD_NS

    def frame(self, topic: str, index: int) -> str:
        """The frame of the message of this index; a topic's own name where nothing else is said."""
        frames = self.frames.get(topic, ({"/imu": "imu"}.get(topic, "lidar"),))
        return frames[index % len(frames)]

    def written_stamp_ns(self, index: int) -> int:
        """The stamp in the message of a scan."""
        return self.stamp_ns(index)

    def imu(self, stamp_ns: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Angular velocity and acceleration as recorded at this time."""
        return self.gyro, self.accel

    def keeps(self, topic: str, index: int) -> bool:
        """Whether the message of this index is recorded."""
        return True


class _Bag:
    """The few things both writers do, and the types they need."""

    def __init__(self, path: Path, container: Container) -> None:
        self.ros1 = container == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        for package in ("livox_ros_driver", "livox_ros_driver2"):
            self.store.register(get_types_from_msg(_LIVOX_POINT, f"{package}/msg/CustomPoint"))
            self.store.register(get_types_from_msg(_LIVOX_MESSAGE, f"{package}/msg/CustomMsg"))
        self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage"))
        self.writer: Any = Ros1Writer(path) if self.ros1 else _ros2_writer(path, container)
        self.connections: dict[str, Any] = {}
        if self.ros1:
            self.writer.chunk_threshold = 8_000  # several chunks even in a small bag

    def header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self.store.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        kind = self.store.types["std_msgs/msg/Header"]
        return kind(seq=0, stamp=stamp, frame_id=frame) if self.ros1 else kind(stamp=stamp, frame_id=frame)

    def write(self, topic: str, message: Any, received_ns: int) -> None:
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        data = self.store.serialize_ros1(message, kind) if self.ros1 else self.store.serialize_cdr(message, kind)
        self.writer.write(self.connections[topic], received_ns, data)


def _ros2_writer(path: Path, container: Container) -> Any:
    return Ros2Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3 if container == "sqlite3" else StoragePlugin.MCAP)


def write_bag(folder: Path, container: Container, content: Content | None = None) -> Path:
    """Write a recording into a new folder or file under `folder` and return its path."""
    content = content or Content()
    path = folder / ("recording.bag" if container == "ros1" else "recording")
    bag = _Bag(path, container)
    events: list[tuple[int, str, Any]] = []
    for index in (k for k in range(content.scans) if content.keeps("/points", k)):
        stamp_ns = content.stamp_ns(index)
        events.append((stamp_ns + content.lidar_delay_ns, "/points", cloud_message(bag, content, index)))
        for name, kind in content.extra_topics.items():
            other = Content(layout=kind, points=content.points)
            events.append((stamp_ns + content.lidar_delay_ns, name, cloud_message(bag, other, index)))
    if content.with_imu:
        count = (content.scans * PERIOD_NS * content.imu_rate) // 10**9 + 1
        for index in (k for k in range(count) if content.keeps("/imu", k)):
            stamp_ns = START_NS + index * 10**9 // content.imu_rate
            last = START_NS + (index // content.imu_burst + 1) * content.imu_burst * 10**9 // content.imu_rate
            received_ns = stamp_ns if content.imu_burst == 1 else last
            events.append((received_ns, "/imu", _imu_message(bag, content, stamp_ns, content.frame("/imu", index))))
    for offset_ns, place, status in content.fixes:
        for topic in content.fix_topics:
            stamp_ns = START_NS + offset_ns
            events.append((stamp_ns, topic, _fix_message(bag, stamp_ns, place, status, content.fix_covariance_type)))
    if content.transforms:
        events.append((START_NS, "/tf_static", _transform_message(bag, content)))
    with bag.writer:
        for received_ns, topic, message in sorted(events, key=lambda event: event[0]):
            bag.write(topic, message, received_ns)
    return path


def cloud_message(bag: _Bag, content: Content, index: int) -> Any:
    types = bag.store.types
    header = bag.header(content.written_stamp_ns(index), content.frame("/points", index))
    p_lidar, times_ns = content.p_lidar(index), content.times_ns(index)
    relative = times_ns - content.stamp_ns(index)
    if content.layout.startswith("livox"):
        point = types[f"{content.layout}/msg/CustomPoint"]
        points = [
            point(offset_time=int(t), x=float(x), y=float(y), z=float(z), reflectivity=7, tag=0, line=0)
            for (x, y, z), t in zip(p_lidar, relative, strict=True)
        ]
        kind = types[f"{content.layout}/msg/CustomMsg"]
        return kind(header=header, timebase=5, point_num=len(points), lidar_id=0, rsvd=np.zeros(3, np.uint8), points=points)
    dtype = POINT_TYPES[content.layout]
    cloud = np.zeros(len(p_lidar), dtype)
    for axis, name in enumerate("xyz"):
        cloud[name] = p_lidar[:, axis]
    if "intensity" in (dtype.names or ()):
        cloud["intensity"] = np.arange(len(cloud))
    if content.layout == "velodyne":
        cloud["time"] = relative * 1e-9
    elif content.layout == "ouster":
        cloud["t"] = relative
    elif content.layout == "generic":
        cloud["time_offset"] = relative // 1000
    else:
        cloud["timestamp"] = times_ns * 1e-9
    fields = [
        types["sensor_msgs/msg/PointField"](
            name=name, offset=dtype.fields[name][1], datatype=_DATATYPES[dtype.fields[name][0].str[1:]], count=1
        )
        for name in dtype.names
        if name not in content.drop_fields
    ]
    data = np.frombuffer(cloud.tobytes(), np.uint8)
    width, height, row_step = len(cloud), 1, len(data)
    if content.layout == "generic":  # two rows with padding behind each
        height, width = 2, len(cloud) // 2
        rows = np.zeros((2, width * dtype.itemsize + 12), np.uint8)
        rows[:, : width * dtype.itemsize] = data.reshape(2, -1)
        data, row_step = rows.reshape(-1), rows.shape[1]
    return types["sensor_msgs/msg/PointCloud2"](
        header=header,
        height=height,
        width=width,
        fields=fields,
        is_bigendian=content.layout == "generic",
        point_step=dtype.itemsize,
        row_step=row_step,
        data=data,
        is_dense=True,
    )


def _imu_message(bag: _Bag, content: Content, stamp_ns: int, frame: str) -> Any:
    types = bag.store.types
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    gyro, accel = content.imu(stamp_ns)
    return types["sensor_msgs/msg/Imu"](
        header=bag.header(stamp_ns, frame),
        orientation=quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.zeros(9),
        angular_velocity=vector(*gyro),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(*accel),
        linear_acceleration_covariance=np.zeros(9),
    )


def _fix_message(bag: _Bag, stamp_ns: int, place: tuple[float, float, float], status: int, kind: int) -> Any:
    types = bag.store.types
    return types["sensor_msgs/msg/NavSatFix"](
        header=bag.header(stamp_ns, "antenna"),
        status=types["sensor_msgs/msg/NavSatStatus"](status=status, service=1),
        latitude=place[0],
        longitude=place[1],
        altitude=place[2],
        position_covariance=np.array([1.0, 0.1, 0.0, 0.1, 2.0, 0.0, 0.0, 0.0, 9.0]),
        position_covariance_type=kind,
    )


def _transform_message(bag: _Bag, content: Content) -> Any:
    types = bag.store.types
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    stamped = [
        types["geometry_msgs/msg/TransformStamped"](
            header=bag.header(START_NS, parent),
            child_frame_id=child,
            transform=types["geometry_msgs/msg/Transform"](
                translation=vector(*map(float, values[:3])), rotation=quaternion(*map(float, values[3:]))
            ),
        )
        for parent, child, values in content.transforms
    ]
    return types["tf2_msgs/msg/TFMessage"](transforms=stamped)
