"""Rows of numbers to text, a block at a time, with the fewest digits that read back as the same float64."""

from __future__ import annotations

from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.number_formatter import LONGEST_NUMBER, format_rows
from boxplus.formats.number_parser import powers_of_five

_BLOCK_BYTES = 1 << 20


def write_rows(file: BinaryIO, prefix: str, whole: NDArray[np.int64], numbers: NDArray[np.float64]) -> None:
    """Write one line for each row: `prefix`, the (m, a) whole numbers, the (m, b) floating-point numbers; a + b ≥ 1.

    Raises:
        OSError: the file cannot be written.
    """
    word = np.frombuffer(prefix.encode(), np.uint8)
    longest = len(word) + LONGEST_NUMBER * (whole.shape[1] + numbers.shape[1])
    block = max(1, _BLOCK_BYTES // longest)
    text = np.empty(block * longest, np.uint8)
    powers, exponents = powers_of_five()
    number = np.empty(1)
    for begin in range(0, len(whole), block):
        integers = np.ascontiguousarray(whole[begin : begin + block], np.int64)
        reals = np.ascontiguousarray(numbers[begin : begin + block], np.float64)
        done = 0
        while done < len(integers):
            stop, size = format_rows(
                np.uint64(done), word, integers, reals.view(np.uint64), powers, exponents, text, number, number.view(np.uint64)
            )
            file.write(text[:size].data)
            done = int(stop)
            if done < len(integers):
                values = [*map(str, integers[done].tolist()), *map(repr, reals[done].tolist())]
                file.write((prefix + " ".join(values) + "\n").encode())
                done += 1
