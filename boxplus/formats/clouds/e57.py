"""E57 point clouds (ASTM E2807) through pye57, the extra `e57`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._extras import require
from boxplus.errors import InputError
from boxplus.formats.clouds.cloud_writer import CloudWriter
from boxplus.formats.clouds.point_cloud import COLORS, Columns, PointCloud, as_points, opened

_PURPOSE = "which reads and writes E57 files"
_FIELDS = {"red": "colorRed", "green": "colorGreen", "blue": "colorBlue"}
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
        self._held: list[tuple[NDArray[np.float32], Columns]] = []
        self._scans: Any = None

    def _begin(self, file: BinaryIO, with_intensity: bool) -> None:
        file.flush()
        with self._explained(self._pye57.libe57.E57Exception):
            self._scans = self._pye57.E57(str(self._temporary), mode="w")

    def holds(self, columns: Columns) -> set[str]:
        """Colours of 8 bits."""
        return {name for name in COLORS if all(name in columns and columns[name].dtype == np.uint8 for name in COLORS)}

    def _write(self, file: BinaryIO, records: NDArray[np.float32], columns: Columns) -> None:
        self._held.append((records, columns))
        if sum(len(block) for block, _ in self._held) >= _SCAN:
            self._write_scan()

    def _write_scan(self) -> None:
        held, self._held = self._held, []
        records = np.concatenate([*(block for block, _ in held), np.empty((0, 4 if self._with_intensity else 3), np.float32)])
        if not len(records):
            return
        columns = {f"cartesian{axis}": np.ascontiguousarray(records[:, k]) for k, axis in enumerate("XYZ")}
        if self._with_intensity:
            columns["intensity"] = np.ascontiguousarray(records[:, 3])
        for name, _ in self._others:
            columns[_FIELDS[name]] = np.concatenate([others[name] for _, others in held])
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


def read_e57(path: str | Path, *, everything: bool = False) -> PointCloud:
    """Read the points of all scans of an E57 file, in the file's frame; intensities where every scan has them.

    Args:
        everything: read colours, too, where every scan has them, and name what there is beside.

    Raises:
        InputError: pye57 is not installed; the file is missing, cut or malformed; coordinates that float32 cannot hold.
    """
    pye57, source = require("pye57", _PURPOSE), Path(path)
    with opened(source, "E57"):
        pass
    try:
        file = pye57.E57(str(source))
        scans, seen = [], set[str]()
        for number in range(file.scan_count):
            fields = file.get_header(number).point_fields
            seen |= set(fields)
            colored = everything and set(_FIELDS.values()) <= set(fields)
            asked = {"intensity": "intensity" in fields, "colors": colored, "ignore_missing_fields": True}
            scans.append(file.read_scan(number, transform=True, **asked))
        file.close()
    except (pye57.libe57.E57Exception, ValueError, KeyError, RuntimeError, AttributeError) as error:
        raise InputError("a whole E57 file", f"{path}: {error}", "give another file, or write it again") from error
    empty = np.empty(0)
    columns = [np.concatenate([empty, *(scan[f"cartesian{axis}"] for scan in scans)]) for axis in "XYZ"]
    intensity = None
    if scans and all("intensity" in scan for scan in scans):
        intensity = np.concatenate([np.asarray(scan["intensity"], np.float32) for scan in scans])
    points = as_points(columns, source)
    if not everything:
        return PointCloud(points, intensity)
    others: dict[str, NDArray[np.generic]] = {}
    if scans and all("colorRed" in scan for scan in scans):
        others = {name: np.concatenate([scan[field] for scan in scans]).astype(np.uint8) for name, field in _FIELDS.items()}
    shapes = ("cartesian", "spherical")  # the coordinates, and whether they are valid
    left = seen - ({"intensity"} if intensity is not None else set()) - (set(_FIELDS.values()) if others else set())
    return PointCloud(points, intensity, others, tuple(sorted(name for name in left if not name.startswith(shapes))))
