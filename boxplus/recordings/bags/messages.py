"""The few ROS messages odometry needs, parsed from their bytes (ROS 1 serialisation and ROS 2 CDR).

Points are never touched one by one: a cloud's payload stays a buffer that NumPy views through the layout the message
declares. Message definitions: sensor_msgs, tf2_msgs (ROS 1 and ROS 2), livox_ros_driver and livox_ros_driver2.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Encoding = Literal["ros1", "cdr"]


class MalformedMessageError(ValueError):
    """The bytes of a message do not have the form its type declares."""


class Cursor:
    """Reads the primitive values of a serialised message one after the other.

    CDR aligns each value to its own size, counted from the end of the 4-byte encapsulation header, and has either byte
    order; ROS 1 is packed and little-endian.
    """

    __slots__ = ("aligned", "data", "order", "position")

    def __init__(self, data: bytes, encoding: Encoding) -> None:
        self.data = data
        self.aligned = encoding == "cdr"
        self.order = "<"
        self.position = 0
        if self.aligned:
            if len(data) < 4 or data[0] != 0 or data[1] > 1:
                raise MalformedMessageError("the message does not begin with a plain CDR encapsulation header")
            self.order = "<" if data[1] == 1 else ">"
            self.position = 4

    def align(self, size: int) -> None:
        if self.aligned:
            self.position += -(self.position - 4) % size

    def values(self, code: str, count: int = 1) -> tuple[Any, ...]:
        """`count` numbers of the struct type `code`."""
        size = struct.calcsize(code)
        self.align(size)
        try:
            result = struct.unpack_from(f"{self.order}{count}{code}", self.data, self.position)
        except struct.error as error:
            raise MalformedMessageError(f"the message ends after {len(self.data)} bytes, before all its fields") from error
        self.position += size * count
        return result

    def value(self, code: str) -> int:
        return int(self.values(code)[0])

    def block(self, size: int) -> memoryview:
        end = self.position + size
        if end > len(self.data):
            raise MalformedMessageError(f"a field of {size} bytes does not fit into a message of {len(self.data)} bytes")
        view = memoryview(self.data)[self.position : end]
        self.position = end
        return view

    def text(self) -> str:
        raw = bytes(self.block(self.value("I")))
        return raw.rstrip(b"\0").decode("utf-8", errors="replace")

    def header(self) -> tuple[int, str]:
        """(stamp [ns], frame) of a std_msgs/Header."""
        if not self.aligned:
            self.value("I")
        seconds = self.value("i" if self.aligned else "I")
        stamp_ns = seconds * 1_000_000_000 + self.value("I")
        return stamp_ns, self.text().strip("/")


@dataclass(frozen=True, slots=True)
class PointField:
    """One declared field of a PointCloud2."""

    name: str
    offset: int
    datatype: int
    count: int


@dataclass(frozen=True, slots=True)
class CloudMessage:
    """A point cloud as it lies in its message: the layout and the untouched payload.

    PointCloud2 and Livox' CustomMsg both take this form; the latter always has the same fields.
    """

    stamp_ns: int
    frame: str
    height: int
    width: int
    fields: tuple[PointField, ...]
    big_endian: bool
    point_step: int
    row_step: int
    data: memoryview


INT8, UINT8, INT16, UINT16, INT32, UINT32, FLOAT32, FLOAT64 = range(1, 9)
NUMPY_CODE = {INT8: "i1", UINT8: "u1", INT16: "i2", UINT16: "u2", INT32: "i4", UINT32: "u4", FLOAT32: "f4", FLOAT64: "f8"}
"""sensor_msgs/PointField datatypes, and NumPy's name for each. Some drivers add 64-bit integers as 9 and 10."""
NUMPY_CODE |= {9: "i8", 10: "u8"}

_MOST_FIELDS = 256
_LIVOX_FIELDS = (
    PointField("offset_time", 0, UINT32, 1),
    PointField("x", 4, FLOAT32, 1),
    PointField("y", 8, FLOAT32, 1),
    PointField("z", 12, FLOAT32, 1),
    PointField("reflectivity", 16, UINT8, 1),
    PointField("tag", 17, UINT8, 1),
    PointField("line", 18, UINT8, 1),
)
_LIVOX_POINT_BYTES = 19


def parse_point_cloud(data: bytes, encoding: Encoding) -> CloudMessage:
    """sensor_msgs/PointCloud2. Raises MalformedMessageError."""
    cursor = Cursor(data, encoding)
    stamp_ns, frame = cursor.header()
    height, width = cursor.values("I", 2)
    field_count = cursor.value("I")
    if field_count > _MOST_FIELDS:
        raise MalformedMessageError(f"the cloud declares {field_count} fields")
    fields = []
    for _ in range(field_count):
        name = cursor.text()
        offset = cursor.value("I")
        datatype = cursor.value("B")
        fields.append(PointField(name, offset, datatype, cursor.value("I")))
    big_endian = bool(cursor.value("B"))
    point_step, row_step = cursor.values("I", 2)
    payload = cursor.block(cursor.value("I"))
    return CloudMessage(stamp_ns, frame, height, width, tuple(fields), big_endian, point_step, row_step, payload)


def parse_livox(data: bytes, encoding: Encoding) -> CloudMessage:
    """CustomMsg of livox_ros_driver and livox_ros_driver2 (the same bytes). Raises MalformedMessageError.

    ROS 1 packs a point into 19 bytes; CDR aligns every point to 4 bytes, so it takes 20, the last one 19.
    """
    cursor = Cursor(data, encoding)
    stamp_ns, frame = cursor.header()
    cursor.values("Q")  # timebase: the sensor's own clock; header.stamp is the same instant in the clock of the IMU
    declared = cursor.value("I")
    cursor.block(4)  # lidar_id and three reserved bytes
    count = cursor.value("I")
    if declared != count:
        raise MalformedMessageError(f"point_num says {declared} points and {count} follow")
    step = 20 if cursor.aligned else _LIVOX_POINT_BYTES
    payload = cursor.block(max(count * step - (step - _LIVOX_POINT_BYTES), 0))
    return CloudMessage(stamp_ns, frame, 1, count, _LIVOX_FIELDS, cursor.order == ">", step, count * step, payload)


def parse_imu(data: bytes, encoding: Encoding) -> tuple[int, str, tuple[float, ...], tuple[float, ...]]:
    """sensor_msgs/Imu: (stamp [ns], frame, angular velocity, linear acceleration). Raises MalformedMessageError."""
    cursor = Cursor(data, encoding)
    stamp_ns, frame = cursor.header()
    numbers = cursor.values("d", 4 + 9 + 3 + 9 + 3)  # orientation, its covariance, gyro, its covariance, acceleration
    return stamp_ns, frame, numbers[13:16], numbers[25:28]


def parse_nav_sat_fix(data: bytes, encoding: Encoding) -> tuple[int, str, int, tuple[float, ...], tuple[float, ...], int]:
    """sensor_msgs/NavSatFix: (stamp [ns], frame, status, latitude, longitude and altitude, covariance (9), its type).

    Raises MalformedMessageError.
    """
    cursor = Cursor(data, encoding)
    stamp_ns, frame = cursor.header()
    status = int(cursor.values("b")[0])
    cursor.values("H")  # which systems of satellites
    position = cursor.values("d", 3)
    return stamp_ns, frame, status, position, cursor.values("d", 9), cursor.value("B")


def parse_transforms(data: bytes, encoding: Encoding) -> list[tuple[str, str, NDArray[np.float64]]]:
    """tf2_msgs/TFMessage: (parent, child, translation and xyzw quaternion (7,)) each. Raises MalformedMessageError."""
    cursor = Cursor(data, encoding)
    transforms = []
    for _ in range(cursor.value("I")):
        _, parent = cursor.header()
        child = cursor.text().strip("/")
        transforms.append((parent, child, np.array(cursor.values("d", 7))))
    return transforms
