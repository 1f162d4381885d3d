"""PCD point clouds (version 0.7): reading (ascii, binary) and streaming writing (binary)."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError
from boxplus.formats.clouds.cloud_writer import RecordWriter
from boxplus.formats.clouds.point_cloud import PointCloud, cloud_from_columns, opened, read_header, read_records, read_text_table

_KNOWN = {"VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA"}
_KINDS = {"F": "f", "I": "i", "U": "u"}


class PcdWriter(RecordWriter):
    """Streams points (float32 x, y, z and optionally intensity) to a binary PCD file."""

    @staticmethod
    def header(count: int, with_intensity: bool) -> bytes:
        """The header, padded in its comment so that its length does not depend on `count`."""
        number = str(count)
        n = 4 if with_intensity else 3
        lines = [
            "# .PCD v0.7 - Point Cloud Data file format" + " " * 2 * (20 - len(number)),
            "VERSION 0.7",
            "FIELDS x y z" + (" intensity" if with_intensity else ""),
            "SIZE" + " 4" * n,
            "TYPE" + " F" * n,
            "COUNT" + " 1" * n,
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


def read_pcd(path: str | Path) -> PointCloud:
    """Read a PCD file; fields other than x, y, z and intensity are passed over, points that are NaN are kept.

    Raises:
        InputError: the file is missing, cut, compressed or malformed; the message names file and line.

    Example:
        >>> bp.formats.write_pcd("cloud.pcd", [[1.0, 2.0, 3.0]])
        >>> bp.formats.read_pcd("cloud.pcd").intensity is None
        True
    """
    source = Path(path)
    with opened(source, "PCD") as file:
        return _read(file, source)


def _read(file: BinaryIO, path: Path) -> PointCloud:
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
    count = _integer(header, at, "POINTS", path) if "POINTS" in header else _integer(header, at, "WIDTH", path)
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
    return cloud_from_columns(columns, path)


def _integer(header: dict[str, list[str]], at: dict[str, int], key: str, path: Path) -> int:
    words = header.get(key, [])
    if len(words) != 1 or not words[0].isdecimal():
        raise InputError(f"{key} with a number", f"{' '.join(words)!r} ({path}, line {at.get(key, 0)})", "correct the header")
    return int(words[0])
