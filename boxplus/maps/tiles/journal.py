"""The journal of a map: points as they come, appended to one file, so that a killed run loses none of them."""

from __future__ import annotations

import os
import struct
import zlib
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.output import output_error

_MAGIC = b"BXPJRNL1"
_HEADER = struct.Struct("<8sI")  # magic, columns per point
_BLOCK = struct.Struct("<II")  # points, CRC-32 of their bytes


class JournalWriter:
    """Appends blocks of points; each reaches the operating system before `append` returns.

    Args:
        path: the file, which must not exist.
        columns: float32 numbers per point, 3 or 4.

    Raises:
        OutputError: the file cannot be created.
    """

    def __init__(self, path: Path, columns: int) -> None:
        self.path = path
        self._size = 0
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o644)
        except OSError as error:
            raise output_error(path, error) from error
        self._write(_HEADER.pack(_MAGIC, columns))

    def append(self, records: NDArray[np.float32]) -> None:
        """Write (N, columns) little-endian float32 rows as one block.

        Raises:
            OutputError: the disk is full; the block that did not fit is taken back.
        """
        payload = records.tobytes()
        self._write(_BLOCK.pack(len(records), zlib.crc32(payload)) + payload)

    def _write(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._file, rest) :]
        except OSError as error:
            with suppress(OSError):  # the reader stops at a cut block by itself
                os.ftruncate(self._file, self._size)
                os.lseek(self._file, self._size, os.SEEK_SET)
            raise output_error(self.path, error) from error
        self._size += len(data)

    def close(self) -> None:
        """Close the file; call once."""
        os.close(self._file)


class Journal(NamedTuple):
    """What could be read of a journal: its points in order, and whether its end was cut."""

    records: NDArray[np.float32]
    cut: bool


def read_journal(path: Path) -> Journal:
    """Read the whole blocks of a journal; a cut or damaged block ends it."""
    data = path.read_bytes()
    if len(data) < _HEADER.size or data[:8] != _MAGIC:
        return Journal(np.empty((0, 3), dtype="<f4"), True)
    columns = _HEADER.unpack_from(data)[1]
    if columns not in (3, 4):
        return Journal(np.empty((0, 3), dtype="<f4"), True)
    blocks = [np.empty((0, columns), dtype="<f4")]
    at = _HEADER.size
    while at + _BLOCK.size <= len(data):
        count, checksum = _BLOCK.unpack_from(data, at)
        begin, end = at + _BLOCK.size, at + _BLOCK.size + count * columns * 4
        if end > len(data) or zlib.crc32(data[begin:end]) != checksum:
            break
        blocks.append(np.frombuffer(data, dtype="<f4", count=count * columns, offset=begin).reshape(-1, columns))
        at = end
    return Journal(np.concatenate(blocks), at != len(data))
