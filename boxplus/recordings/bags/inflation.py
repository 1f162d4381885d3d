"""Inflating the compressed parts of bags up to a limit: a few kilobytes may otherwise fill the memory, or the disk."""

from __future__ import annotations

import bz2
import importlib
import os
import shutil
from types import ModuleType, TracebackType
from typing import Any, BinaryIO

from boxplus.recordings.bags.container import DamagedRecordError

LARGEST_CHUNK = 1 << 28
"""Bytes; no writer makes chunks anywhere near."""
LARGEST_FILE_RATIO = 100
"""How many times its size a file that is compressed as a whole may inflate to, a chunk aside."""


def inflate(compression: str, data: bytes) -> bytes:
    """The content of a chunk or of a message.

    Raises:
        DamagedRecordError: it is larger than `LARGEST_CHUNK`, cut off, or compressed in an unknown way; decompressors raise
            errors of their own.
    """
    if compression in ("none", ""):
        return data
    if compression == "bz2":
        inflated = _inflated(bz2.BZ2Decompressor, data)
    elif compression == "lz4":
        import lz4.frame

        inflated = _inflated(lz4.frame.LZ4FrameDecompressor, data)
    elif compression == "zstd":
        zstd = _zstd()
        if hasattr(zstd, "ZstdFile"):
            inflated = _inflated(zstd.ZstdDecompressor, data)
        else:
            inflated = bytes(_reader_of_zstandard(zstd, data).read(LARGEST_CHUNK + 1))
    else:
        raise DamagedRecordError(f"unknown compression {compression!r}")
    if len(inflated) > LARGEST_CHUNK:
        raise DamagedRecordError(f"{len(data)} compressed bytes inflate to more than {LARGEST_CHUNK} bytes")
    return inflated


class Zstd:
    """What rosbags' reader of ROS 2 folders uses of its zstd module (zstandard before version 0.11), with limits."""

    def ZstdDecompressor(self) -> Zstd:
        """The decompressor of zstandard."""
        return self

    def decompress(self, data: bytes) -> bytes:
        """One message."""
        return inflate("zstd", data)

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
        """The next piece."""
        piece = bytes(self._inflated.read(size))
        self._left -= len(piece)
        if self._left < 0:
            raise DamagedRecordError(f"a file of {self._size} bytes inflates to more than {self._limit} bytes")
        return piece

    def __enter__(self) -> _InflatedFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._inflated.close()


def _inflated(new_decompressor: Any, data: bytes) -> bytes:
    """Frames that follow each other, up to one byte more than the limit."""
    frames, left = [], LARGEST_CHUNK + 1
    while data and left:
        decompressor = new_decompressor()
        frames.append(bytes(decompressor.decompress(data, max_length=left)))
        left -= len(frames[-1])
        if not decompressor.eof and left:
            raise DamagedRecordError("the file is cut off in the middle of a chunk")
        data = bytes(decompressor.unused_data or b"")
    return b"".join(frames)


def _zstd() -> ModuleType:
    """Python's own from 3.14 on; else one that rosbags brings, depending on its version."""
    for name in ("compression.zstd", "backports.zstd"):
        try:
            return importlib.import_module(name)
        except ImportError:
            continue
    return importlib.import_module("zstandard")


def _reader_of_zstandard(zstandard: ModuleType, source: object) -> Any:
    return zstandard.ZstdDecompressor().stream_reader(source, read_across_frames=True)
