"""Writing a trajectory pose by pose while a run goes on."""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError, OutputError
from boxplus.formats.output import make_folder, output_error
from boxplus.formats.trajectory_rows import CSV_COLUMNS, csv_row, kitti_row, tum_row
from boxplus.manifolds import quaternion


class TrajectoryWriter:
    """Appends poses to `<stem>.tum`, `<stem>.kitti.txt` and `<stem>.csv` in a folder.

    Every row is handed to the operating system at once: when the process is killed, all rows so far can be read. When
    the disk is full, the row that did not fit is taken back and the rows before it stay readable. Files of the same
    names from an earlier run are replaced.

    Args:
        folder: created where it does not exist.
        stem: beginning of the three file names.
        after_ns: go on in the files of an earlier writer, whose last pose has this time [ns].

    Raises:
        OutputError: the folder or the files cannot be created.
    """

    def __init__(self, folder: str | Path, stem: str = "trajectory", *, after_ns: int | None = None) -> None:
        base = make_folder(folder)
        self.paths: dict[str, Path] = {
            "tum": base / f"{stem}.tum",
            "kitti": base / f"{stem}.kitti.txt",
            "csv": base / f"{stem}.csv",
        }
        self.count = 0
        """Poses written so far."""
        self._last_ns = after_ns
        self._files: dict[str, int] = {}
        self._sizes = dict.fromkeys(self.paths, 0)
        try:
            for name, path in self.paths.items():
                try:
                    flags = os.O_WRONLY | os.O_CREAT | (os.O_TRUNC if after_ns is None else 0) | getattr(os, "O_BINARY", 0)
                    self._files[name] = os.open(path, flags, 0o644)
                    self._sizes[name] = os.lseek(self._files[name], 0, os.SEEK_END)
                except OSError as error:
                    raise output_error(path, error) from error
            if after_ns is None:
                header = ",".join(CSV_COLUMNS) + "\n"
                self._write("csv", header)
                self._sizes["csv"] = len(header)
        except OutputError:
            self.close()
            raise

    def append(
        self,
        time_ns: int,
        R_world_imu: ArrayLike,
        p_world_imu: ArrayLike,
        covariance_6x6: ArrayLike | None,
        status: str,
    ) -> None:
        """Write one pose to all three files.

        Args:
            time_ns: absolute time, later than that of the pose before [ns].
            R_world_imu: (3, 3) rotation.
            p_world_imu: (3,) position [m].
            covariance_6x6: (6, 6) covariance of the pose error, rotation first [rad², rad·m, m²]; None where it is not known.
            status: the estimator's verdict, e.g. `ok`.

        Raises:
            InputError: a value is not finite, has the wrong shape, or the time does not increase.
            OutputError: the disk is full or the file cannot be written; also after `close`.
        """
        R, p = _checked(R_world_imu, (3, 3), "R_world_imu"), _checked(p_world_imu, (3,), "p_world_imu")
        covariance = None if covariance_6x6 is None else _checked(covariance_6x6, (6, 6), "covariance_6x6")
        time = int(time_ns)
        if self._last_ns is not None and time <= self._last_ns:
            raise InputError(f"a time after {self._last_ns} ns", f"{time} ns", "append poses in order of time")
        q_wxyz = quaternion.from_matrix(R[None])[0]
        if not self._files:
            raise OutputError("expected an open trajectory writer – got one that was closed – append before close()")
        try:
            self._write("csv", csv_row(time, status, p, q_wxyz, covariance))
            self._write("tum", tum_row(time, p, q_wxyz))
            self._write("kitti", kitti_row(R, p))
        except OutputError:
            self._take_back()
            raise
        self._sizes = {name: os.lseek(file, 0, os.SEEK_CUR) for name, file in self._files.items()}
        self._last_ns = time
        self.count += 1

    def _write(self, name: str, text: str) -> None:
        rest = memoryview(text.encode())
        try:
            while rest:
                rest = rest[os.write(self._files[name], rest) :]
        except OSError as error:
            raise output_error(self.paths[name], error) from error

    def _take_back(self) -> None:
        """Cut all three files to the last pose that all of them hold."""
        for name, file in self._files.items():
            try:
                os.ftruncate(file, self._sizes[name])
                os.lseek(file, self._sizes[name], os.SEEK_SET)
            except OSError:
                continue  # the reader leaves out a cut last line by itself

    def close(self) -> None:
        """Close the files; safe to call twice."""
        while self._files:
            os.close(self._files.popitem()[1])

    def __enter__(self) -> TrajectoryWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()


def _checked(values: ArrayLike, shape: tuple[int, ...], name: str) -> NDArray[np.float64]:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        got = f"shape {array.shape}" if array.shape != shape else "NaN or infinity"
        raise InputError(f"{name} as finite numbers of shape {shape}", got, "write only poses the estimator vouches for")
    return array
