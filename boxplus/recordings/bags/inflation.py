"""Inflating the compressed parts of bags up to a limit: a few kilobytes may otherwise fill the memory, or the disk."""

from __future__ import annotations

import bz2
import importlib
import os
import re
import shutil
from functools import partial
from types import ModuleType, TracebackType
from typing import Any, BinaryIO

from boxplus.recordings.bags.container import DamagedRecordError

LARGEST_CHUNK = 1 << 28
"""Bytes; no writer makes chunks anywhere near."""
LARGEST_FILE_RATIO = 100
"""How many times its size a file that is compressed as a whole may inflate to, a chunk aside."""
_FRAMES = {
    "bz2": re.compile(rb"BZh[1-9]"),
    "lz4": re.compile(rb"\x04\x22\x4d\x18"),
    "zstd": re.compile(rb"\x28\xb5\x2f\xfd|[\x50-\x5f]\x2a\x4d\x18"),  # the latter: to be skipped
}
"""How a frame begins. Sources: bzip2 1.0.8, LZ4 frame format 1.6.4, RFC 8878."""
_SLICE = 4096  # compressed bytes, which inflate to 130 MB at most


def inflate(compression: str, data: bytes, what: str = "chunk") -> bytes:
    """The content of a chunk, or of what else errors are to name.

    Raises:
        DamagedRecordError: it is larger than `LARGEST_CHUNK`, cut off, or compressed in an unknown way; decompressors raise
            errors of their own.
    """
    if compression in ("none", ""):
        return data
    new_frame: Any
    if compression == "bz2":
        new_frame = bz2.BZ2Decompressor
    elif compression == "lz4":
        import lz4.frame

        new_frame = lz4.frame.LZ4FrameDecompressor
    elif compression == "zstd":
        zstd = _zstd()
        new_frame = zstd.ZstdDecompressor if hasattr(zstd, "ZstdFile") else partial(_ZstandardFrame, zstd)
    else:
        raise DamagedRecordError(f"unknown compression {compression!r}")
    inflated = _inflated(new_frame, _FRAMES[compression], data)
    if inflated is None:
        raise DamagedRecordError(f"the file is cut off in the middle of a {what}")
    if len(inflated) > LARGEST_CHUNK:
        raise DamagedRecordError(f"a {what} of {len(data)} bytes inflates to more than {LARGEST_CHUNK} bytes")
    return inflated


class Zstd:
    """What rosbags' reader of ROS 2 folders uses of its zstd module (zstandard before version 0.11), with limits."""

    def ZstdDecompressor(self) -> Zstd:
        """The decompressor of zstandard."""
        return self

    def decompress(self, data: bytes) -> bytes:
        """One message."""
        return inflate("zstd", data, "message")

    def open(self, file: BinaryIO, mode: str = "rb") -> _InflatedFile:
        """A file that is compressed as a whole."""
        zstd = _zstd()
        return _InflatedFile(zstd.open(file, mode) if hasattr(zstd, "ZstdFile") else _reader_of_zstandard(zstd, file), file)

    def copy_stream(self, file: BinaryIO, target: BinaryIO) -> None:
        """The same with zstandard."""
        shutil.copyfileobj(self.open(file), target)


class _InflatedFile:
    """What a compressed file holds, for reading in pieces."""

    def __init__(self, inflated: Any, file: BinaryIO) -> None:
        self._inflated = inflated
        self._size = os.fstat(file.fileno()).st_size
        self._limit = self._left = LARGEST_CHUNK + LARGEST_FILE_RATIO * self._size

    def read(self, size: int = -1, /) -> bytes:
        """The next piece, or all."""
        piece = bytes(self._inflated.read(size if 0 <= size <= self._left else self._left + 1))
        self._left -= len(piece)
        if self._left < 0:
            raise DamagedRecordError(f"a file of {self._size} bytes inflates to more than {self._limit} bytes")
        return piece

    def __enter__(self) -> _InflatedFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._inflated.close()


def _inflated(new_frame: Any, begins: re.Pattern[bytes], data: bytes) -> bytes | None:
    """Frames that follow each other, up to one byte more than the limit; None where one is cut off.

    Behind the first, what begins none is ignored.
    """
    frames: list[bytes] = []
    left = LARGEST_CHUNK + 1
    while data and left and (not frames or begins.match(data)):
        frame = new_frame()
        frames.append(bytes(frame.decompress(data, max_length=left)))
        left -= len(frames[-1])
        if not frame.eof and left:
            return None
        data = bytes(frame.unused_data or b"")
    return b"".join(frames)


class _ZstandardFrame:
    """What the decompressors of the other modules offer, by zstandard's, which has no limit but on what it is given."""

    def __init__(self, zstandard: ModuleType) -> None:
        self._frame = zstandard.ZstdDecompressor().decompressobj()
        self.unused_data = b""

    @property
    def eof(self) -> bool:
        return bool(self._frame.eof)

    def decompress(self, data: bytes, max_length: int) -> bytes:
        inflated, position = bytearray(), 0
        while position < len(data) and len(inflated) < max_length and not self.eof:
            inflated += self._frame.decompress(data[position : position + _SLICE])
            position += _SLICE
        self.unused_data = self._frame.unused_data + data[position:]
        return bytes(inflated[:max_length])


def _zstd() -> ModuleType:
    """Python's own from 3.14 on; else one that rosbags brings, depending on its version."""
    for name in ("compression.zstd", "backports.zstd"):
        try:
            return importlib.import_module(name)
        except ImportError:
            continue
    return importlib.import_module("zstandard")


def _reader_of_zstandard(zstandard: ModuleType, source: BinaryIO) -> Any:
    return zstandard.ZstdDecompressor().stream_reader(source, read_across_frames=True)
