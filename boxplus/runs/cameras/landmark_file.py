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
