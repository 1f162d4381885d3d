"""What the streaming point cloud writers share: blocks of points into a temporary file, count and name at the end."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError, OutputError
from boxplus.formats.clouds.point_cloud import Columns, as_records
from boxplus.formats.output import TEMPORARY_SUFFIX, output_error


class CloudWriter(ABC):
    """Streams points to a file: memory does not grow, and the file gets its name only when it is whole.

    The points go to a temporary file beside `path`. `close` completes and renames it; leaving a `with` block by an exception
    removes it instead. Whether there are intensities is settled by the first block.

    Args:
        path: the file to write; one of that name is replaced.

    Raises:
        OutputError: the file cannot be created.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.count = 0
        """Points written so far."""
        self._temporary = self.path.with_name(self.path.name + TEMPORARY_SUFFIX)
        self._with_intensity: bool | None = None
        self._others: tuple[tuple[str, np.dtype[np.generic]], ...] = ()
        self._file: BinaryIO | None
        try:
            self._file = self._temporary.open("wb")
        except OSError as error:
            raise output_error(self.path, error) from error

    @abstractmethod
    def _begin(self, file: BinaryIO, with_intensity: bool) -> None:
        """Before the first block, which may not come before the end."""

    @abstractmethod
    def _write(self, file: BinaryIO, records: NDArray[np.float32], columns: Columns) -> None:
        """Write (N, 3) or (N, 4) records: x, y, z and, where there is one, the intensity; and the other columns of them."""

    @abstractmethod
    def _finish(self, file: BinaryIO) -> None:
        """After the last block: complete what the file says about itself."""

    @abstractmethod
    def holds(self, columns: Columns) -> set[str]:
        """Names of those that the format can hold as they are."""

    def append(self, points: ArrayLike, intensity: ArrayLike | None = None, columns: Columns = MappingProxyType({})) -> None:
        """Write a block of points.

        Args:
            points: (N, 3) [m], as float32.
            intensity: (N,) or None; in every block or in none.
            columns: others that the format `holds`, (N,) each; the same in every block.

        Raises:
            InputError: shapes that do not match, intensities or other columns in some blocks only.
            OutputError: the disk is full or the file cannot be written; also after `close`.
        """
        records = as_records(points, intensity)
        if self._with_intensity is not None and self._with_intensity != (intensity is not None):
            raise InputError(
                "intensities in every block or in none",
                "a block with them after one without" if intensity is not None else "a block without them after one with",
                "give all blocks the same columns",
            )
        others = tuple((name, values.dtype) for name, values in columns.items())
        if self._with_intensity is not None and others != self._others:
            raise InputError("the same columns in every block", f"{dict(others)} after {dict(self._others)}", "give all the same")
        if wrong := [name for name, values in columns.items() if values.shape != (len(records),)]:
            raise InputError(f"columns of shape ({len(records)},)", f"another of {wrong[0]!r}", "give one value per point")
        file = self._open_file()
        try:
            if self._with_intensity is None:
                self._with_intensity, self._others = intensity is not None, others
                self._begin(file, self._with_intensity)
            self._write(file, records, columns)
        except OSError as error:
            self.abort()
            raise output_error(self.path, error) from error
        self.count += len(records)

    @contextmanager
    def _explained(self, kind: type[Exception]) -> Iterator[None]:
        """The error that a library has of its own for what the disk says becomes ours, and nothing is left behind."""
        try:
            yield
        except kind as error:
            self.abort()
            raise OutputError(f"expected to write {self.path} – got {error} – check the disk and the folder") from error

    def _open_file(self) -> BinaryIO:
        if self._file is None:
            raise OutputError(f"expected an open writer of {self.path} – got one that was closed – append before close()")
        return self._file

    def close(self) -> None:
        """Complete the file, flush it to the disk and give it its name; safe to call twice.

        Raises:
            OutputError: the disk is full or the file cannot be written; nothing is left behind.
        """
        if self._file is None:
            return
        try:
            if self._with_intensity is None:
                self._with_intensity = False
                self._begin(self._file, False)
            self._finish(self._file)
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            os.replace(self._temporary, self.path)
        except OSError as error:
            self.abort()
            raise output_error(self.path, error) from error
        self._file = None

    def abort(self) -> None:
        """Remove what was written; the name stays free, or keeps the file it had before."""
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
            with suppress(OSError):
                self._temporary.unlink()
            self._file = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        if error is None:
            self.close()
        else:
            self.abort()


class RecordWriter(CloudWriter):
    """Files that are a header and then the records as they lie in memory."""

    @staticmethod
    @abstractmethod
    def header(count: int, fields: Sequence[tuple[str, np.dtype[np.generic]]]) -> bytes:
        """The header for `count` points with these columns; its length must not depend on `count`."""

    def packed(self, columns: Columns) -> Columns:
        """The columns as the file has them."""
        return columns

    def _begin(self, file: BinaryIO, with_intensity: bool) -> None:
        self._fields: list[tuple[str, np.dtype[Any]]] = [
            (name, np.dtype("<f4")) for name in ("x", "y", "z", "intensity")[: 3 + with_intensity]
        ]
        empty = {name: np.empty(0, kind) for name, kind in self._others}
        self._fields += [(name, values.dtype.newbyteorder("<")) for name, values in self.packed(empty).items()]
        file.write(self.header(0, self._fields))

    def _write(self, file: BinaryIO, records: NDArray[np.float32], columns: Columns) -> None:
        if not columns:
            file.write(records.data)
            return
        table = np.empty(len(records), np.dtype(self._fields))
        for number, (name, _) in enumerate(self._fields[: records.shape[1]]):
            table[name] = records[:, number]
        for name, values in self.packed(columns).items():
            table[name] = values
        file.write(table.tobytes())

    def _finish(self, file: BinaryIO) -> None:
        file.seek(0)
        file.write(self.header(self.count, self._fields))
