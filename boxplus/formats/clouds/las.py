"""LAS and LAZ point clouds (version 1.4, point format 6) through laspy and lazrs, the extra `las`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._extras import has, require
from boxplus.errors import InputError
from boxplus.formats.clouds.cloud_writer import CloudWriter
from boxplus.formats.clouds.point_cloud import PointCloud, as_points, opened

_PURPOSE, _PACKING = "which reads and writes LAS files", "which packs LAS to LAZ"
_EXACT = "intensity_exact"
_SCALE = 1e-4  # m: LAS keeps coordinates as whole multiples of it
_FARTHEST = _SCALE * (2**31 - 1)
_NEAR, _ROUND = 4000.0, 1000.0  # m: what is farther than that from the origin is counted from a multiple of this
_LARGEST = 65_535  # of LAS' own intensity


class LasWriter(CloudWriter):
    """Streams points to a LAS file, compressed where the name ends in .laz.

    Coordinates are kept to 0.05 mm, in the frame they come in: the file names no coordinate reference system. LAS has whole
    intensities from 0 to 65535; beside the rounded one each point keeps its own as `intensity_exact`.

    Args:
        path: the file to write; one of that name is replaced.

    Raises:
        InputError: laspy or lazrs is not installed.
        OutputError: the file cannot be created.
    """

    def __init__(self, path: str | Path) -> None:
        self._laspy = require("laspy", _PURPOSE)
        self._lazrs_error = require("lazrs", _PACKING).LazrsError
        super().__init__(path)
        self._writer: Any = None

    def _begin(self, file: BinaryIO, with_intensity: bool) -> None:
        header = self._laspy.LasHeader(version="1.4", point_format=6)
        header.scales, header.offsets = np.full(3, _SCALE), np.zeros(3)
        header.generating_software = "boxplus"
        if with_intensity:
            header.add_extra_dim(self._laspy.ExtraBytesParams(_EXACT, "f4", "intensity, not rounded"))
        compressed = self.path.suffix.lower() == ".laz"
        self._writer = self._laspy.open(file, mode="w", header=header, do_compress=compressed, closefd=False)

    def _write(self, file: BinaryIO, records: NDArray[np.float32]) -> None:
        xyz = records[:, :3].astype(np.float64)
        if not np.abs(xyz).max(initial=0.0) < _FARTHEST:
            self.abort()
            raise InputError(
                f"finite coordinates within {_FARTHEST / 1e3:.0f} km of the origin", "others", "write the points as PLY or PCD"
            )
        if not len(xyz):
            return
        points = self._laspy.ScaleAwarePointRecord.zeros(len(xyz), header=self._writer.header)
        points.x, points.y, points.z = xyz.T
        points.return_number[:] = 1
        points.number_of_returns[:] = 1
        if self._with_intensity:
            points.intensity = np.clip(np.nan_to_num(np.round(records[:, 3])), 0, _LARGEST).astype(np.uint16)
            points[_EXACT] = records[:, 3]
        with self._explained(self._lazrs_error):
            self._writer.write_points(points)

    def _finish(self, file: BinaryIO) -> None:
        with self._explained(self._lazrs_error):
            self._writer.close()


def write_las(path: str | Path, points: ArrayLike, intensity: ArrayLike | None = None) -> None:
    """Write (N, 3) points [m] and optional (N,) intensities to a LAS or LAZ file in one go; see `LasWriter`.

    Raises:
        InputError: shapes that do not match, or laspy is not installed.
        OutputError: the file cannot be written.
    """
    with LasWriter(path) as writer:
        writer.append(points, intensity)


def read_las(path: str | Path) -> PointCloud:
    """Read the points of a LAS or LAZ file; intensities where they are not all zero.

    Raises:
        InputError: laspy is not installed; the file is missing, cut or malformed; coordinates that float32 cannot hold, for which
            there is `read_survey`.
    """
    columns, intensity, _ = _columns(Path(path))
    return PointCloud(as_points(columns, Path(path)), intensity)


def read_survey(path: str | Path) -> tuple[PointCloud, NDArray[np.float64]]:
    """Read a LAS or LAZ file in coordinates of the Earth: points counted from an origin nearby, and that origin (3,) [m].

    The origin is zero along an axis whose coordinates lie within 4 km, and else the multiple of 1 km next to the middle of them;
    a position in the file is `origin + points`.

    Raises:
        InputError: as `read_las`; coordinates in degrees, where the file says so; an extent that float32 cannot hold.

    Example:
        `cloud, origin = read_survey("survey.laz"); (origin + cloud.points).mean(axis=0)`
    """
    source = Path(path)
    columns, intensity, header = _columns(source)
    if has("pyproj"):
        faults: tuple[type[BaseException], ...] = (*_faults(), RuntimeError)
        try:
            crs = header.parse_crs()
        except faults:  # what pyproj raises; the file names none that is known, and is taken as it is
            crs = None
        if crs is not None and crs.is_geographic:
            raise InputError("coordinates in metres", f"{crs.name}, in degrees ({path})", "convert the file to UTM")
    origin = np.array([_nearby(values) for values in columns])
    local = [values - offset for values, offset in zip(columns, origin, strict=True)]
    return PointCloud(as_points(local, source), intensity), origin


def _nearby(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    if not len(known) or np.abs(known).max() <= _NEAR:
        return 0.0
    return float(np.round(0.5 * (known.min() + known.max()) / _ROUND) * _ROUND)


def _columns(path: Path) -> tuple[list[NDArray[np.float64]], NDArray[np.float32] | None, Any]:
    """x, y and z, intensity where there is any, and the header."""
    laspy = require("laspy", _PURPOSE)
    require("lazrs", _PACKING)  # laspy finds it by itself
    with opened(path, "LAS") as file:
        try:
            cloud = laspy.read(file, closefd=False)
            found = len(cloud.points)
            columns = [np.asarray(cloud.x), np.asarray(cloud.y), np.asarray(cloud.z)]
            exact = _EXACT in cloud.point_format.extra_dimension_names
            intensity = np.asarray(cloud[_EXACT] if exact else cloud.intensity, dtype=np.float32)
        except _faults() as error:
            raise InputError("a whole LAS or LAZ file", f"{path}: {error}", "give another file, or write it again") from error
    if found != cloud.header.point_count:
        raise InputError(f"{cloud.header.point_count} points, as the header says", f"{found} ({path})", "the file was cut")
    return columns, intensity if exact or intensity.any() else None, cloud.header


def _faults() -> tuple[type[BaseException], ...]:
    """What laspy and lazrs raise about a file that is not right."""
    import lazrs
    from laspy.errors import LaspyException

    return LaspyException, lazrs.LazrsError, ValueError, OverflowError, MemoryError, KeyError, AttributeError, EOFError
