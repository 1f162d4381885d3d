"""Registered scans on disk, each with its pose along the odometry, to be placed where the closed loops put them."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.output import output_error
from boxplus.manifolds import quaternion
from boxplus.maps.tiles.voxel_thinning import RecentVoxels

_HEAD = struct.Struct("<qqB7d")  # time, points, whether with intensity, pose
_POINT, _INTENSITY = 12, 4  # bytes
_UNIT = 1e-6  # by which the length of a quaternion may differ from one


class SpooledScan(NamedTuple):
    """One scan: absolute time [ns], pose (7,) along the odometry, points (N, 3) in the body's frame [m], intensity (N,)."""

    time_ns: int
    T_odo_body: NDArray[np.float64]
    p_body: NDArray[np.float32]
    intensity: NDArray[np.float32] | None


class SpoolMark(NamedTuple):
    """A place in a spool: its bytes so far, and those before its last stretch began."""

    size: int
    stretch: int


class ScanSpool:
    """Appends scans to a file, without the points whose voxel another point near in time has taken.

    Args:
        path: created anew.
        voxel: edge of the voxels, in the odometry's world [m]; None keeps every point.
        go_on: keep what an earlier spool wrote there.

    Raises:
        OutputError: it cannot be written.
    """

    def __init__(self, path: Path, voxel: float | None, *, go_on: bool = False) -> None:
        self.path, self._voxel = path, voxel
        self._recent = None if voxel is None else RecentVoxels(voxel)
        self._stretch = 0
        try:
            self._file: BinaryIO = path.open("r+b" if go_on else "w+b")
            self._file.seek(0, os.SEEK_END)
        except OSError as error:
            raise output_error(path, error) from error

    def append(self, scan: SpooledScan) -> None:
        """Add a scan; points that are not finite are left out."""
        p_odo = _in_odometry(scan)
        keep = np.flatnonzero(np.isfinite(p_odo).all(axis=1))
        if self._recent is not None:
            keep = keep[self._recent.new(p_odo[keep])]
        points = np.ascontiguousarray(scan.p_body[keep], dtype=np.float32)
        try:
            self._file.write(_HEAD.pack(scan.time_ns, len(points), scan.intensity is not None, *scan.T_odo_body.tolist()))
            self._file.write(points.tobytes())
            if scan.intensity is not None:
                self._file.write(np.ascontiguousarray(scan.intensity[keep], dtype=np.float32).tobytes())
        except OSError as error:
            raise output_error(self.path, error) from error

    def forget(self) -> None:
        """Begin a new stretch: voxels seen before count as new, as loops may part what the odometry laid together."""
        self._stretch = self._file.tell()
        if self._voxel is not None:
            self._recent = RecentVoxels(self._voxel)

    def mark(self) -> SpoolMark:
        """How far it is, all of it handed to the operating system; `cut` goes back to there.

        Raises:
            OutputError: the disk is full.
        """
        try:
            self._file.flush()
        except OSError as error:
            raise output_error(self.path, error) from error
        return SpoolMark(self._file.tell(), self._stretch)

    def cut(self, mark: SpoolMark) -> None:
        """Take away what was appended after a mark.

        Raises:
            InputError: there is less than that.
        """
        if (size := self._file.seek(0, os.SEEK_END)) < mark.size:
            raise InputError(f"the {mark.size} bytes of the checkpoint in {self.path}", f"{size}", "start the run anew")
        self._file.truncate(mark.size)
        self._file.seek(mark.stretch)
        self.forget()
        while (scan := _next_scan(self._file)) is not None:
            if self._recent is not None:
                self._recent.new(_in_odometry(scan))

    def scans(self) -> Iterator[SpooledScan]:
        """All scans so far, in order."""
        self.mark()
        with self.path.open("rb") as file:
            while (scan := _next_scan(file)) is not None:
                yield scan

    def poses(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Times (n,) and poses (n, 7) along the odometry of all scans so far, without their points."""
        self.mark()
        times, poses = [], []
        with self.path.open("rb") as file:
            while head := file.read(_HEAD.size):
                time_ns, count, has_intensity, *pose = _HEAD.unpack(head)
                times.append(time_ns)
                poses.append(pose)
                file.seek((_POINT + _INTENSITY * has_intensity) * count, os.SEEK_CUR)
        return np.array(times, dtype=np.int64), np.array(poses).reshape(-1, 7)

    def close(self) -> None:
        """Close the file; safe to call twice."""
        self._file.close()


def read_spool(path: Path) -> Iterator[SpooledScan]:
    """The scans of a spool that was closed, in order.

    Raises:
        InputError: it cannot be read, or ends within a scan.
    """
    try:
        with path.open("rb") as file:
            while (scan := _next_scan(file)) is not None:
                yield scan
    except (OSError, ValueError, struct.error) as error:
        raise InputError("the scans of a finished run of 'boxplus slam'", f"{path}: {error}", "run it again") from error


def _next_scan(file: BinaryIO) -> SpooledScan | None:
    """The scan at the position of a file, which moves on; None at its end.

    Raises:
        ValueError: it ends within the scan, or what is there is none.
    """
    if not (head := file.read(_HEAD.size)):
        return None
    time_ns, count, has_intensity, *pose = _HEAD.unpack(head)
    T = np.array(pose)
    if has_intensity not in (0, 1) or not (np.isfinite(T).all() and abs(np.linalg.norm(T[:4]) - 1.0) < _UNIT):
        raise ValueError(f"no scan before byte {file.tell()}")
    size = (_POINT + _INTENSITY * has_intensity) * count  # asked of the file before memory is: a damaged count may be any
    if count < 0 or size > os.fstat(file.fileno()).st_size - file.tell():
        raise ValueError(f"it ends within a scan, before byte {file.tell()}")
    points = np.frombuffer(file.read(_POINT * count), dtype=np.float32).reshape(-1, 3)
    intensity = np.frombuffer(file.read(_INTENSITY * count), dtype=np.float32) if has_intensity else None
    return SpooledScan(time_ns, T, points, intensity)


def _in_odometry(scan: SpooledScan) -> NDArray[np.float32]:
    """(N, 3) points in the odometry's world, point by point with the same rounding whatever others come with it."""
    R, t = quaternion.to_matrix(scan.T_odo_body[:4]), scan.T_odo_body[4:]
    x, y, z = np.ascontiguousarray(scan.p_body.T, dtype=np.float64)
    rows = [R[k, 0] * x + R[k, 1] * y + R[k, 2] * z + t[k] for k in range(3)]
    return np.ascontiguousarray(np.stack(rows, axis=1), dtype=np.float32)
