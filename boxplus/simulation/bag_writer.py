"""Messages of simulated sensors into ROS 2 folders (MCAP) and ROS 1 bags."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.trajectory_rows import tum_row
from boxplus.manifolds import quaternion
from boxplus.simulation.motions.spline import Trajectory

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

BagFormat = Literal["ros2", "ros1"]

IMU_TYPE, TRANSFORMS_TYPE = "sensor_msgs/msg/Imu", "tf2_msgs/msg/TFMessage"
FIX_TYPE = "sensor_msgs/msg/NavSatFix"
IMU_DELAY_NS = 500_000
"""From the instant of an IMU sample to its arrival."""
_GROUND_TRUTH_NS = 10_000_000
_UNKNOWN = np.zeros(9)
_NO_ORIENTATION = np.array([-1.0, *np.zeros(8)])  # sensor_msgs/Imu: the first element −1 means there is no estimate


class BagWriter(AbstractContextManager["BagWriter"]):
    """The two writers of rosbags behind one face.

    Args:
        path: file (ROS 1) or folder (ROS 2) to create.
        format: which of the two.
        topics: type of the messages on each topic.
    """

    def __init__(self, path: Path, format: BagFormat, topics: Mapping[str, str]) -> None:
        from rosbags.rosbag1 import Writer as Ros1Writer
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Ros2Writer
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.ros1 = format == "ros1"
        self.typestore: Typestore = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if TRANSFORMS_TYPE not in self.typestore.types:
            definition = "geometry_msgs/TransformStamped[] transforms"
            self.typestore.register(get_types_from_msg(definition, TRANSFORMS_TYPE))
        self._writer: Any = Ros1Writer(path) if self.ros1 else Ros2Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._topics = topics
        self._connections: dict[str, Any] = {}
        self._arrived_ns = 0

    def __enter__(self) -> BagWriter:
        self._writer.open()
        for topic, kind in self._topics.items():
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self.typestore)
        return self

    def __exit__(self, *error: Any) -> None:
        self._writer.__exit__(*error)

    def message(self, kind: str, **fields: Any) -> Any:
        """A message of this type."""
        return self.typestore.types[kind](**fields)

    def header(self, stamp_ns: int, frame: str) -> Any:
        """A header; ROS 1 counts in it, which nobody reads."""
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        stamp = self.message("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        extra = {"seq": 0} if self.ros1 else {}
        return self.message("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **extra)

    def write(self, topic: str, arrived_ns: int, message: Any) -> None:
        """Messages are stored in the order in which they come, whatever their stamps say."""
        self._arrived_ns = max(self._arrived_ns, arrived_ns)
        serialize = self.typestore.serialize_ros1 if self.ros1 else self.typestore.serialize_cdr
        self._writer.write(self._connections[topic], self._arrived_ns, serialize(message, message.__msgtype__))

    def imu(self, stamp_ns: int, frame: str, gyro: list[float], accel: list[float]) -> Any:
        """sensor_msgs/Imu of one sample."""
        vector = "geometry_msgs/msg/Vector3"
        return self.message(
            IMU_TYPE,
            header=self.header(stamp_ns, frame),
            orientation=self.message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=_NO_ORIENTATION,
            angular_velocity=self.message(vector, x=gyro[0], y=gyro[1], z=gyro[2]),
            angular_velocity_covariance=_UNKNOWN,
            linear_acceleration=self.message(vector, x=accel[0], y=accel[1], z=accel[2]),
            linear_acceleration_covariance=_UNKNOWN,
        )

    def fix(self, stamp_ns: int, frame: str, lat_lon_alt: NDArray[np.float64], covariance: NDArray[np.float64]) -> Any:
        """sensor_msgs/NavSatFix of one fix; a covariance of NaN is of unknown type."""
        is_known = bool(np.isfinite(covariance).all())
        return self.message(
            FIX_TYPE,
            header=self.header(stamp_ns, frame),
            status=self.message("sensor_msgs/msg/NavSatStatus", status=0, service=1),
            latitude=float(lat_lon_alt[0]),
            longitude=float(lat_lon_alt[1]),
            altitude=float(lat_lon_alt[2]),
            position_covariance=covariance.ravel() if is_known else _UNKNOWN,
            position_covariance_type=2 if is_known else 0,
        )

    def transforms(self, stamp_ns: int, parent: str, children: Mapping[str, NDArray[np.float64]]) -> Any:
        """tf2_msgs/TFMessage with T_parent_child (4, 4) of each child."""
        found = []
        for child, T in children.items():
            w, x, y, z = quaternion.from_matrix(T[:3, :3]).tolist()
            px, py, pz = T[:3, 3].tolist()
            pose = self.message(
                "geometry_msgs/msg/Transform",
                translation=self.message("geometry_msgs/msg/Vector3", x=px, y=py, z=pz),
                rotation=self.message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
            )
            found.append(
                self.message(
                    "geometry_msgs/msg/TransformStamped",
                    header=self.header(stamp_ns, parent),
                    child_frame_id=child,
                    transform=pose,
                )
            )
        return self.message(TRANSFORMS_TYPE, transforms=found)


def ground_truth_lines(trajectory: Trajectory, start_ns: int, end_ns: int) -> Iterator[str]:
    """Poses of the IMU at 100 Hz as lines of a TUM file, a block at a time."""
    times = np.arange(start_ns, end_ns + 1, _GROUND_TRUTH_NS)
    for begin in range(0, len(times), 1000):
        block = times[begin : begin + 1000]
        motion = trajectory.evaluate(block)
        q_wxyz = quaternion.from_matrix(motion.R_world_imu)
        yield "".join(map(tum_row, block.tolist(), motion.p_world_imu, q_wxyz))
