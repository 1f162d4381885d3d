"""Grey images as PNG and PGM files, without a library: 8 and 16 bits."""

from __future__ import annotations

import struct
import zlib
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError

ImageFormat = Literal["png", "pgm"]
_COMPRESSION = 1
_UP = 2  # PNG's filter that stores the difference to the row above


def encode_image(pixels: NDArray[Any], format: ImageFormat = "png") -> bytes:
    """The bytes of a file with the grey values (H, W), uint8 or uint16.

    Args:
        pixels: the image.
        format: `png` (ISO/IEC 15948), or `pgm` (netpbm), which is larger and needs no library to be read.

    Raises:
        InputError: another shape, type or format.

    Example:
        >>> encode_image(np.zeros((2, 3), np.uint8), "pgm")[:11]
        b'P5\\n3 2\\n255\\n'
    """
    if pixels.ndim != 2 or pixels.dtype not in (np.uint8, np.uint16) or not pixels.size:
        raise InputError("grey values (H, W), uint8 or uint16", f"{pixels.dtype} of shape {pixels.shape}", "convert them first")
    if format not in ("png", "pgm"):
        raise InputError("the format 'png' or 'pgm'", repr(format), "choose one of the two")
    height, width = pixels.shape
    rows = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">"))).view(np.uint8).reshape(height, -1)
    if format == "pgm":
        largest = 255 if pixels.dtype == np.uint8 else 65535
        return f"P5\n{width} {height}\n{largest}\n".encode() + rows.tobytes()
    filtered = np.empty((height, rows.shape[1] + 1), np.uint8)
    filtered[:, 0] = _UP
    filtered[0, 1:] = rows[0]
    filtered[1:, 1:] = rows[1:] - rows[:-1]
    head = struct.pack(">IIBBBBB", width, height, 8 * pixels.dtype.itemsize, 0, 0, 0, 0)
    data = zlib.compress(filtered.tobytes(), _COMPRESSION)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", head) + _chunk(b"IDAT", data) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
