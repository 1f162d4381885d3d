"""A trajectory: stamped poses, checked once, and the plain files that carry them (TUM, KITTI, EuRoC, boxplus CSV)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import InitVar, dataclass, replace
from pathlib import Path
from typing import Literal, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._arguments import as_path, require
from boxplus._numbers import as_array, as_floats
from boxplus._words import either
from boxplus.errors import InputError
from boxplus.formats.numbers.lines import refuse_binary
from boxplus.formats.output import atomic_file
from boxplus.formats.trajectory_rows import (
    COLUMNS,
    CSV_COLUMNS,
    UPPER,
    Format,
    Row,
    csv_row,
    detect_format,
    is_header,
    kitti_row,
    looks_cut,
    parse_row,
    tum_row,
)
from boxplus.formats.trajectory_table import Table, read_table
from boxplus.manifolds import quaternion

QUATERNION_TOLERANCE = 1e-2
"""Largest |‖q‖ − 1| that is taken for rounding (files carry four to nine digits) and normalised away."""


@dataclass(frozen=True, slots=True)
class Trajectory:
    """N poses `T_world_body` in order of time.

    Attributes:
        time_ns: (N,) int64, absolute time, strictly increasing; None for formats without stamps (KITTI).
        p: (N, 3) float64, position of the body in the world frame [m].
        q_wxyz: (N, 4) float64, unit Hamilton quaternions of `R_world_body`.
        covariance: (N, 6, 6) float64 or None, of the pose error, rotation first [rad², rad·m, m²].
        status: N words or None, the estimator's verdict on each pose.
        matrices: (N, 3, 3) the rotations digit by digit as a KITTI file has them, or None; `q_wxyz` is the same, normalised.
        source: where the poses come from; error messages begin with it.
        warnings: what the reader had to leave out, one sentence each.

    Raises:
        InputError: on construction, when shapes do not match, a value is not finite, a quaternion is not of unit length
            (within 1e-2; closer ones are normalised) or the times do not increase. The message names source and line.

    Example:
        >>> way = bp.Trajectory(np.array([0, 10**9]), np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.array([[1.0, 0, 0, 0]] * 2))
        >>> len(way.p), way.status
        (2, None)
    """

    time_ns: NDArray[np.int64] | None
    p: NDArray[np.float64]
    q_wxyz: NDArray[np.float64]
    covariance: NDArray[np.float64] | None = None
    status: tuple[str, ...] | None = None
    matrices: NDArray[np.float64] | None = None
    source: str = "trajectory"
    warnings: tuple[str, ...] = ()
    lines: InitVar[ArrayLike | None] = None

    def __post_init__(self, lines: ArrayLike | None) -> None:
        numbers = None if lines is None else np.asarray(lines)

        def where(row: int) -> str:
            return f"{self.source}, " + (f"row {row}" if numbers is None else f"line {numbers[row]}")

        p = _array(self.p, (None, 3), "positions p", self.source)
        count = len(p)
        q = _array(self.q_wxyz, (count, 4), "quaternions q_wxyz", self.source)
        for name, values in (("position", p), ("quaternion", q)):
            bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
            if bad.size:
                got = f"{values[bad[0]]} ({where(int(bad[0]))})"
                rows = either(bad.size, "the row", f"the {bad.size} rows")
                raise InputError(f"a finite {name}", got, f"remove {rows} with NaN or infinity")
        norm = np.linalg.norm(q, axis=1)
        bad = np.flatnonzero(np.abs(norm - 1.0) > QUATERNION_TOLERANCE)
        if bad.size:
            raise InputError(
                "unit quaternions",
                f"length {norm[bad[0]]:.6g} ({where(int(bad[0]))}; {bad.size} such rows)",
                "check the order of the columns, and that they are quaternions",
            )
        object.__setattr__(self, "p", p)
        object.__setattr__(self, "q_wxyz", q / norm[:, None])
        if self.time_ns is not None:
            object.__setattr__(self, "time_ns", _times(self.time_ns, count, self.source, where))
        if self.covariance is not None:
            object.__setattr__(self, "covariance", _array(self.covariance, (count, 6, 6), "covariances", self.source))
        if self.matrices is not None:
            object.__setattr__(self, "matrices", _array(self.matrices, (count, 3, 3), "rotation matrices", self.source))
        if self.status is not None and len(self.status) != count:
            raise InputError(f"{count} status words, one per pose", f"{len(self.status)} ({self.source})", "give one per pose")

    def __len__(self) -> int:
        return len(self.p)

    @property
    def times(self) -> NDArray[np.int64]:
        """The (N,) int64 time stamps [ns].

        Raises:
            InputError: the trajectory has none (KITTI format).
        """
        if self.time_ns is None:
            raise InputError("a trajectory with time stamps", f"{self.source} without", "use TUM, EuRoC or CSV, which carry time")
        return self.time_ns

    @property
    def R(self) -> NDArray[np.float64]:
        """(N, 3, 3) rotation matrices `R_world_body`; those of a KITTI file are orthonormal up to the digits it has."""
        return quaternion.to_matrix(self.q_wxyz) if self.matrices is None else self.matrices

    @property
    def duration_s(self) -> float:
        """Time from the first to the last pose [s]; 0 without time stamps."""
        return 0.0 if self.time_ns is None or len(self) == 0 else float(self.time_ns[-1] - self.time_ns[0]) * 1e-9

    @property
    def path_length_m(self) -> float:
        """Sum of the distances between consecutive positions [m]."""
        return float(np.linalg.norm(np.diff(self.p, axis=0), axis=1).sum())

    def select(self, index: NDArray[np.intp], time_ns: NDArray[np.int64] | None = None) -> Trajectory:
        """The poses at `index` (increasing), as a trajectory of their own; with other stamps, where `time_ns` gives them."""
        if time_ns is None and self.time_ns is not None:
            time_ns = self.time_ns[index]
        return replace(
            self,
            time_ns=time_ns,
            p=self.p[index],
            q_wxyz=self.q_wxyz[index],
            covariance=None if self.covariance is None else self.covariance[index],
            status=None if self.status is None else tuple(self.status[i] for i in index),
            matrices=None if self.matrices is None else self.matrices[index],
            lines=None,
        )


def _array(values: ArrayLike, shape: tuple[int | None, ...], name: str, source: str) -> NDArray[np.float64]:
    array = np.ascontiguousarray(as_floats(values, name))
    if array.ndim != len(shape) or any(want not in (None, have) for want, have in zip(shape, array.shape, strict=True)):
        expected = "(" + ", ".join("N" if want is None else str(want) for want in shape) + ")"
        raise InputError(f"{name} of shape {expected}", f"shape {array.shape} ({source})", "give one row per pose")
    return array


def _times(time_ns: ArrayLike, count: int, source: str, where: Callable[[int], str]) -> NDArray[np.int64]:
    time = as_array(time_ns, "time_ns")
    if time.shape != (count,) or (time.dtype.kind not in "iu" and count):
        raise InputError(
            f"time_ns as integer nanoseconds of shape ({count},)",
            f"{time.dtype} of shape {time.shape} ({source})",
            "convert seconds with np.round(seconds * 1e9).astype(np.int64)",
        )
    time = np.ascontiguousarray(time, dtype=np.int64)
    steps = np.diff(time)
    backward = np.flatnonzero(steps <= 0)
    if backward.size:
        row = int(backward[0]) + 1
        raise InputError(
            "strictly increasing time stamps",
            f"a step of {steps[row - 1] * 1e-9:.9f} s ({where(row)}; {backward.size} such steps)",
            "sort the poses and remove repeated ones, or split the file when it holds more than one trajectory",
        )
    return time


def read_trajectory(path: str | Path, format: Format | Literal["auto"] = "auto") -> Trajectory:
    """Read a trajectory file.

    TUM stamps are read as integers from their decimal text, so that no digit is lost. A last line that was cut by the
    end of a run (incomplete, without newline) and poses that repeat the stamp before them are left out and named in
    `Trajectory.warnings`.

    Args:
        path: the file.
        format: `tum` (seconds, position, quaternion xyzw), `kitti` (3×4 matrices, no time), `euroc` (ground-truth csv:
            nanoseconds, position, quaternion wxyz), `csv` (boxplus' own), or `auto`: by the number of columns.

    Raises:
        InputError: the file is missing, empty, not text, or a line is malformed; the message names file and line.

    Example:
        >>> truth = bp.read_trajectory("flight.gt.tum")  # the format is told by the columns
        >>> truth.p.shape[1], bool((np.diff(truth.time_ns) > 0).all())
        (3, True)
    """
    path = as_path(path, "a trajectory")
    table = read_table(path, format)
    if table is not None:
        return _of_table(table, str(path))
    lines, complete = _read_lines(path)
    rows = [(number, line) for number, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")]
    if rows and format != "kitti" and is_header(rows[0][1]):
        layout = detect_format(rows[0][1], str(path)) if format == "auto" else format
        rows = rows[1:]
    else:
        layout = detect_format(rows[0][1], str(path)) if rows and format == "auto" else cast(Format, format)
    parsed, numbers, warnings = [], [], []
    for at, (number, line) in enumerate(rows):
        last = not complete and number == len(lines)
        try:
            row = parse_row(line, layout)
            cut = last and looks_cut(line, [text for _, text in rows[max(0, at - 8) : at]])
        except ValueError as error:
            if not last:
                raise InputError(
                    COLUMNS[layout], f"{error} ({path}, line {number})", f"correct the line, or name another format than {layout}"
                ) from None
            cut = True
        if cut:
            warnings.append(f"the last line of {path} (line {number}) is incomplete and was left out: its run was interrupted")
        else:
            parsed.append(row)
            numbers.append(number)
    if not parsed:
        raise InputError("a trajectory with at least one pose", f"none ({path})", "check the run that should have written it")
    return _of_rows(parsed, numbers, layout, str(path), tuple(warnings))


def _read_lines(path: Path) -> tuple[list[str], bool]:
    """All lines of a text file, and whether the last one was ended by a newline."""
    try:
        with path.open("rb") as file:
            head = file.read(4096)
            # A run that was killed may have left zeros behind its last line.
            refuse_binary(head if b"\n" not in head.split(b"\0")[0] else b"", path, "a text file with one pose a line")
            data = head + file.read()
    except OSError as error:
        raise InputError("a readable trajectory file", f"{path}: {error.strerror}", "check the path") from error
    text = data.decode("utf-8-sig", errors="replace")
    lines = text.splitlines()
    return lines, not lines or (text[-1] in "\r\n" and "\0" not in lines[-1])


def _of_table(table: Table, source: str) -> Trajectory:
    values = table.values
    if table.layout == "kitti":
        rotation, p = values.reshape(-1, 3, 4)[:, :, :3], values[:, 3::4]
    else:
        rotation, p = values[:, [7, 4, 5, 6]], values[:, 1:4]
    return _assemble(table.time_ns, p, rotation, table.lines, source, ())


def _of_rows(rows: list[Row], numbers: list[int], layout: Format, source: str, warnings: tuple[str, ...]) -> Trajectory:
    time_ns = None if layout == "kitti" else np.array([row.time_ns for row in rows], dtype=np.int64)
    p = np.array([row.p for row in rows], dtype=np.float64)
    rotation = np.array([row.rotation for row in rows], dtype=np.float64)
    if layout == "kitti":
        rotation = rotation.reshape(-1, 3, 3)
    if layout != "csv":
        return _assemble(time_ns, p, rotation, np.array(numbers), source, warnings)
    covariance = np.empty((len(rows), 6, 6))
    covariance[:, UPPER[0], UPPER[1]] = covariance[:, UPPER[1], UPPER[0]] = [row.covariance for row in rows]
    return _assemble(
        time_ns, p, rotation, np.array(numbers), source, warnings,
        None if np.isnan(covariance).all() else covariance, tuple(row.status or "" for row in rows),
    )  # fmt: skip


def _assemble(
    time_ns: NDArray[np.int64] | None,
    p: NDArray[np.float64],
    rotation: NDArray[np.float64],
    numbers: NDArray[np.int64],
    source: str,
    warnings: tuple[str, ...],
    covariance: NDArray[np.float64] | None = None,
    status: tuple[str, ...] | None = None,
) -> Trajectory:
    """The trajectory of a file's poses, without those that repeat a stamp; `rotation` is (N, 4) wxyz or (N, 3, 3)."""
    matrices = None
    if rotation.ndim == 3:
        matrices = rotation
        with np.errstate(all="ignore"):
            off = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
            bad = np.flatnonzero(~((off < QUATERNION_TOLERANCE) & (np.linalg.det(matrices) > 0.0)))
        if bad.size:
            raise InputError(
                "rotation matrices (orthonormal, determinant 1)",
                f"one that is {off[bad[0]]:.3g} off ({source}, line {numbers[bad[0]]}; {bad.size} such rows)",
                "check that the file holds 3×4 pose matrices row by row",
            )
        rotation = quaternion.from_matrix(matrices)
    if time_ns is not None:
        fresh = np.r_[True, time_ns[1:] != time_ns[:-1]]
        if not fresh.all():
            repeated = np.flatnonzero(~fresh)
            warnings += (
                f"{len(repeated)} poses of {source} repeat the time stamp before them and were left out "
                f"(first: line {numbers[repeated[0]]})",
            )
            time_ns, p, rotation, numbers = time_ns[fresh], p[fresh], rotation[fresh], numbers[fresh]
            covariance = None if covariance is None else covariance[fresh]
            status = None if status is None else tuple(word for word, keep in zip(status, fresh, strict=True) if keep)
    return Trajectory(
        time_ns=time_ns,
        p=p,
        q_wxyz=rotation,
        covariance=covariance,
        status=status,
        matrices=matrices,
        source=source,
        warnings=warnings,
        lines=numbers,
    )


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write `seconds tx ty tz qx qy qz qw` a line, stamps with nine decimals; the file appears only when it is whole.

    Raises:
        InputError: the trajectory has no time stamps.
        OutputError: the file cannot be written.

    Example:
        >>> way = bp.Trajectory(np.array([0, 10**9]), np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.array([[1.0, 0, 0, 0]] * 2))
        >>> bp.formats.write_tum("way.tum", way)
        >>> bp.read_trajectory("way.tum").time_ns.tolist()
        [0, 1000000000]
    """
    require(trajectory, Trajectory, "a Trajectory", "make one from arrays")
    times = trajectory.times.tolist()
    with atomic_file(path) as file:
        file.writelines(tum_row(*row).encode() for row in zip(times, trajectory.p, trajectory.q_wxyz, strict=True))


def write_kitti(path: str | Path, trajectory: Trajectory) -> None:
    """Write the 3×4 pose matrix a line; the file appears only when it is whole.

    Raises:
        OutputError: the file cannot be written.

    Example:
        >>> way = bp.Trajectory(np.array([0, 10**9]), np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.array([[1.0, 0, 0, 0]] * 2))
        >>> bp.formats.write_kitti("way.txt", way)
        >>> bp.read_trajectory("way.txt").time_ns is None  # the format has no times
        True
    """
    require(trajectory, Trajectory, "a Trajectory", "make one from arrays")
    with atomic_file(path) as file:
        file.writelines(kitti_row(*row).encode() for row in zip(trajectory.R, trajectory.p, strict=True))


def write_csv(path: str | Path, trajectory: Trajectory) -> None:
    """Write boxplus' own CSV (columns: `trajectory_rows.CSV_COLUMNS`); the file appears only when it is whole.

    Raises:
        InputError: the trajectory has no time stamps.
        OutputError: the file cannot be written.

    Example:
        >>> way = bp.Trajectory(np.array([0, 10**9]), np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.array([[1.0, 0, 0, 0]] * 2))
        >>> bp.formats.write_csv("way.csv", way)
        >>> bp.read_trajectory("way.csv").p.tolist()
        [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    """
    require(trajectory, Trajectory, "a Trajectory", "make one from arrays")
    times = trajectory.times.tolist()
    covariance = trajectory.covariance
    with atomic_file(path) as file:
        file.write((",".join(CSV_COLUMNS) + "\n").encode())
        for i, time_ns in enumerate(times):
            status = "" if trajectory.status is None else trajectory.status[i]
            sigma = None if covariance is None else covariance[i]
            file.write(csv_row(time_ns, status, trajectory.p[i], trajectory.q_wxyz[i], sigma).encode())
