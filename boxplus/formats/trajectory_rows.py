"""The lines of trajectory files: numbers to text and text to numbers, for TUM, KITTI, EuRoC and boxplus' own CSV."""

from __future__ import annotations

import csv
from decimal import Decimal, InvalidOperation
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError

Format = Literal["tum", "kitti", "euroc", "csv"]

TANGENT = ("rx", "ry", "rz", "px", "py", "pz")
UPPER = np.triu_indices(6)
CSV_COLUMNS = (
    "time_ns",
    "status",
    *("px", "py", "pz", "qw", "qx", "qy", "qz"),
    *(f"cov_{TANGENT[i]}_{TANGENT[j]}" for i, j in zip(*UPPER, strict=True)),
)
"""Columns of boxplus' own CSV: the covariance as the upper triangle, row by row, rotation first [rad², rad·m, m²]."""


class Row(NamedTuple):
    """One parsed line: `rotation` is a quaternion wxyz (4 numbers) or, for KITTI, a matrix row by row (9 numbers)."""

    time_ns: int | None
    p: list[float]
    rotation: list[float]
    covariance: list[float] | None = None
    status: str | None = None


def seconds_to_ns(text: str) -> int:
    """Decimal text of seconds as integer nanoseconds, exactly: a float64 keeps no 19 digits.

    Raises:
        ValueError: not a number, or beyond the range of int64 nanoseconds (292 years).
    """
    whole, _, fraction = text.partition(".")
    if whole.isdecimal() and fraction.isdecimal() and len(whole) <= 10 and len(fraction) <= 9:  # the usual form, fast
        nanoseconds = int(whole) * 1_000_000_000 + int(fraction.ljust(9, "0"))
        if nanoseconds < 2**63:
            return nanoseconds
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise ValueError(f"{text!r} is not a number") from None
    if not seconds.is_finite():
        raise ValueError(f"{text!r} is not a finite number")
    if seconds.adjusted() > 10 or abs(nanoseconds := int(seconds.scaleb(9).to_integral_value())) >= 2**63:
        raise ValueError(f"{text} s is not a time in seconds (nanoseconds or milliseconds? divide them)")
    return nanoseconds


def ns_to_seconds(time_ns: int) -> str:
    """Integer nanoseconds as decimal seconds with nine decimals, exactly."""
    whole, fraction = divmod(abs(time_ns), 1_000_000_000)
    return f"{'-' if time_ns < 0 else ''}{whole}.{fraction:09d}"


def tum_row(time_ns: int, p: NDArray[np.float64], q_wxyz: NDArray[np.float64]) -> str:
    """`seconds tx ty tz qx qy qz qw`."""
    w, x, y, z = q_wxyz
    return f"{ns_to_seconds(time_ns)} {p[0]:.9f} {p[1]:.9f} {p[2]:.9f} {x:.9f} {y:.9f} {z:.9f} {w:.9f}\n"


def kitti_row(R: NDArray[np.float64], p: NDArray[np.float64]) -> str:
    """The first three rows of the 4×4 pose matrix, row by row."""
    return " ".join(f"{value:.9e}" for value in np.column_stack([R, p]).ravel()) + "\n"


def csv_row(
    time_ns: int, status: str, p: NDArray[np.float64], q_wxyz: NDArray[np.float64], covariance: NDArray[np.float64] | None
) -> str:
    """One line of boxplus' own CSV; a covariance that is not known is written as nan."""
    if any(character in status for character in ',"\r\n'):
        status = '"' + " ".join(status.split()).replace('"', '""') + '"'
    triangle = np.full(21, np.nan) if covariance is None else covariance[UPPER]
    numbers = ",".join([*(f"{value:.9f}" for value in (*p, *q_wxyz)), *(f"{value:.9e}" for value in triangle)])
    return f"{int(time_ns)},{status},{numbers}\n"


def parse_row(line: str, layout: Format) -> Row:
    """Read one line.

    Raises:
        ValueError: wrong number of columns, or text where a number should be.
    """
    if layout in ("tum", "kitti"):
        fields = line.split()
        wanted = 8 if layout == "tum" else 12
        if len(fields) != wanted:
            raise ValueError(f"{len(fields)} columns")
        if layout == "tum":
            x, y, z, qx, qy, qz, qw = _numbers(fields[1:])
            return Row(seconds_to_ns(fields[0]), [x, y, z], [qw, qx, qy, qz])
        m = _numbers(fields)
        return Row(None, [m[3], m[7], m[11]], m[0:3] + m[4:7] + m[8:11])
    fields = [text.strip() for text in next(csv.reader([line]))]
    if layout == "euroc":
        if len(fields) < 8:
            raise ValueError(f"{len(fields)} columns")
        numbers = _numbers(fields[1:8])
        return Row(_nanoseconds(fields[0]), numbers[:3], numbers[3:])
    if len(fields) != len(CSV_COLUMNS):
        raise ValueError(f"{len(fields)} columns")
    numbers = _numbers(fields[2:])
    return Row(_nanoseconds(fields[0]), numbers[:3], numbers[3:7], numbers[7:], fields[1])


def _numbers(fields: list[str]) -> list[float]:
    try:
        return [float(text) for text in fields]
    except ValueError as error:
        raise ValueError(f"{str(error).partition(': ')[2][:40]} is not a number") from None


def _nanoseconds(text: str) -> int:
    try:
        time_ns = int(text)
    except ValueError:
        raise ValueError(f"{text[:40]!r} is not a whole number of nanoseconds") from None
    if abs(time_ns) >= 2**63:
        raise ValueError(f"{text[:40]} ns is beyond the range of 64-bit nanoseconds")
    return time_ns


COLUMNS: dict[Format, str] = {
    "tum": "8 columns (seconds tx ty tz qx qy qz qw)",
    "kitti": "12 columns (the 3×4 pose matrix row by row)",
    "euroc": "8 or more comma-separated columns (ns, p_x, p_y, p_z, q_w, q_x, q_y, q_z, …)",
    "csv": f"{len(CSV_COLUMNS)} comma-separated columns (time_ns, status, position, quaternion wxyz, 21 covariance entries)",
}


def detect_format(first_line: str, source: str) -> Format:
    """Which format a file has, from its first line that is neither empty nor a comment.

    Raises:
        InputError: none of the known ones.
    """
    if "," in first_line:
        fields = first_line.split(",")
        if fields[0].strip() == "time_ns" or len(fields) == len(CSV_COLUMNS):
            return "csv"
        if len(fields) >= 8:
            return "euroc"
    else:
        count = len(first_line.split())
        if count == 8:
            return "tum"
        if count == 12:
            return "kitti"
    is_binary = any(character == "\ufffd" or (ord(character) < 32 and character != "\t") for character in first_line)
    raise InputError(
        "a trajectory in TUM (8 columns), KITTI (12 columns), EuRoC or boxplus CSV (comma-separated) format",
        f"binary data ({source})" if is_binary else f"the line {first_line[:60]!r} ({source})",
        "give a file in one of these formats",
    )


def is_header(line: str) -> bool:
    """Whether a comma-separated line names its columns instead of holding numbers."""
    first = line.split(",")[0].strip()
    return first[:1].isalpha()


def looks_cut(line: str, before: list[str]) -> bool:
    """Whether the last line of a file without final newline ends in the middle of a number.

    That can only be told when the lines before all end with equally many decimals and this one does not.
    """
    tails = {len(text.rstrip().rpartition(".")[2]) for text in before}
    return len(before) >= 2 and len(tails) == 1 and len(line.rstrip().rpartition(".")[2]) not in tails
