"""Rows of numbers to text, a block at a time, with the fewest digits that read back as the same float64."""

from __future__ import annotations

from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

_BLOCK = 4096


def write_rows(file: BinaryIO, prefix: str, whole: NDArray[np.int64], numbers: NDArray[np.float64]) -> None:
    """Write one line for each row: `prefix`, the (m, a) whole numbers, the (m, b) floating-point numbers.

    Raises:
        OSError: the file cannot be written.
    """
    columns = ["%d"] * whole.shape[1] + ["%r"] * numbers.shape[1]
    line = prefix.replace("%", "%%") + " ".join(columns) + "\n"
    for begin in range(0, len(whole), _BLOCK):
        integers, reals = whole[begin : begin + _BLOCK].tolist(), numbers[begin : begin + _BLOCK].tolist()
        values = [value for pair in zip(integers, reals, strict=True) for part in pair for value in part]
        file.write((line * len(integers) % tuple(values)).encode())
