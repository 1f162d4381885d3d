"""The text that bundle adjustment problems come in: counts, then observations, then cameras and points, number by number."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_path
from boxplus.errors import InputError
from boxplus.formats.numbers.lines import NumberLines, read_number_lines
from boxplus.formats.numbers.parser import OTHER

_OBSERVATION = "an observation: camera index, point index, x, y"
_ADVICE = "correct the line, or check that no line before it is missing"


class BalNumbers(NamedTuple):
    """What such a file holds; k observations, m cameras, n points."""

    header: NDArray[np.float64]  # the numbers of the second line, where the format has one
    camera_of: NDArray[np.int64]  # (k,)
    point_of: NDArray[np.int64]  # (k,)
    pixels: NDArray[np.float64]  # (k, 2)
    cameras: NDArray[np.float64]  # (m, size of a camera)
    points: NDArray[np.float64]  # (n, 3)


def read_bal_text(path: str | Path, camera_size: int, header: str = "", header_size: int = 0) -> BalNumbers:
    """Read such a file, plain or bzip2.

    Args:
        path: the file.
        camera_size: parameters of a camera.
        header, header_size: what the second line says and how many numbers it has; 0 where the format has no such line.

    Raises:
        InputError: a malformed line, an index out of range, a value that is not finite, fewer or more numbers than the
            first line promises; the message names file and line.
    """
    source = as_path(path, "a reconstruction")
    state = _State(source, camera_size, header, header_size)
    for chunk in read_number_lines(source):
        state.read(chunk)
    return state.finish()


class _State:
    """How far the reading has come."""

    def __init__(self, source: Path, camera_size: int, header: str, header_size: int) -> None:
        self._source = source
        self._camera_size = camera_size
        self._header_text, self._header_size = header, header_size
        self._counts: list[int] = []
        self._header: NDArray[np.float64] | None = None if header_size else np.empty(0)
        self._camera_of: list[NDArray[np.int64]] = []
        self._point_of: list[NDArray[np.int64]] = []
        self._pixels: list[NDArray[np.float64]] = []
        self._parameters: list[NDArray[np.float64]] = []
        self._observed = 0
        self._known = 0
        self._line = 0

    def read(self, chunk: NumberLines) -> None:
        """Take the lines of a chunk."""
        rows = np.flatnonzero(chunk.count > 0)
        if not rows.size:
            return
        self._line = int(chunk.number[rows[-1]])
        if not self._counts:
            self._read_counts(chunk, rows[:1])
            rows = rows[1:]
        if self._header is None and rows.size:
            self._header = chunk.table(rows[:1], self._header_size, self._header_text, _ADVICE)[0]
            self._refuse_not_finite(chunk, rows[:1], self._header[None])
            rows = rows[1:]
        due = min(self._counts[2] - self._observed, len(rows))
        if due:
            self._read_observations(chunk, rows[:due])
        if due < len(rows):
            self._read_parameters(chunk, rows[due:])

    def _read_counts(self, chunk: NumberLines, row: NDArray[np.intp]) -> None:
        expected = "the numbers of cameras, points and observations"
        table = chunk.table(row, 3, expected, "check that this is a bundle adjustment file", whole=[0, 1, 2])
        if (table < 1).any():
            chunk.fail(int(row[0]), "at least one camera, point and observation", "check that this is a bundle adjustment file")
        self._counts = [int(count) for count in table[0]]

    def _read_observations(self, chunk: NumberLines, rows: NDArray[np.intp]) -> None:
        table = chunk.table(rows, 4, _OBSERVATION, _ADVICE, whole=[0, 1])
        camera_of, point_of = chunk.column(rows, 0), chunk.column(rows, 1)
        for index, count, name in ((camera_of, self._counts[0], "camera"), (point_of, self._counts[1], "point")):
            bad = np.flatnonzero((index < 0) | (index >= count))
            if bad.size:
                chunk.fail(int(rows[bad[0]]), f"a {name} index from 0 to {count - 1}", "check the counts in the first line")
        self._refuse_not_finite(chunk, rows, table[:, 2:])
        self._camera_of.append(camera_of)
        self._point_of.append(point_of)
        self._pixels.append(table[:, 2:].copy())
        self._observed += len(rows)

    def _read_parameters(self, chunk: NumberLines, rows: NDArray[np.intp]) -> None:
        begin = int(chunk.first[rows[0]])
        values = chunk.values[begin:].copy()
        bad = np.flatnonzero((chunk.kinds[begin:] == OTHER) | ~np.isfinite(values))
        if bad.size:
            row = int(rows[np.searchsorted(chunk.first[rows], begin + bad[0], side="right") - 1])
            chunk.fail(row, "finite parameters of cameras and points", "correct the number")
        promised = self._promised()
        if self._known + len(values) > promised:
            row = int(rows[np.searchsorted(chunk.first[rows], begin + promised - self._known, side="right") - 1])
            chunk.fail(
                row,
                f"no more than {promised} numbers after the observations",
                "check the counts in the first line and the format",
            )
        self._parameters.append(values)
        self._known += len(values)

    def _promised(self) -> int:
        return self._camera_size * self._counts[0] + 3 * self._counts[1]

    def _refuse_not_finite(self, chunk: NumberLines, rows: NDArray[np.intp], values: NDArray[np.float64]) -> None:
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if bad.size:
            chunk.fail(int(rows[bad[0]]), "finite numbers", "remove the observation, and lower the count in the first line")

    def finish(self) -> BalNumbers:
        """All that was read, if it is all that was promised."""
        if not self._counts:
            raise InputError("a bundle adjustment file", f"an empty one ({self._source})", "check the path")
        cameras, points, observations = self._counts
        if self._observed < observations or self._known < self._promised():
            if self._observed < observations:
                expected, got = f"{observations} observations", f"{self._observed}"
            else:
                expected = f"{self._camera_size}·{cameras} + 3·{points} = {self._promised()} numbers after the observations"
                got = f"{self._known}"
            raise InputError(
                expected, f"{got}, then the end ({self._source}, line {self._line})", "the file was cut: copy it again"
            )
        parameters = np.concatenate(self._parameters)
        split = self._camera_size * cameras
        return BalNumbers(
            np.empty(0) if self._header is None else self._header,
            np.concatenate(self._camera_of),
            np.concatenate(self._point_of),
            np.concatenate(self._pixels),
            parameters[:split].reshape(cameras, self._camera_size),
            parameters[split:].reshape(points, 3),
        )
