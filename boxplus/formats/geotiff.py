"""Heights over a grid as GeoTIFF, without any library: one band of float32, uncompressed."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.output import atomic_file

_TYPES = {"ascii": (2, 1, ""), "short": (3, 2, "H"), "long": (4, 4, "I"), "double": (12, 8, "d")}


def write_geotiff(path: str | Path, heights: NDArray[np.float64], resolution: float, origin: tuple[float, float]) -> None:
    """Write a raster in a local metric frame (no coordinate reference system); NaN is "no data".

    Args:
        heights: (rows, columns) [m], row 0 at the bottom (smallest y).
        resolution: side of a cell [m]; origin: x, y of the lower left corner [m].

    Raises:
        InputError: 4 GB or more, which TIFF cannot hold.
        OutputError: it cannot be written.

    Sources: TIFF 6.0 (Adobe 1992); OGC GeoTIFF 1.1 (ModelPixelScale, ModelTiepoint); GDAL_NODATA is GDAL's.
    """
    rows, columns = heights.shape
    if 4 * rows * columns >= 2**32 - 4096:
        raise InputError("less than 4 GB of heights", f"{columns:,} × {rows:,} cells", "take larger cells (--resolution)")
    values = np.ascontiguousarray(heights[::-1], dtype="<f4")
    top = origin[1] + rows * resolution
    keys = [1, 1, 0, 2, 1024, 0, 1, 32767, 1025, 0, 1, 1]  # a frame of one's own; a value is that of its cell's area
    tags: list[tuple[int, str, list[float] | list[int] | bytes]] = [
        (256, "long", [columns]),
        (257, "long", [rows]),
        (258, "short", [32]),
        (259, "short", [1]),
        (262, "short", [1]),
        (273, "long", [8]),
        (277, "short", [1]),
        (278, "long", [rows]),
        (279, "long", [values.nbytes]),
        (339, "short", [3]),
        (33550, "double", [resolution, resolution, 0.0]),
        (33922, "double", [0.0, 0.0, 0.0, origin[0], top, 0.0]),
        (34735, "short", keys),
        (42113, "ascii", b"nan\x00"),
    ]
    begin = 8 + values.nbytes
    entries, more = b"", b""
    more_at = begin + 2 + 12 * len(tags) + 4
    for tag, kind, content in tags:
        number, size, letter = _TYPES[kind]
        data = content if isinstance(content, bytes) else struct.pack(f"<{len(content)}{letter}", *content)
        place = data.ljust(4, b"\x00") if len(data) <= 4 else struct.pack("<I", more_at + len(more))
        entries += struct.pack("<HHI", tag, number, len(data) // size) + place
        more += data if len(data) > 4 else b""
    with atomic_file(path) as file:
        file.write(struct.pack("<2sHI", b"II", 42, begin))
        file.write(values.tobytes())
        file.write(struct.pack("<H", len(tags)) + entries + struct.pack("<I", 0) + more)
