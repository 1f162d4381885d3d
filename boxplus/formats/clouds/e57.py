"""E57 point clouds (ASTM E2807) through pye57, the extra `e57`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._extras import require
from boxplus.errors import InputError
from boxplus.formats.clouds.cloud_writer import CloudWriter
from boxplus.formats.clouds.point_cloud import PointCloud, as_points, opened

_PURPOSE = "which reads and writes E57 files"
_SCAN = 4_000_000  # points that one scan of the file holds: so many are kept in memory


class E57Writer(CloudWriter):
    """Streams points to an E57 file, in scans of four million points without a pose.

    Args:
        path: the file to write; one of that name is replaced.

    Raises:
        InputError: pye57 is not installed.
        OutputError: the file cannot be created.
    """

    def __init__(self, path: str | Path) -> None:
        self._pye57 = require("pye57", _PURPOSE)
        super().__init__(path)
        self._held: list[NDArray[np.float32]] = []
        self._scans: Any = None

    def _begin(self, file: BinaryIO, with_intensity: bool) -> None:
        file.flush()
        with self._explained(self._pye57.libe57.E57Exception):
            self._scans = self._pye57.E57(str(self._temporary), mode="w")

    def _write(self, file: BinaryIO, records: NDArray[np.float32]) -> None:
        self._held.append(records)
        if sum(len(block) for block in self._held) >= _SCAN:
            self._write_scan()

    def _write_scan(self) -> None:
        records = np.concatenate([*self._held, np.empty((0, 4 if self._with_intensity else 3), np.float32)])
        self._held = []
        if not len(records):
            return
        columns = {f"cartesian{axis}": np.ascontiguousarray(records[:, k]) for k, axis in enumerate("XYZ")}
        if self._with_intensity:
            columns["intensity"] = np.ascontiguousarray(records[:, 3])
        with self._explained(self._pye57.libe57.E57Exception):
            self._scans.write_scan_raw(columns, name=f"boxplus {self._scans.scan_count}")

    def _finish(self, file: BinaryIO) -> None:
        self._write_scan()
        with self._explained(self._pye57.libe57.E57Exception):
            self._scans.close()

    def abort(self) -> None:
        """Remove what was written; the name stays free, or keeps the file it had before."""
        self._scans, self._held = None, []
        super().abort()


def write_e57(path: str | Path, points: ArrayLike, intensity: ArrayLike | None = None) -> None:
    """Write (N, 3) points [m] and optional (N,) intensities to an E57 file in one go.

    Raises:
        InputError: shapes that do not match, or pye57 is not installed.
        OutputError: the file cannot be written.
    """
    with E57Writer(path) as writer:
        writer.append(points, intensity)


def read_e57(path: str | Path) -> PointCloud:
    """Read the points of all scans of an E57 file, in the file's frame; intensities where every scan has them.

    Raises:
        InputError: pye57 is not installed; the file is missing, cut or malformed; coordinates that float32 cannot hold.
    """
    pye57, source = require("pye57", _PURPOSE), Path(path)
    with opened(source, "E57"):
        pass
    try:
        file = pye57.E57(str(source))
        scans = []
        for number in range(file.scan_count):
            fields = file.get_header(number).point_fields
            scans.append(file.read_scan(number, intensity="intensity" in fields, transform=True, ignore_missing_fields=True))
        file.close()
    except (pye57.libe57.E57Exception, ValueError, KeyError, RuntimeError, AttributeError) as error:
        raise InputError("a whole E57 file", f"{path}: {error}", "give another file, or write it again") from error
    empty = np.empty(0)
    columns = [np.concatenate([empty, *(scan[f"cartesian{axis}"] for scan in scans)]) for axis in "XYZ"]
    intensity = None
    if scans and all("intensity" in scan for scan in scans):
        intensity = np.concatenate([np.asarray(scan["intensity"], np.float32) for scan in scans])
    return PointCloud(as_points(columns, source), intensity)
