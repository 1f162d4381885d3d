"""Registered scans on disk, each with its pose along the odometry, to be placed where the closed loops put them."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import OutputError
from boxplus.formats.output import output_error
from boxplus.maps.tiles.voxel_thinning import RecentVoxels

_HEAD = struct.Struct("<qqB7d")  # time, points, whether with intensity, pose


class SpooledScan(NamedTuple):
    """One scan: absolute time [ns], pose (7,) along the odometry, points (N, 3) in the body's frame [m], intensity (N,)."""

    time_ns: int
    T_odo_body: NDArray[np.float64]
    p_body: NDArray[np.float32]
    intensity: NDArray[np.float32] | None


class ScanSpool:
    """Appends scans to a file, without the points whose voxel another point near in time has taken.

    Args:
        path: created anew.
        voxel: edge of the voxels, in the odometry's world [m]; None keeps every point.

    Raises:
        OutputError: it cannot be written.
    """

    def __init__(self, path: Path, voxel: float | None) -> None:
        self.path, self._voxel = path, voxel
        self._recent = None if voxel is None else RecentVoxels(voxel)
        try:
            self._file: BinaryIO = path.open("wb")
        except OSError as error:
            raise output_error(path, error) from error

    def append(self, scan: SpooledScan, p_odo: NDArray[np.float64]) -> None:
        """Add a scan whose points are at `p_odo` (N, 3) in the odometry's world."""
        keep = np.flatnonzero(np.isfinite(p_odo).all(axis=1))
        if self._recent is not None:
            keep = keep[self._recent.new(np.ascontiguousarray(p_odo[keep], dtype=np.float32))]
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
        if self._voxel is not None:
            self._recent = RecentVoxels(self._voxel)

    def scans(self) -> Iterator[SpooledScan]:
        """All scans so far, in order."""
        self._file.flush()
        with self.path.open("rb") as file:
            while head := file.read(_HEAD.size):
                time_ns, count, has_intensity, *pose = _HEAD.unpack(head)
                points = np.frombuffer(file.read(12 * count), dtype=np.float32).reshape(-1, 3)
                intensity = np.frombuffer(file.read(4 * count), dtype=np.float32) if has_intensity else None
                yield SpooledScan(time_ns, np.array(pose), points, intensity)

    def __enter__(self) -> ScanSpool:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        """Close and remove the file."""
        try:
            self._file.close()
            self.path.unlink(missing_ok=True)
        except OSError as failure:
            if error is None:
                raise OutputError(f"cannot remove {self.path}: {failure}") from failure
