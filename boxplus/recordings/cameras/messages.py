"""Messages of cameras, parsed from their bytes (sensor_msgs of ROS 1 and ROS 2)."""

from __future__ import annotations

from dataclasses import dataclass

from boxplus.recordings.bags.messages import Cursor, Encoding
from boxplus.recordings.cameras.decode import MalformedImageError, Pixels, decode_file, decode_raw

IMAGE_TYPE, COMPRESSED_TYPE, INFO_TYPE = "sensor_msgs/Image", "sensor_msgs/CompressedImage", "sensor_msgs/CameraInfo"
_MOST_COEFFICIENTS = 64
_DEPTH_HEADER_BYTES = 12  # of compressed_depth_image_transport: format, and two floats for quantised depths


@dataclass(frozen=True, slots=True)
class ImageMessage:
    """An image as it lies in its message.

    Attributes:
        stamp_ns, frame: of the header.
        encoding: of sensor_msgs/Image, or `format` of sensor_msgs/CompressedImage.
        height, width, step, big_endian: of a raw image; zeros of a compressed one.
        data: the payload, untouched.
    """

    stamp_ns: int
    frame: str
    encoding: str
    height: int
    width: int
    step: int
    big_endian: bool
    data: memoryview
    compressed: bool

    @property
    def is_depth(self) -> bool:
        """Whether the encoding is one of depths (REP 118)."""
        return self.encoding.split(";")[0].strip() in ("16UC1", "32FC1")

    @property
    def needs_opencv(self) -> bool:
        """Whether OpenCV is needed for it."""
        return self.compressed or self.encoding.startswith("bayer")

    def pixels(self) -> Pixels:
        """The decoded image. Raises MalformedImageError."""
        if not self.compressed:
            return decode_raw(self.encoding, self.height, self.width, self.step, self.big_endian, self.data)
        if "compressedDepth" in self.encoding:
            if not self.encoding.startswith("16UC1"):
                raise MalformedImageError(f"unknown encoding {self.encoding!r}")
            return decode_file(bytes(self.data[_DEPTH_HEADER_BYTES:]))
        return decode_file(bytes(self.data))


@dataclass(frozen=True, slots=True)
class InfoMessage:
    """sensor_msgs/CameraInfo: sizes, distortion, K (9), R (9), P (12); whether it is binned or cut out."""

    frame: str
    height: int
    width: int
    distortion: str
    D: tuple[float, ...]
    K: tuple[float, ...]
    R: tuple[float, ...]
    P: tuple[float, ...]
    part: bool


def parse_image(data: bytes, encoding: Encoding) -> ImageMessage:
    """sensor_msgs/Image. Raises MalformedMessageError."""
    cursor = Cursor(data, encoding)
    stamp_ns, frame = cursor.header()
    height, width = cursor.values("I", 2)
    name = cursor.text()
    big_endian = bool(cursor.value("B"))
    step = cursor.value("I")
    payload = cursor.block(cursor.value("I"))
    return ImageMessage(stamp_ns, frame, name, height, width, step, big_endian, payload, False)


def parse_compressed(data: bytes, encoding: Encoding) -> ImageMessage:
    """sensor_msgs/CompressedImage. Raises MalformedMessageError."""
    cursor = Cursor(data, encoding)
    stamp_ns, frame = cursor.header()
    name = cursor.text()
    payload = cursor.block(cursor.value("I"))
    return ImageMessage(stamp_ns, frame, name, 0, 0, 0, False, payload, True)


def parse_camera_info(data: bytes, encoding: Encoding) -> InfoMessage:
    """sensor_msgs/CameraInfo. Raises MalformedMessageError."""
    cursor = Cursor(data, encoding)
    _, frame = cursor.header()
    height, width = cursor.values("I", 2)
    distortion = cursor.text()
    count = min(cursor.value("I"), _MOST_COEFFICIENTS)
    D = cursor.values("d", count) if count else ()
    K, R, P = cursor.values("d", 9), cursor.values("d", 9), cursor.values("d", 12)
    binning = cursor.values("I", 2)
    region = cursor.values("I", 4)  # x_offset, y_offset, height, width; all zero: the whole image
    part = max(binning) > 1 or any(region[:2]) or (any(region[2:]) and region[2:] != (height, width))
    return InfoMessage(frame, height, width, distortion, D, K, R, P, part)
