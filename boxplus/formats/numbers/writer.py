"""Rows of numbers to text, a block at a time, with the fewest digits that read back as the same float64."""

from __future__ import annotations

from collections.abc import Sequence
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.numbers.formatter import LONGEST_NUMBER, format_rows
from boxplus.formats.numbers.parser import powers_of_five

_BLOCK = 8192


def rows_to_text(
    columns: Sequence[NDArray[np.int64] | NDArray[np.float64]], prefix: str = "", separator: str = "\n"
) -> tuple[memoryview, NDArray[np.int64]]:
    """The text of m rows: prefix, numbers with spaces between them, separator.

    Args:
        columns: (m, any) int64 or float64 each, side by side; one column at least.
        separator: one character.

    Returns:
        The text, and (m,) int64 where in it each row ends.
    """
    count = len(columns[0])
    parts = [np.ascontiguousarray(part, np.int64 if part.dtype.kind in "iu" else np.float64) for part in columns]
    is_whole = np.repeat([part.dtype.kind == "i" for part in parts], [part.shape[1] for part in parts])
    cells = np.hstack([part.view(np.uint64) for part in parts])
    word, mark = prefix.encode(), separator.encode()
    text = np.empty(count * (len(word) + LONGEST_NUMBER * len(is_whole)), np.uint8)
    ends = np.empty(count, np.int64)
    powers, exponents = powers_of_five()
    number = np.empty(1)
    row, at = 0, 0
    while True:
        row, at = format_rows(
            np.uint64(row),
            np.uint64(at),
            np.frombuffer(word, np.uint8),
            cells,
            is_whole,
            np.uint8(mark[0]),
            powers,
            exponents,
            text,
            ends,
            number,
            number.view(np.uint64),
        )
        if row == count:
            return text[:at].data, ends
        # A number whose digits the kernel leaves open.
        values = [value for part in parts for value in part[row].tolist()]
        line = word + " ".join(map(repr, values)).encode() + mark
        text[at : at + len(line)] = np.frombuffer(line, np.uint8)
        at += len(line)
        ends[row] = at
        row += 1


def write_rows(file: BinaryIO, prefix: str, whole: NDArray[np.int64], numbers: NDArray[np.float64]) -> None:
    """Write one line for each row: `prefix`, the (m, a) whole numbers, the (m, b) floating-point numbers; a + b ≥ 1.

    Raises:
        OSError: the file cannot be written.
    """
    for begin in range(0, len(whole), _BLOCK):
        rows = slice(begin, begin + _BLOCK)
        file.write(rows_to_text([whole[rows], numbers[rows]], prefix)[0])
