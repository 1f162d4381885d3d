"""Images from their bytes: raw, PGM and PPM without help; JPEG, PNG and demosaicing through OpenCV.

What decoders pass over in silence is checked here: libjpeg paints the missing rest of a cut image grey, so a JPEG must hold
its end marker behind its last scan, and every chunk of a PNG its checksum. Damage inside of a JPEG's entropy code shows in
no checksum; such an image may be decoded with wrong pixels.
"""

from __future__ import annotations

import re
import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus._extras import require
from boxplus.errors import RecordingError

Pixels = NDArray[Any]

PNG_MAGIC, JPEG_MAGIC = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
_NETPBM_HEADER = re.compile(
    rb"P([56])\s(?:\s*#[^\n]*\n)*\s*(\d{1,6})\s(?:\s*#[^\n]*\n)*\s*(\d{1,6})\s(?:\s*#[^\n]*\n)*\s*(\d{1,5})\s"
)
_LARGEST_SIDE = 1 << 15

# OpenCV names a mosaic by the second row's second and third pixel, ROS by the first row's first two and the one below.
_BAYER = {
    f"bayer_{pattern}{bits}": code
    for pattern, code in (("rggb", "BG"), ("bggr", "RG"), ("gbrg", "GR"), ("grbg", "GB"))
    for bits in (8, 16)
}
_RAW: dict[str, tuple[str, int, tuple[int, ...]]] = {
    "mono8": ("u1", 1, (0,)),
    "8UC1": ("u1", 1, (0,)),
    "mono16": ("u2", 1, (0,)),
    "16UC1": ("u2", 1, (0,)),
    "32FC1": ("f4", 1, (0,)),
    "rgb8": ("u1", 3, (0, 1, 2)),
    "bgr8": ("u1", 3, (2, 1, 0)),
    "rgba8": ("u1", 4, (0, 1, 2)),
    "bgra8": ("u1", 4, (2, 1, 0)),
    "rgb16": ("u2", 3, (0, 1, 2)),
    "bgr16": ("u2", 3, (2, 1, 0)),
    "rgba16": ("u2", 4, (0, 1, 2)),
    "bgra16": ("u2", 4, (2, 1, 0)),
    "yuv422": ("u1", 2, (1,)),
    "uyvy": ("u1", 2, (1,)),
    "yuv422_yuy2": ("u1", 2, (0,)),
    "yuyv": ("u1", 2, (0,)),
    **{name: ("u2" if name.endswith("16") else "u1", 1, (0,)) for name in _BAYER},
}
"""Type, channels, and which of them are red, green, blue, or all there is of light, by the encodings of
sensor_msgs/image_encodings.h."""

ENCODINGS = tuple(_RAW)
DEPTH_ENCODINGS = {"16UC1": 1e-3, "32FC1": 1.0}
"""Encodings of depth images and metres of one count (REP 118)."""


class MalformedImageError(ValueError):
    """The bytes of an image are not what they say they are."""


def needs_opencv(data: bytes) -> bool:
    """Whether an encoded image can be read with OpenCV only."""
    return not data.startswith((b"P5", b"P6"))


def decode_raw(encoding: str, height: int, width: int, step: int, big_endian: bool, data: bytes | memoryview) -> Pixels:
    """The pixels of a raw image: (H, W) or (H, W, 3) in the order red, green, blue; Bayer mosaics are interpolated.

    Of luminance and chrominance (YUV 4:2:2) the luminance is taken.

    Raises:
        MalformedImageError: an unknown encoding, or sizes that do not match.
        RecordingError: a Bayer mosaic, and OpenCV is not installed.
    """
    if encoding not in ENCODINGS:
        raise MalformedImageError(f"unknown encoding {encoding!r}, where {', '.join(ENCODINGS)} are read")
    kind, channels, order = _RAW[encoding]
    dtype = np.dtype(kind).newbyteorder(">" if big_endian else "<")
    row = width * channels * dtype.itemsize
    if not (0 < height <= _LARGEST_SIDE and 0 < width <= _LARGEST_SIDE):
        raise MalformedImageError(f"a size of {width}x{height} pixels")
    if step < row or len(data) < height * step:
        raise MalformedImageError(f"{len(data)} bytes in rows of {step} for {width}x{height} pixels of {encoding}")
    rows = np.frombuffer(data, np.uint8, height * step).reshape(height, step)[:, :row]
    pixels = np.ascontiguousarray(rows).view(dtype).reshape(height, width, channels)
    pixels = pixels.astype(dtype.newbyteorder("="), copy=False)
    if encoding in _BAYER:
        cv2 = require("cv2", "to decode Bayer mosaics", RecordingError)
        return np.asarray(cv2.cvtColor(pixels[:, :, 0], getattr(cv2, f"COLOR_Bayer{_BAYER[encoding]}2RGB")))
    return np.ascontiguousarray(pixels[:, :, list(order)] if len(order) > 1 else pixels[:, :, order[0]])


def decode_file(data: bytes) -> Pixels:
    """The pixels of an encoded image: PGM, PPM (of 8 or 16 bits), JPEG, PNG; colours in the order red, green, blue.

    Raises:
        MalformedImageError: another format, cut off, or damaged.
        RecordingError: JPEG or PNG, and OpenCV is not installed.
    """
    if data.startswith((b"P5", b"P6")):
        return _netpbm(data)
    if data.startswith(JPEG_MAGIC):
        if data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda"):
            raise MalformedImageError("a JPEG that is cut off")
        what = "JPEG"
    elif data.startswith(PNG_MAGIC):
        _check_png(data)
        what = "PNG"
    else:
        raise MalformedImageError("neither JPEG, PNG, PGM nor PPM" if data else "an empty file")
    cv2 = require("cv2", f"to decode {what} images", RecordingError)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise MalformedImageError(f"a {what} that cannot be decoded")
    if pixels.ndim == 2:
        return np.asarray(pixels)
    return np.ascontiguousarray(pixels[:, :, 2::-1])


def _netpbm(data: bytes) -> Pixels:
    header = _NETPBM_HEADER.match(data)
    if header is None:
        raise MalformedImageError("a PGM or PPM without its header")
    kind, width, height, largest = (int(number) for number in header.groups())
    deep = largest > 255
    pixels = decode_raw(
        {(5, False): "mono8", (5, True): "mono16", (6, False): "rgb8"}.get((kind, deep), "rgb16"),
        *(height, width, width * (3 if kind == 6 else 1) * (2 if deep else 1)),
        big_endian=True,
        data=memoryview(data)[header.end() :],
    )
    return pixels


def _check_png(data: bytes) -> None:
    position = len(PNG_MAGIC)
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        end = position + 12 + length
        if end > len(data):
            break
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(memoryview(data)[position + 4 : end - 4]) != checksum:
            raise MalformedImageError("a PNG with a wrong checksum")
        if data[position + 4 : position + 8] == b"IEND":
            return
        position = end
    raise MalformedImageError("a PNG that is cut off")
