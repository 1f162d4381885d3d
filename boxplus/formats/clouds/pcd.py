"""PCD point clouds (version 0.7): reading (ascii, binary) and streaming writing (binary)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError
from boxplus.formats.clouds.cloud_writer import RecordWriter
from boxplus.formats.clouds.point_cloud import (
    COLORS,
    Columns,
    PointCloud,
    cloud_from_columns,
    opened,
    read_header,
    read_records,
    read_text_table,
)

_KNOWN = {"VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA"}
_KINDS = {"F": "f", "I": "i", "U": "u"}


class PcdWriter(RecordWriter):
    """Streams points (float32 x, y, z, optionally intensity and other columns) to a binary PCD file.

    Colours of 8 bits become PCL's `rgb`.
    """

    def holds(self, columns: Columns) -> set[str]:
        """All of them."""
        return set(columns)

    def packed(self, columns: Columns) -> Columns:
        """See `RecordWriter.packed`."""
        if not all(name in columns and columns[name].dtype == np.uint8 for name in COLORS):
            return columns
        red, green, blue = (columns[name].astype(np.uint32) for name in COLORS)
        others = {name: values for name, values in columns.items() if name not in COLORS}
        return {**others, "rgb": red << 16 | green << 8 | blue}

    @staticmethod
    def header(count: int, fields: Sequence[tuple[str, np.dtype[np.generic]]]) -> bytes:
        """The header, padded in its comment so that its length does not depend on `count`."""
        number = str(count)
        lines = [
            "# .PCD v0.7 - Point Cloud Data file format" + " " * 2 * (20 - len(number)),
            "VERSION 0.7",
            " ".join(["FIELDS", *(name for name, _ in fields)]),
            " ".join(["SIZE", *(str(kind.itemsize) for _, kind in fields)]),
            " ".join(["TYPE", *(kind.kind.upper() for _, kind in fields)]),
            "COUNT" + " 1" * len(fields),
            f"WIDTH {number}",
            "HEIGHT 1",
            "VIEWPOINT 0 0 0 1 0 0 0",
            f"POINTS {number}",
            "DATA binary",
        ]
        return ("\n".join(lines) + "\n").encode()


def write_pcd(path: str | Path, points: ArrayLike, intensity: ArrayLike | None = None) -> None:
    """Write (N, 3) points [m] and optional (N,) intensities to a PCD file in one go.

    Raises:
        InputError: shapes that do not match.
        OutputError: the file cannot be written.

    Example:
        >>> bp.formats.write_pcd("cloud.pcd", [[1.0, 2.0, 3.0]])
        >>> bp.formats.read_pcd("cloud.pcd").points.tolist()
        [[1.0, 2.0, 3.0]]
    """
    with PcdWriter(path) as writer:
        writer.append(points, intensity)


def read_pcd(path: str | Path, *, everything: bool = False) -> PointCloud:
    """Read a PCD file; points that are NaN are kept.

    Args:
        everything: read other fields than x, y, z and intensity, too, those of one number.

    Raises:
        InputError: the file is missing, cut, compressed or malformed; the message names file and line.

    Example:
        >>> bp.formats.write_pcd("cloud.pcd", [[1.0, 2.0, 3.0]])
        >>> bp.formats.read_pcd("cloud.pcd").intensity is None
        True
    """
    source = Path(path)
    with opened(source, "PCD") as file:
        return _read(file, source, everything)


def _read(file: BinaryIO, path: Path, everything: bool) -> PointCloud:
    lines = read_header(file, path, "DATA")
    header: dict[str, list[str]] = {}
    at: dict[str, int] = {}
    for number, line in enumerate(lines, 1):
        words = line.split()
        if words and not words[0].startswith("#"):
            if words[0] not in _KNOWN:
                raise InputError("a PCD header line", f"{line[:60]!r} ({path}, line {number})", "correct the header")
            header[words[0]], at[words[0]] = words[1:], number
    names = header.get("FIELDS", [])
    if "POINTS" in header:
        count = _integer(header, at, "POINTS", path)
    else:  # rows of an organised cloud, which an unorganised one has a single one of
        count = _integer(header, at, "WIDTH", path) * (_integer(header, at, "HEIGHT", path) if "HEIGHT" in header else 1)
    repeats = header.get("COUNT", ["1"] * len(names))
    kinds, sizes = header.get("TYPE", []), header.get("SIZE", [])
    try:
        if not len(names) == len(kinds) == len(sizes) == len(repeats) > 0 or len(set(names) - {"_"}) < len(names) - names.count(
            "_"
        ):
            raise ValueError
        dtype = np.dtype(
            [
                (f"_{i}" if name == "_" else name, "<" + _KINDS[kind] + size, (int(repeat),))
                for i, (name, kind, size, repeat) in enumerate(zip(names, kinds, sizes, repeats, strict=True))
            ]
        )
    except (ValueError, KeyError, TypeError, OverflowError):
        raise InputError(
            "FIELDS, SIZE, TYPE and COUNT of the same length and of known types",
            f"{names}, {sizes}, {kinds}, {repeats} ({path}, line {at.get('FIELDS', len(lines))})",
            "correct the header",
        ) from None
    layout = " ".join(header["DATA"])
    columns: dict[str, NDArray[np.generic]] = {}
    if layout == "ascii":
        widths = [max(int(repeat), 1) for repeat in repeats]
        table = read_text_table(file, path, sum(widths), count, len(lines) + 1)
        columns = {name: table[:, begin] for name, begin in zip(names, np.cumsum([0, *widths]).tolist(), strict=False)}
    elif layout == "binary":
        records = read_records(file, path, dtype, count)
        columns = {name: records[name][:, 0] for name in names if name in (dtype.names or ()) and dtype[name].shape[0] > 0}
    else:
        raise InputError(
            "DATA ascii or DATA binary",
            f"DATA {layout} ({path}, line {len(lines)})",
            "convert the file, e.g. with pcl_convert_pcd_ascii_binary",
        )
    if not everything:
        return cloud_from_columns(columns, path)
    several = [name for name, repeat in zip(names, repeats, strict=True) if int(repeat) != 1 and name != "_"]
    left_out = [*several, *(["the viewpoint"] if header.get("VIEWPOINT", [])[:6] not in ([], list("000100")) else [])]
    if header.get("HEIGHT", ["1"]) != ["1"]:
        left_out.append(f"the order in rows of {' '.join(header.get('WIDTH', []))}")
    others = {name: values for name, values in columns.items() if name not in (*several, "_")}
    with np.errstate(invalid="ignore"):  # text is read as float64: as the types that the header names
        kept = {name: values if name in "xyz" else values.astype(dtype[name].base) for name, values in others.items()}
    return cloud_from_columns(_unpacked(kept), path, everything=True, left_out=left_out)


def _unpacked(columns: dict[str, NDArray[np.generic]]) -> dict[str, NDArray[np.generic]]:
    """Colours that PCL packs into one number, which it may call a float, as three."""
    name = next((name for name in ("rgb", "rgba") if name in columns and columns[name].dtype.itemsize == 4), None)
    if name is None or set(COLORS) & columns.keys():
        return columns
    packed = columns.pop(name)
    bits = np.ascontiguousarray(packed).view(np.uint32)
    shifts = {"red": 16, "green": 8, "blue": 0, **({"alpha": 24} if name == "rgba" else {})}
    return {**columns, **{color: (bits >> shift & 255).astype(np.uint8) for color, shift in shifts.items()}}


def _integer(header: dict[str, list[str]], at: dict[str, int], key: str, path: Path) -> int:
    words = header.get(key, [])
    if len(words) != 1 or not words[0].isdecimal():
        raise InputError(f"{key} with a number", f"{' '.join(words)!r} ({path}, line {at.get(key, 0)})", "correct the header")
    return int(words[0])
