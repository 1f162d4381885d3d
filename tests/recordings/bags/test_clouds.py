"""Cloud payloads of any layout are viewed as a point-by-point decoder reads them; wrong sizes are refused."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.recordings.bags.clouds import coordinates, is_time_name, view_points
from boxplus.recordings.bags.messages import (
    FLOAT32,
    FLOAT64,
    INT32,
    UINT16,
    UINT32,
    CloudMessage,
    MalformedMessageError,
    PointField,
)

STRUCT_CODE = {FLOAT32: "f", FLOAT64: "d", INT32: "i", UINT16: "H", UINT32: "I"}
SIZE = {FLOAT32: 4, FLOAT64: 8, INT32: 4, UINT16: 2, UINT32: 4}


@st.composite
def clouds(draw: st.DrawFn) -> tuple[CloudMessage, list[dict[str, float]]]:
    """A cloud in a random layout, and its points decoded one by one with struct."""
    coordinate = draw(st.sampled_from([FLOAT32, FLOAT64]))
    kinds = {"x": coordinate, "y": coordinate, "z": coordinate, "t": draw(st.sampled_from([UINT32, INT32, FLOAT32, FLOAT64]))}
    if draw(st.booleans()):
        kinds["ring"] = UINT16
    names = draw(st.permutations(list(kinds)))
    fields, offset = [], 0
    for name in names:
        offset += draw(st.integers(0, 3))
        fields.append(PointField(name, offset, kinds[name], 1))
        offset += SIZE[kinds[name]]
    step = offset + draw(st.integers(0, 5))
    height, width = draw(st.integers(1, 3)), draw(st.integers(0, 5))
    row_step = width * step + (draw(st.integers(0, 7)) if height > 1 else 0)
    data = draw(st.binary(min_size=height * row_step, max_size=height * row_step))
    big = draw(st.booleans())
    points = []
    for row in range(height):
        for column in range(width):
            start = row * row_step + column * step
            points.append(
                {
                    f.name: struct.unpack_from((">" if big else "<") + STRUCT_CODE[f.datatype], data, start + f.offset)[0]
                    for f in fields
                }
            )
    return CloudMessage(0, "", height, width, tuple(fields), big, step, row_step, memoryview(data)), points


@given(clouds())
def test_any_layout_reads_like_struct(case: tuple[CloudMessage, list[dict[str, float]]]) -> None:
    cloud, expected = case
    points = view_points(cloud, "t")
    assert len(points) == len(expected)
    for point, reference in zip(points, expected, strict=True):
        for column, name in (("x", "x"), ("y", "y"), ("z", "z"), ("time", "t")):
            np.testing.assert_array_equal(point[column], np.array(reference[name], point[column].dtype))
    if len(points):
        with np.errstate(over="ignore", invalid="ignore"):
            xyz = coordinates(points)
            wanted = np.array([[p["x"], p["y"], p["z"]] for p in expected]).astype(np.float32)
        np.testing.assert_array_equal(xyz, wanted)


def cloud(fields: tuple[PointField, ...], step: int, width: int, data: bytes, height: int = 1, row_step: int = 0) -> CloudMessage:
    return CloudMessage(0, "", height, width, fields, False, step, row_step, memoryview(data))


XYZ = tuple(PointField(name, 4 * k, FLOAT32, 1) for k, name in enumerate("xyz"))


@pytest.mark.parametrize(
    ("message", "broken"),
    [
        (r"no field z \(fields: x, y\)", cloud(XYZ[:2], 12, 1, bytes(12))),
        ("unknown datatype 77", cloud((*XYZ[:2], PointField("z", 8, 77, 1)), 12, 1, bytes(12))),
        ("does not fit into points of 8 bytes", cloud(XYZ, 8, 1, bytes(12))),
        ("1 x 3 points need 36 bytes and 35 came", cloud(XYZ, 12, 3, bytes(35))),
        ("rows of 20 bytes cannot hold 2 points", cloud(XYZ, 12, 2, bytes(48), height=2, row_step=20)),
        ("does not fit into points of 0 bytes", cloud(XYZ, 0, 3, b"")),
    ],
)
def test_sizes_that_do_not_match(message: str, broken: CloudMessage) -> None:
    with pytest.raises(MalformedMessageError, match=message):
        view_points(broken, None)


def test_a_payload_may_end_after_the_last_used_byte() -> None:
    data = np.arange(6, dtype="<f4")
    points = view_points(cloud(XYZ, 16, 2, data[:3].tobytes() + bytes(4) + data[3:].tobytes()), None)
    np.testing.assert_array_equal(coordinates(points), data.reshape(2, 3))


def test_names_of_time_fields() -> None:
    known = (
        "t",
        "time",
        "timestamp",
        "timeStamp",
        "offset_time",
        "time_offset",
        "time_stamp",
        "point_time_offset",
        "time_offset_ns",
    )
    assert all(is_time_name(name) for name in known)
    assert not any(is_time_name(name) for name in ("x", "ring", "intensity", "tag", "temperature"))
