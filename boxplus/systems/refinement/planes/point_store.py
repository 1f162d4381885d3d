"""Arrays of points that need not fit into memory."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import OutputError
from boxplus.formats.output import output_error


class PointStore:
    """Takes arrays of points one after the other, and gives them back as they were; as a file where a path is given.

    Args:
        path: created anew, removed at the end; None keeps the points in memory.

    Raises:
        OutputError: the file cannot be written.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._path, self._file = path, None if path is None else _opened(path)
        self._arrays: list[NDArray[np.float32]] = []
        self._counts: list[int] = []

    def append(self, points: NDArray[np.float32]) -> None:
        """Add an array (n, 3).

        Raises:
            OutputError: the disk is full.
        """
        self._counts.append(len(points))
        if self._file is None or self._path is None:
            self._arrays.append(points)
            return
        try:
            self._file.write(np.ascontiguousarray(points, dtype=np.float32).tobytes())
        except OSError as error:
            raise output_error(self._path, error) from error

    def arrays(self) -> list[NDArray[np.float32]]:
        """All arrays so far."""
        if self._file is None or self._path is None:
            return list(self._arrays)
        try:
            self._file.flush()
        except OSError as error:
            raise output_error(self._path, error) from error
        total = sum(self._counts)
        if not total:
            return [np.zeros((0, 3), dtype=np.float32) for _ in self._counts]
        points = np.memmap(self._path, dtype=np.float32, mode="r", shape=(total, 3))
        ends = np.cumsum(self._counts)
        return [points[end - count : end] for count, end in zip(self._counts, ends.tolist(), strict=True)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close and remove the file."""
        if self._file is None or self._path is None:
            return
        try:
            self._file.close()
            self._path.unlink(missing_ok=True)
        except OSError as failure:
            if error is None:
                raise OutputError(f"cannot remove {self._path}: {failure}") from failure


def _opened(path: Path) -> BinaryIO:
    try:
        return path.open("wb")
    except OSError as error:
        raise output_error(path, error) from error
