"""Registered scans on disk, each with its pose along the odometry, to be placed where the closed loops put them.

A record is a head, and the points that it counts, with or without intensities and the numbers of the LiDARs that saw them. The
head ends with the checksum of the points and its own, so that a byte that changed on the disk is found wherever it is, and a
damaged count is never believed.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.output import output_error
from boxplus.manifolds import quaternion
from boxplus.maps.tiles.voxel_thinning import RecentVoxels

_HEAD = struct.Struct("<qqB7dI")  # time, points, what comes with them (below), pose, CRC-32 of what follows the head
_CHECK = struct.Struct("<I")  # CRC-32 of that, the end of the head
_POINT, _INTENSITY, _LIDAR = 12, 4, 1  # bytes
_WITH_INTENSITY, _WITH_LIDAR = 1, 2


class SpooledScan(NamedTuple):
    """One scan: absolute time [ns], pose (7,) along the odometry, points (N, 3) in the body's frame [m], intensity (N,).

    `lidar` (N,) says which LiDAR saw each point, where several were merged.
    """

    time_ns: int
    T_odo_body: NDArray[np.float64]
    p_body: NDArray[np.float32]
    intensity: NDArray[np.float32] | None
    lidar: NDArray[np.uint8] | None = None


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
        data = points.tobytes()
        if scan.intensity is not None:
            data += np.ascontiguousarray(scan.intensity[keep], dtype=np.float32).tobytes()
        if scan.lidar is not None:
            data += np.ascontiguousarray(scan.lidar[keep], dtype=np.uint8).tobytes()
        kinds = _WITH_INTENSITY * (scan.intensity is not None) | _WITH_LIDAR * (scan.lidar is not None)
        head = _HEAD.pack(scan.time_ns, len(points), kinds, *scan.T_odo_body.tolist(), zlib.crc32(data))
        try:
            self._file.write(head + _CHECK.pack(zlib.crc32(head)) + data)
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
            InputError: there is less than that, or it is damaged.
        """
        if (size := self._file.seek(0, os.SEEK_END)) < mark.size:
            raise InputError(f"the {mark.size} bytes of the checkpoint in {self.path}", f"{size}", "start the run anew")
        self._file.truncate(mark.size)
        self._file.seek(mark.stretch)
        self.forget()
        with _named(self.path):
            while (scan := _next_scan(self._file)) is not None:
                if self._recent is not None:
                    self._recent.new(_in_odometry(scan))

    def scans(self) -> Iterator[SpooledScan]:
        """All scans so far, in order.

        Raises:
            InputError: what is on the disk is not what was written.
        """
        self.mark()
        return read_spool(self.path)

    def poses(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Times (n,) and poses (n, 7) along the odometry of all scans so far, without their points.

        Raises:
            InputError: what is on the disk is not what was written.
        """
        self.mark()
        times, poses = [], []
        with _named(self.path), self.path.open("rb") as file:
            while (head := _next_head(file)) is not None:
                times.append(head.time_ns)
                poses.append(head.T_odo_body)
                file.seek(head.size, os.SEEK_CUR)
        return np.array(times, dtype=np.int64), np.array(poses).reshape(-1, 7)

    def close(self) -> None:
        """Close the file; safe to call twice."""
        self._file.close()


def read_spool(path: Path) -> Iterator[SpooledScan]:
    """The scans of a spool that was closed, in order.

    Raises:
        InputError: it cannot be read, ends within a scan, or a byte of it is not what was written.
    """
    with _named(path), path.open("rb") as file:
        while (scan := _next_scan(file)) is not None:
            yield scan


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Errors of what is read here say which file it is, and what to do."""
    try:
        yield
    except (OSError, ValueError) as error:
        raise InputError("the scans that a run of 'boxplus slam' kept", f"{path}: {error}", "run it again") from error


class _Head(NamedTuple):
    """What stands before the points of a scan, with their size [bytes] and checksum."""

    time_ns: int
    points: int
    has_intensity: bool
    has_lidar: bool
    T_odo_body: NDArray[np.float64]
    size: int
    checksum: int


def _next_head(file: BinaryIO) -> _Head | None:
    """The head at the position of a file, which moves on; None at its end.

    Raises:
        ValueError: it ends within the scan, or the head is not as it was written.
    """
    begin = file.tell()
    if not (head := file.read(_HEAD.size + _CHECK.size)):
        return None
    if len(head) < _HEAD.size + _CHECK.size:
        raise ValueError(f"it ends within a scan that begins at byte {begin}")
    own = head[: _HEAD.size]
    if _CHECK.pack(zlib.crc32(own)) != head[_HEAD.size :]:
        raise ValueError(f"{_damaged(begin)} (or the file is of another version of boxplus)")
    time_ns, count, kinds, *pose, checksum = _HEAD.unpack(own)
    has_intensity, has_lidar = bool(kinds & _WITH_INTENSITY), bool(kinds & _WITH_LIDAR)
    size = (_POINT + _INTENSITY * has_intensity + _LIDAR * has_lidar) * count
    if size > os.fstat(file.fileno()).st_size - file.tell():
        raise ValueError(f"it ends within a scan that begins at byte {begin}")
    return _Head(time_ns, count, has_intensity, has_lidar, np.array(pose), size, checksum)


def _next_scan(file: BinaryIO) -> SpooledScan | None:
    """The scan at the position of a file, which moves on; None at its end.

    Raises:
        ValueError: it ends within the scan, or the scan is not as it was written.
    """
    begin = file.tell()
    if (head := _next_head(file)) is None:
        return None
    data = file.read(head.size)
    if zlib.crc32(data) != head.checksum:
        raise ValueError(_damaged(begin))
    points = np.frombuffer(data, dtype=np.float32, count=3 * head.points).reshape(-1, 3)
    intensity = lidar = None
    if head.has_intensity:
        intensity = np.frombuffer(data, dtype=np.float32, count=head.points, offset=_POINT * head.points)
    if head.has_lidar:
        lidar = np.frombuffer(data, dtype=np.uint8, offset=head.size - _LIDAR * head.points)
    return SpooledScan(head.time_ns, head.T_odo_body, points, intensity, lidar)


def _damaged(begin: int) -> str:
    return f"the scan that begins at byte {begin} is damaged: its checksum is another one"


def _in_odometry(scan: SpooledScan) -> NDArray[np.float32]:
    """(N, 3) points in the odometry's world, point by point with the same rounding whatever others come with it."""
    R, t = quaternion.to_matrix(scan.T_odo_body[:4]), scan.T_odo_body[4:]
    x, y, z = np.ascontiguousarray(scan.p_body.T, dtype=np.float64)
    rows = [R[k, 0] * x + R[k, 1] * y + R[k, 2] * z + t[k] for k in range(3)]
    return np.ascontiguousarray(np.stack(rows, axis=1), dtype=np.float32)
