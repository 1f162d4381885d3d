"""Tables on disk: rows of text appended while a run goes on, read back as columns by the report."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError, OutputError
from boxplus.formats.output import output_error


@dataclass(frozen=True, slots=True)
class Columns:
    """The columns of a table: `time_ns`, `status`, numbers, texts.

    Attributes:
        numbers, texts: their names.
        statuses: what `status` may say.
        program: who writes the table, for messages.
    """

    numbers: tuple[str, ...]
    texts: tuple[str, ...]
    statuses: tuple[str, ...]
    program: str

    @property
    def names(self) -> tuple[str, ...]:
        """All of them, in order."""
        return ("time_ns", "status", *self.numbers, *self.texts)


def xyz(*names: str) -> tuple[str, ...]:
    """The columns of vectors."""
    return tuple(f"{name}_{axis}" for name in names for axis in "xyz")


class RowLogWriter:
    """Appends rows to a CSV file; each reaches the operating system at once.

    Args:
        path: the file.
        columns: of the table.
        go_on: after the rows of an earlier writer.

    Raises:
        OutputError: the file cannot be created.
    """

    def __init__(self, path: Path, columns: Columns, *, go_on: bool = False) -> None:
        self._path = path
        try:
            flags = os.O_WRONLY | os.O_CREAT | (0 if go_on else os.O_TRUNC) | getattr(os, "O_BINARY", 0)
            self._file: int | None = os.open(path, flags, 0o644)
            self._size = os.lseek(self._file, 0, os.SEEK_END)
        except OSError as error:
            raise output_error(path, error) from error
        if not go_on:
            self._write([*columns.names])

    def append_row(self, time_ns: int, status: str, numbers: Sequence[float], texts: Sequence[str]) -> None:
        """Write one row.

        Raises:
            OutputError: the disk is full; the row is taken back.
        """
        self._write([str(time_ns), status, *(f"{number:.9g}" for number in numbers), *texts])

    def _write(self, row: list[str]) -> None:
        if self._file is None:
            raise OutputError(f"expected an open {self._path.name} – got one that was closed – append before close()")
        line = io.StringIO()
        csv.writer(line, lineterminator="\n").writerow(row)
        rest = memoryview(line.getvalue().encode())
        size = self._size + len(rest)
        try:
            while rest:
                rest = rest[os.write(self._file, rest) :]
        except OSError as error:
            with suppress(OSError):  # the reader leaves out a cut last row by itself
                os.ftruncate(self._file, self._size)
                os.lseek(self._file, self._size, os.SEEK_SET)
            raise output_error(self._path, error) from error
        self._size = size

    def close(self) -> None:
        """Close the file; safe to call twice."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()


@dataclass(frozen=True, slots=True)
class RowLog:
    """A table as columns of N rows.

    Attributes:
        time_ns: (N,) int64.
        status: (N,) text.
        texts: the columns of text by name, N entries each.
        columns: their names.
    """

    time_ns: NDArray[np.int64]
    status: NDArray[np.str_]
    _numbers: NDArray[np.float64]
    texts: dict[str, list[str]]
    columns: Columns

    def __len__(self) -> int:
        return int(self.time_ns.size)

    def first(self, count: int) -> RowLog:
        """The first rows."""
        texts = {name: entries[:count] for name, entries in self.texts.items()}
        return RowLog(self.time_ns[:count], self.status[:count], self._numbers[:count], texts, self.columns)

    def column(self, name: str) -> NDArray[np.float64]:
        """(N,) one column, or (N, 3) for the name of a vector without its axis."""
        if name in self.columns.numbers:
            return self._numbers[:, self.columns.numbers.index(name)]
        return np.stack([self._numbers[:, self.columns.numbers.index(f"{name}_{axis}")] for axis in "xyz"], axis=1)

    def matrix(self, names: Sequence[str]) -> NDArray[np.float64]:
        """(N, k) columns side by side."""
        return self._numbers[:, [self.columns.numbers.index(name) for name in names]]

    def pairs(self, name: str) -> dict[str, NDArray[np.float64]]:
        """A text column of `name=value` pairs as one (N,) column per name, zero where a row does not have it."""
        columns: dict[str, NDArray[np.float64]] = {}
        for row, text in enumerate(self.texts[name]):
            for pair in text.split("; ") if text else ():
                key, _, value = pair.rpartition("=")
                columns.setdefault(key, np.zeros(len(self)))[row] = float(value)
        return columns


def read_row_log(path: str | Path, columns: Columns) -> RowLog:
    """Read a table; a cut last row, as a killed run may leave it, is left out.

    Raises:
        InputError: not such a file.
    """
    again, name = f"run '{columns.program}' again", Path(path).name
    try:
        with Path(path).open(encoding="utf-8", newline="") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"a readable {name}", f"{path}: {error}", f"give the output folder of '{columns.program}'") from error
    if not rows or tuple(rows[0]) != columns.names:
        raise InputError(f"{name} with the columns of this version", f"others in {path}", again)
    body = [row for row in rows[1:] if len(row) == len(columns.names)]
    first = 2 + len(columns.numbers)
    try:
        numbers = np.array([row[2:first] for row in body], dtype=np.float64).reshape(-1, len(columns.numbers))
        time_ns = np.array([int(row[0]) for row in body], dtype=np.int64)
    except ValueError as error:
        raise InputError(f"numbers in {name}", f"{error} ({path})", again) from error
    unknown = {row[1] for row in body} - set(columns.statuses)
    if unknown:
        raise InputError(f"a status of {', '.join(columns.statuses)} in {name}", f"{min(unknown)!r} ({path})", again)
    texts = {text: [row[first + offset] for row in body] for offset, text in enumerate(columns.texts)}
    return RowLog(time_ns, np.array([row[1] for row in body], dtype=np.str_), numbers, texts, columns)
