"""What the streaming point cloud writers share: blocks of points into a temporary file, count and name at the end."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

from numpy.typing import ArrayLike

from boxplus.errors import InputError, OutputError
from boxplus.formats.output import TEMPORARY_SUFFIX, output_error
from boxplus.formats.point_cloud import as_records


class CloudWriter(ABC):
    """Streams points to a file: memory does not grow, and the file gets its name only when it is whole.

    The points go to a temporary file beside `path`. `close` writes the number of points into the header and renames it;
    leaving a `with` block by an exception removes it instead. Whether there are intensities is settled by the first block.

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
        self._file: BinaryIO | None
        try:
            self._file = self._temporary.open("wb")
        except OSError as error:
            raise output_error(self.path, error) from error

    @staticmethod
    @abstractmethod
    def header(count: int, with_intensity: bool) -> bytes:
        """The header for `count` points; its length must not depend on `count`."""

    def append(self, points: ArrayLike, intensity: ArrayLike | None = None) -> None:
        """Write a block of points.

        Args:
            points: (N, 3) [m], stored as float32.
            intensity: (N,) or None; in every block or in none.

        Raises:
            InputError: shapes that do not match, or intensities in some blocks only.
            OutputError: the disk is full or the file cannot be written; also after `close`.
        """
        records = as_records(points, intensity)
        if self._with_intensity is not None and self._with_intensity != (intensity is not None):
            raise InputError(
                "intensities in every block or in none",
                "a block with them after one without" if intensity is not None else "a block without them after one with",
                "give all blocks the same columns",
            )
        file = self._open_file()
        try:
            if self._with_intensity is None:
                self._with_intensity = intensity is not None
                file.write(self.header(0, self._with_intensity))
            file.write(records.data)
        except OSError as error:
            self.abort()
            raise output_error(self.path, error) from error
        self.count += len(records)

    def _open_file(self) -> BinaryIO:
        if self._file is None:
            raise OutputError(f"expected an open writer of {self.path} – got one that was closed – append before close()")
        return self._file

    def close(self) -> None:
        """Write the count, flush to the disk and give the file its name; safe to call twice.

        Raises:
            OutputError: the disk is full or the file cannot be written; nothing is left behind.
        """
        if self._file is None:
            return
        try:
            self._file.seek(0)
            self._file.write(self.header(self.count, bool(self._with_intensity)))
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
