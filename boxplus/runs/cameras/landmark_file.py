"""The sparse map of a run on disk, written again every few seconds."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.ply import write_ply

_EVERY_S = 10.0
_SHARE = 20.0  # of the time between two writings, by that of one


class LandmarkFile:
    """Writes `landmarks.ply` when it is due, so that a killed run leaves what was known some seconds before.

    Args:
        path: the file.
        points: (N, 3) [m], as they are known now.
    """

    def __init__(self, path: Path, points: Callable[[], NDArray[np.float32]]) -> None:
        self._path, self._points = path, points
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
            write_ply(self._path, points)
        now = time.perf_counter()
        self._due = now + max(_EVERY_S, _SHARE * (now - began))
        return now - began


class LandmarksById:
    """The last known place of every landmark of a run, 12 bytes for every id up to the largest.

    Ids count up from 0, so that a table by id is much smaller than a dictionary.
    """

    def __init__(self) -> None:
        self._points = np.full((1024, 3), np.nan, dtype=np.float32)
        self._end = 0

    def __len__(self) -> int:
        return int(np.isfinite(self._points[: self._end, 0]).sum())

    def update(self, ids: NDArray[np.int64], points: NDArray[np.float64]) -> None:
        """Take the places (n, 3) [m] of the landmarks `ids` (n,), in place of those known before."""
        self._end = max(self._end, int(ids.max(initial=-1)) + 1)
        if self._end > len(self._points):
            more = np.full((max(self._end, 2 * len(self._points)) - len(self._points), 3), np.nan, dtype=np.float32)
            self._points = np.concatenate([self._points, more])
        self._points[ids] = points

    def points(self) -> NDArray[np.float32]:
        """(n, 3) [m] in the order of their ids."""
        known = self._points[: self._end]
        return known[np.isfinite(known[:, 0])]
