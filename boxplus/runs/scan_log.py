"""One row a scan on disk: everything an estimate says besides the pose. Written as the run goes on, read by the report."""

from __future__ import annotations

import csv
import io
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError, OutputError
from boxplus.filtering.nav_state import T_BA, T_BW, T_P_L, T_THETA_L, T_V
from boxplus.formats.output import output_error
from boxplus.manifolds import quaternion
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate, Status

_SHARES = tuple(f"share_{axis}" for axis in ("rx", "ry", "rz", "px", "py", "pz"))


def _xyz(*names: str) -> tuple[str, ...]:
    return tuple(f"{name}_{axis}" for name in names for axis in "xyz")


_NUMBERS = (
    *_xyz("velocity", "bias_gyro", "bias_accel", "gravity"),
    *("imu_lidar_qw", "imu_lidar_qx", "imu_lidar_qy", "imu_lidar_qz"),
    *_xyz("imu_lidar_p", "sigma_velocity", "sigma_bias_gyro", "sigma_bias_accel", "sigma_imu_lidar_r", "sigma_imu_lidar_p"),
    *_SHARES,
    *("points_raw", "points_filtered", "points_used", "residual_rms", "iterations", "converged", "total_ms"),
)
_TEXTS = ("rejected", "timing_ms", "weak_directions", "warnings")
SCAN_COLUMNS = ("time_ns", "status", *_NUMBERS, *_TEXTS)
"""Columns of `scans.csv`. SI units (m, s, rad) but for milliseconds where the name says so; `rejected` and `timing_ms` hold
`name=value` pairs, `weak_directions` and `warnings` sentences, all separated by `; `."""


class ScanLogWriter:
    """Appends one row per estimate to `scans.csv`; each row reaches the operating system at once.

    Args:
        path: the file.
        go_on: after the rows of an earlier writer.

    Raises:
        OutputError: the file cannot be created.
    """

    def __init__(self, path: Path, *, go_on: bool = False) -> None:
        self._path = path
        try:
            flags = os.O_WRONLY | os.O_CREAT | (0 if go_on else os.O_TRUNC) | getattr(os, "O_BINARY", 0)
            self._file: int | None = os.open(path, flags, 0o644)
            self._size = os.lseek(self._file, 0, os.SEEK_END)
        except OSError as error:
            raise output_error(path, error) from error
        if not go_on:
            self._write([*SCAN_COLUMNS])

    def append(self, estimate: Estimate) -> None:
        """Write one row.

        Raises:
            OutputError: the disk is full; the row is taken back.
        """
        state, sigma = estimate.state, np.sqrt(np.maximum(estimate.covariance.diagonal(), 0.0))
        numbers = np.concatenate(
            [
                *(state.v_world_imu, state.bias_gyro, state.bias_accel, state.gravity_world),
                *(quaternion.from_matrix(state.R_imu_lidar[None])[0], state.p_imu_lidar),
                *(sigma[at : at + 3] for at in (T_V, T_BW, T_BA, T_THETA_L, T_P_L)),
                estimate.lidar_share,
                [estimate.points_raw, estimate.points_filtered, estimate.points_used, estimate.residual_rms],
                [estimate.iterations, estimate.converged, 1e3 * sum(estimate.timing_s.values())],
            ]
        )
        self._write(
            [
                *(str(estimate.time_ns), estimate.status),
                *(f"{number:.9g}" for number in numbers.tolist()),
                "; ".join(f"{reason}={count}" for reason, count in estimate.rejected.items()),
                "; ".join(f"{stage}={1e3 * seconds:.4f}" for stage, seconds in estimate.timing_s.items()),
                "; ".join(str(direction) for direction in estimate.weak_directions),
                "; ".join(estimate.warnings),
            ]
        )

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

    def __enter__(self) -> ScanLogWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()


@dataclass(frozen=True, slots=True)
class ScanLog:
    """The rows of `scans.csv` as columns of N scans.

    Attributes:
        time_ns: (N,) int64.
        status: (N,) text: ok, weak or lost.
        texts: the columns of text by name, N entries each.
    """

    time_ns: NDArray[np.int64]
    status: NDArray[np.str_]
    _numbers: NDArray[np.float64]
    texts: dict[str, list[str]]

    def __len__(self) -> int:
        return int(self.time_ns.size)

    def first(self, count: int) -> ScanLog:
        """The first rows."""
        texts = {name: entries[:count] for name, entries in self.texts.items()}
        return ScanLog(self.time_ns[:count], self.status[:count], self._numbers[:count], texts)

    def column(self, name: str) -> NDArray[np.float64]:
        """(N,) one column, or (N, 3) for the name of a vector without its axis."""
        if name in _NUMBERS:
            return self._numbers[:, _NUMBERS.index(name)]
        return np.stack([self._numbers[:, _NUMBERS.index(f"{name}_{axis}")] for axis in "xyz"], axis=1)

    @property
    def lidar_share(self) -> NDArray[np.float64]:
        """(N, 6), see `Estimate.lidar_share`."""
        first = _NUMBERS.index(_SHARES[0])
        return self._numbers[:, first : first + 6]

    def pairs(self, name: str) -> dict[str, NDArray[np.float64]]:
        """`rejected` or `timing_ms` as one (N,) column per name, zero where a row does not have it."""
        columns: dict[str, NDArray[np.float64]] = {}
        for row, text in enumerate(self.texts[name]):
            for pair in text.split("; ") if text else ():
                key, _, value = pair.rpartition("=")
                columns.setdefault(key, np.zeros(len(self)))[row] = float(value)
        return columns


def read_scan_log(path: str | Path) -> ScanLog:
    """Read `scans.csv`; a cut last row, as a killed run may leave it, is left out.

    Raises:
        InputError: not such a file.
    """
    try:
        with Path(path).open(encoding="utf-8", newline="") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError("a readable scans.csv", f"{path}: {error}", "give the output folder of 'boxplus lio'") from error
    if not rows or tuple(rows[0]) != SCAN_COLUMNS:
        raise InputError("scans.csv with the columns of this version", f"others in {path}", "run 'boxplus lio' again")
    body = [row for row in rows[1:] if len(row) == len(SCAN_COLUMNS)]
    first, texts = 2 + len(_NUMBERS), {}
    try:
        numbers = np.array([row[2:first] for row in body], dtype=np.float64).reshape(-1, len(_NUMBERS))
        time_ns = np.array([int(row[0]) for row in body], dtype=np.int64)
    except ValueError as error:
        raise InputError("numbers in scans.csv", f"{error} ({path})", "run 'boxplus lio' again") from error
    unknown = {row[1] for row in body} - set(get_args(Status))
    if unknown:
        raise InputError(
            f"a status of {', '.join(get_args(Status))} in scans.csv", f"{min(unknown)!r} ({path})", "run 'boxplus lio' again"
        )
    for offset, name in enumerate(_TEXTS):
        texts[name] = [row[first + offset] for row in body]
    return ScanLog(time_ns, np.array([row[1] for row in body], dtype=np.str_), numbers, texts)
