"""The sparse map of a run on disk, points and lines, written again every few seconds."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.clouds.ply import write_ply
from boxplus.formats.output import atomic_file

_EVERY_S = 10.0
_LINE_COLUMNS = "x_first,y_first,z_first,x_last,y_last,z_last"
_SHARE = 20.0  # of the time between two writings, by that of one


class LandmarkFile:
    """Writes the map when it is due, so that a killed run leaves what was known some seconds before.

    Args:
        path: the file.
        points: (N, 3) [m], as they are known now, or (N, 6) ends of lines.
        write: how.
    """

    def __init__(
        self,
        path: Path,
        points: Callable[[], NDArray[np.float32]],
        write: Callable[[Path, NDArray[np.float32]], None] = write_ply,
    ) -> None:
        self._path, self._points, self._write = path, points, write
        self._due = time.perf_counter() + _EVERY_S

    def write_if_due(self) -> float:
        """Returns the time that it took [s]."""
        return self.write() if time.perf_counter() > self._due else 0.0

    def write(self) -> float:
        """Returns the time that it took [s].

        Raises:
            OutputError: the file cannot be written; the one before stays.
        """
        began, points = time.perf_counter(), self._points()
        if len(points):
            self._write(self._path, points)
        now = time.perf_counter()
        self._due = now + max(_EVERY_S, _SHARE * (now - began))
        return now - began


def write_lines(path: Path, ends: NDArray[np.float32]) -> None:
    """Write lines by their ends (N, 6) [m] as CSV.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_file(path) as file:
        file.write((_LINE_COLUMNS + "\n").encode())
        file.writelines((",".join(f"{value:.4f}" for value in row) + "\n").encode() for row in ends.tolist())


def read_lines(path: Path) -> NDArray[np.float32]:
    """The ends (N, 6) [m] of the lines in `lines.csv`.

    Raises:
        InputError: not such a file.
    """
    try:
        head, *rows = path.read_text(encoding="utf-8").splitlines()
        ends = np.array([[float(value) for value in row.split(",")] for row in rows], dtype=np.float32).reshape(-1, 6)
    except (OSError, ValueError) as error:
        raise InputError("lines by their ends, six numbers each", f"{path}: {error}", "run 'boxplus vio --lines' again") from None
    if head != _LINE_COLUMNS:
        raise InputError(_LINE_COLUMNS, f"{path} with {head[:80]!r}", "run 'boxplus vio --lines' again")
    return ends


class LandmarksById:
    """The last known place of every landmark of a run, 4 bytes a number for every id up to the largest.

    Ids count up from 0, so that a table by id is much smaller than a dictionary.

    Args:
        size: numbers of a place, 6 for both ends of a line.
    """

    def __init__(self, size: int = 3) -> None:
        self._points = np.full((1024, size), np.nan, dtype=np.float32)
        self._end = 0

    def __len__(self) -> int:
        return int(np.isfinite(self._points[: self._end, 0]).sum())

    def update(self, ids: NDArray[np.int64], points: NDArray[np.float64]) -> None:
        """Take the places (n, size) [m] of the landmarks `ids` (n,), in place of those known before."""
        self._end = max(self._end, int(ids.max(initial=-1)) + 1)
        if self._end > len(self._points):
            more = np.full(
                (max(self._end, 2 * len(self._points)) - len(self._points), self._points.shape[1]), np.nan, dtype=np.float32
            )
            self._points = np.concatenate([self._points, more])
        self._points[ids] = points

    def points(self) -> NDArray[np.float32]:
        """(n, size) [m] in the order of their ids."""
        known = self._points[: self._end]
        return known[np.isfinite(known[:, 0])]
