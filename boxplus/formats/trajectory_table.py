"""Trajectory files of numbers in columns (TUM, KITTI), read at the speed of the disk where nothing is wrong with them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.formats.numbers.lines import NumberLines, read_number_lines
from boxplus.formats.numbers.parser import OTHER
from boxplus.formats.trajectory_rows import Format, seconds_to_ns

WIDTHS: dict[int, Literal["tum", "kitti"]] = {8: "tum", 12: "kitti"}
_POINT, _ZERO, _NINE, _SPACE = np.uint8(46), np.uint8(48), np.uint8(57), np.uint8(32)
_ONE = np.uint64(1)
_OPEN = np.int64(-(2**63))  # no stamp: int64 has one negative number more


class Table(NamedTuple):
    """What a file holds: `values` (N, 8) or (N, 12) as they stand, `time_ns` (N,) from TUM's first column, line numbers (N,)."""

    layout: Format
    values: NDArray[np.float64]
    time_ns: NDArray[np.int64] | None
    lines: NDArray[np.int64]


def read_table(path: Path, format: Format | Literal["auto"]) -> Table | None:
    """Read a TUM or KITTI file.

    Args:
        path: the file.
        format: the layout, or `auto`: by the number of columns.

    Returns:
        None for every file that is not whole text of as many numbers in every line, ended by a newline: such a one has to be
        read line by line, which finds out what is wrong with it.
    """
    if format not in ("auto", "tum", "kitti") or not _ends_with_newline(path):
        return None
    width = 0
    values, times, numbers = [], [], []
    try:
        for lines in read_number_lines(path):
            filled = np.flatnonzero(lines.count)
            if not len(filled):
                continue
            width = width or int(lines.count[filled[0]])
            if WIDTHS.get(width) not in (("tum", "kitti") if format == "auto" else (format,)):
                return None
            if (lines.count[filled] != width).any() or (lines.kinds == OTHER).any():
                return None
            values.append(lines.values.reshape(-1, width).copy())
            numbers.append(lines.number[filled])
            if width == 8:
                times.append(_stamps(lines, lines.first[filled]))
    except (InputError, ValueError):
        return None
    if not values:
        return None
    stamps = np.concatenate(times) if width == 8 else None
    return Table(WIDTHS[width], np.concatenate(values), stamps, np.concatenate(numbers))


def _ends_with_newline(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            if file.read(3) == b"BZh" or not file.seek(0, os.SEEK_END):
                return False
            file.seek(-1, os.SEEK_END)
            return file.read(1) == b"\n"
    except OSError:
        return False


def _stamps(lines: NumberLines, tokens: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Tokens as nanoseconds, digit by digit.

    Raises:
        ValueError: one that is no time in seconds.
    """
    found = np.empty(len(tokens), np.int64)
    begins = lines.begins[tokens]
    seconds_as_ns(np.frombuffer(lines.text, np.uint8), begins, found)
    for row in np.flatnonzero(found == _OPEN):
        word = bytes(lines.text[begins[row] : begins[row] + 64]).split(None, 1)[0]
        found[row] = seconds_to_ns(word.decode())
    return found


@kernel
def seconds_as_ns(text: NDArray[np.uint8], begins: NDArray[np.uint32], found: NDArray[np.int64]) -> None:
    """Decimal seconds that begin at `begins` as integer nanoseconds.

    Of the usual form: at most ten digits, a point, at most nine digits. Others are left open: the most negative int64.
    """
    for row in range(np.uint64(len(begins))):
        at = np.uint64(begins[row])
        whole, fraction, digits, decimals = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
        while text[at] >= _ZERO and text[at] <= _NINE and digits < 11:
            whole = whole * 10 + np.int64(text[at] - _ZERO)
            digits += 1
            at += _ONE
        if text[at] == _POINT:
            at += _ONE
            while text[at] >= _ZERO and text[at] <= _NINE and decimals < 10:
                fraction = fraction * 10 + np.int64(text[at] - _ZERO)
                decimals += 1
                at += _ONE
        if digits == 0 or digits > 10 or decimals > 9 or text[at] > _SPACE or whole > 9_223_372_035:
            found[row] = _OPEN
            continue
        for _ in range(9 - decimals):
            fraction *= 10
        found[row] = whole * 1_000_000_000 + fraction
