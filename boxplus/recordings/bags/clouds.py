"""From a cloud's payload to arrays, through a structured view of the layout its message declares."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.recordings.bags.messages import NUMPY_CODE, CloudMessage, MalformedMessageError, PointField

_TIME_NAMES = frozenset(
    (
        *("t", "ts", "dt", "time", "timestamp", "timestamps", "stamp", "offsettime", "timeoffset", "timeoffsetns", "toffset"),
        *("pointtimeoffset", "pointtime", "reltime", "relativetime", "timens", "timeus", "timesec", "tns", "tus"),
    )
)
_INTENSITY_NAMES = ("intensity", "intensities", "reflectivity", "reflectance", "i", "signal")


def is_time_name(name: str) -> bool:
    """Whether drivers are known to keep the time of a point under this field name (case and underscores aside)."""
    return name.lower().replace("_", "") in _TIME_NAMES


@dataclass(frozen=True, slots=True)
class CloudLayout:
    """Where a cloud keeps what is needed of it.

    Attributes:
        dtype: one point: `x`, `y`, `z`, and `intensity`, `time` where present; itemsize is the point step.
        time_fields: names of all fields that may hold the time of a point.
    """

    dtype: np.dtype[np.void]
    time_fields: tuple[str, ...]


@functools.lru_cache(maxsize=64)
def cloud_layout(fields: tuple[PointField, ...], big_endian: bool, point_step: int, time_field: str | None) -> CloudLayout:
    """The structured dtype that views a cloud with these fields, with its column `time` on `time_field` (None: no such column).

    Raises:
        MalformedMessageError: no x, y, z, an unknown datatype, or fields that do not fit into a point.
    """
    by_name = {field.name: field for field in fields}
    columns = {axis: by_name.get(axis) or by_name.get(axis.upper()) for axis in "xyz"}
    missing = [axis for axis, field in columns.items() if field is None]
    if missing:
        raise MalformedMessageError(f"the cloud has no field {', '.join(missing)} (fields: {', '.join(by_name) or 'none'})")
    strength = next((by_name[name] for name in _INTENSITY_NAMES if name in by_name), None)
    columns |= {"intensity": strength, "time": by_name.get(time_field) if time_field else None}
    names, formats, offsets = [], [], []
    for name, field in columns.items():
        if field is None:
            continue
        code = NUMPY_CODE.get(field.datatype)
        if code is None:
            raise MalformedMessageError(f"field {field.name} has the unknown datatype {field.datatype}")
        element = np.dtype((">" if big_endian else "<") + code)
        if field.offset + element.itemsize > point_step:
            raise MalformedMessageError(
                f"field {field.name} at byte {field.offset} does not fit into points of {point_step} bytes"
            )
        names.append(name)
        formats.append(element)
        offsets.append(field.offset)
    try:
        dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": point_step})
    except ValueError as error:
        raise MalformedMessageError(f"points of {point_step} bytes cannot be viewed: {error}") from error
    return CloudLayout(dtype, tuple(field.name for field in fields if is_time_name(field.name)))


def view_points(cloud: CloudMessage, time_field: str | None) -> NDArray[np.void]:
    """The points of a cloud as a structured array (N,), columns `x`, `y`, `z` and, where present, `intensity`, `time`.

    Nothing is copied unless the rows are padded or the payload ends inside the last point's unused bytes.

    Raises:
        MalformedMessageError: the payload is shorter than height, width and the steps promise.
    """
    layout = cloud_layout(cloud.fields, cloud.big_endian, cloud.point_step, time_field)
    dtype = layout.dtype
    count = cloud.height * cloud.width
    if count == 0:
        return np.empty(0, dtype)
    row_bytes = cloud.width * cloud.point_step
    row_step = cloud.row_step if cloud.row_step and cloud.height > 1 else row_bytes
    if row_step < row_bytes:
        raise MalformedMessageError(f"rows of {row_step} bytes cannot hold {cloud.width} points of {cloud.point_step} bytes")
    last_used = max(dtype.fields[name][1] + dtype.fields[name][0].itemsize for name in dtype.names or () if dtype.fields)
    needed = (cloud.height - 1) * row_step + row_bytes - cloud.point_step + last_used
    if len(cloud.data) < needed:
        raise MalformedMessageError(f"{cloud.height} x {cloud.width} points need {needed} bytes and {len(cloud.data)} came")
    buffer = np.frombuffer(cloud.data, np.uint8)
    total = (cloud.height - 1) * row_step + row_bytes
    if len(buffer) < total:
        buffer = np.concatenate((buffer, np.zeros(total - len(buffer), np.uint8)))
    if row_step == row_bytes:
        return np.frombuffer(buffer.data, dtype, count)
    return np.ndarray((cloud.height, cloud.width), dtype, buffer.data, strides=(row_step, cloud.point_step)).reshape(-1)


def coordinates(points: NDArray[np.void]) -> NDArray[np.float32]:
    """(N, 3) float32 of the columns x, y, z, in native byte order; beyond float32 they become infinite."""
    p_lidar = np.empty((len(points), 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for axis, name in enumerate("xyz"):
            p_lidar[:, axis] = points[name]
    return p_lidar
