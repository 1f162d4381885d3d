"""PLY point clouds: reading (ascii, binary of both byte orders) and streaming writing (binary little-endian)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError
from boxplus.formats.clouds.cloud_writer import RecordWriter
from boxplus.formats.clouds.point_cloud import (
    Columns,
    PointCloud,
    cloud_from_columns,
    opened,
    read_header,
    read_records,
    read_text_table,
)

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8"},
    **{
        "int8": "i1",
        "uint8": "u1",
        "int16": "i2",
        "uint16": "u2",
        "int32": "i4",
        "uint32": "u4",
        "float32": "f4",
        "float64": "f8",
    },
}
_NAMES = {kind: name for name, kind in reversed(_TYPES.items())}
_BYTE_ORDER = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True, slots=True)
class _Element:
    name: str
    count: int
    fields: list[tuple[str, str]]  # property name, NumPy type
    lists: list[str]  # properties of variable length


class PlyWriter(RecordWriter):
    """Streams points (float32 x, y, z, optionally intensity and other columns) to a binary little-endian PLY file."""

    def holds(self, columns: Columns) -> set[str]:
        """All but those of whole numbers of 64 bits."""
        return {name for name, values in columns.items() if values.dtype.str[1:] in _NAMES}

    @staticmethod
    def header(count: int, fields: Sequence[tuple[str, np.dtype[np.generic]]]) -> bytes:
        """The header, padded in a comment so that its length does not depend on `count`."""
        number = str(count)
        lines = [
            "ply",
            "format binary_little_endian 1.0",
            "comment written by boxplus" + " " * (20 - len(number)),
            f"element vertex {number}",
            *(f"property {_NAMES[kind.str[1:]]} {name}" for name, kind in fields),
            "end_header",
        ]
        return ("\n".join(lines) + "\n").encode()


def write_ply(path: str | Path, points: ArrayLike, intensity: ArrayLike | None = None) -> None:
    """Write (N, 3) points [m] and optional (N,) intensities to a PLY file in one go.

    Raises:
        InputError: shapes that do not match.
        OutputError: the file cannot be written.

    Example:
        >>> bp.formats.write_ply("cloud.ply", [[1.0, 2.0, 3.0]], intensity=[0.5])
        >>> bp.formats.read_ply("cloud.ply").points.tolist()
        [[1.0, 2.0, 3.0]]
    """
    with PlyWriter(path) as writer:
        writer.append(points, intensity)


def read_ply(path: str | Path, *, everything: bool = False) -> PointCloud:
    """Read the vertices of a PLY file; other elements are passed over.

    Args:
        everything: read their other properties, too.

    Raises:
        InputError: the file is missing, cut or malformed; the message names file and line.

    Example:
        >>> bp.formats.write_ply("cloud.ply", [[1.0, 2.0, 3.0]], intensity=[0.5])
        >>> bp.formats.read_ply("cloud.ply").intensity.tolist()
        [0.5]
    """
    source = Path(path)
    with opened(source, "PLY") as file:
        return _read(file, source, everything)


def ply_vertex_count(path: str | Path) -> int:
    """The number of points of a PLY file, from its header, after checking that the file is long enough to hold them.

    Raises:
        InputError: as `read_ply`.
    """
    source = Path(path)
    with opened(source, "PLY") as file:
        layout, elements, _ = _parse_header(file, source)
        vertex = _skip_to_vertices(file, source, layout, elements)
        left = file.seek(0, 2) - file.tell() if layout == "ascii" else source.stat().st_size - file.tell()
    size = sum(np.dtype(kind).itemsize for _, kind in vertex.fields)
    if layout != "ascii" and left < vertex.count * size:
        raise InputError(f"{vertex.count} points, as the header says", f"{left // max(size, 1)} ({source})", "the file was cut")
    return vertex.count


def _read(file: BinaryIO, path: Path, everything: bool) -> PointCloud:
    layout, elements, header_lines = _parse_header(file, path)
    vertex = _skip_to_vertices(file, path, layout, elements)
    names = [name for name, _ in vertex.fields]
    columns: dict[str, NDArray[np.generic]]
    if layout == "ascii":
        before = sum(element.count for element in elements[: elements.index(vertex)])
        table = read_text_table(file, path, len(names), vertex.count, header_lines + before + 1)
        columns = {name: table[:, i] for i, name in enumerate(names)}
    else:
        dtype = np.dtype([(name, _BYTE_ORDER[layout] + kind) for name, kind in vertex.fields])
        records = read_records(file, path, dtype, vertex.count)
        columns = {name: records[name] for name in names}
    left_out = [f"{other.count:,} {other.name} elements" for other in elements if other is not vertex and other.count]
    return cloud_from_columns(columns, path, everything=everything, left_out=left_out)


def _skip_to_vertices(file: BinaryIO, path: Path, layout: str, elements: list[_Element]) -> _Element:
    """Move the file to the first vertex, past the elements before it."""
    for element in elements:
        if element.lists:
            raise InputError(
                "vertices before any element of variable length",
                f"the list property {element.lists[0]!r} of {element.name!r} first ({path})",
                "export the file as a point cloud",
            )
        if element.name == "vertex":
            return element
        if layout == "ascii":
            for _ in range(element.count):
                if not file.readline():
                    break
        else:
            file.seek(element.count * sum(np.dtype(kind).itemsize for _, kind in element.fields), 1)
    raise InputError("an element 'vertex'", f"none ({path})", "export the file as a point cloud")


def _parse_header(file: BinaryIO, path: Path) -> tuple[str, list[_Element], int]:
    """Byte layout, elements and number of header lines."""
    if file.read(3) != b"ply":
        raise InputError("a file that begins with 'ply'", f"something else ({path}, line 1)", "give a PLY file")
    file.seek(0)
    lines = read_header(file, path, "end_header")
    layout, elements = "", list[_Element]()
    for number, line in enumerate(lines, 1):
        words = line.split()
        try:
            match words:
                case ["format", layout, _] if layout in _BYTE_ORDER:
                    pass
                case ["element", name, count] if 0 <= int(count) < 2**40:
                    elements.append(_Element(name, int(count), [], []))
                case ["property", "list", _, _, name] if elements:
                    elements[-1].lists.append(name)
                case ["property", kind, name] if elements and name not in dict(elements[-1].fields):
                    elements[-1].fields.append((name, _TYPES[kind]))
                case [] | ["ply"] | ["comment" | "obj_info", *_] | ["end_header"]:
                    pass
                case _:
                    raise ValueError
        except (ValueError, KeyError):
            raise InputError("a PLY header line", f"{line[:60]!r} ({path}, line {number})", "correct the header") from None
    if not layout:
        raise InputError("a header line 'format …'", f"none ({path})", "correct the header")
    return layout, elements, len(lines)
