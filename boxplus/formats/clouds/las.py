"""LAS and LAZ point clouds (version 1.4, point format 6) through laspy and lazrs, the extra `las`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._extras import has, require
from boxplus.errors import InputError
from boxplus.formats.clouds.cloud_writer import CloudWriter
from boxplus.formats.clouds.point_cloud import COLORS, Columns, PointCloud, as_points, opened

_PURPOSE, _PACKING = "which reads and writes LAS files", "which packs LAS to LAZ"
_EXACT = "intensity_exact"
_SCALE = 1e-4  # m: LAS keeps coordinates as whole multiples of it
_FARTHEST = _SCALE * (2**31 - 1)
_NEAR, _ROUND = 4000.0, 1000.0  # m: what is farther than that from the origin is counted from a multiple of this
_LARGEST = 65_535  # of LAS' own intensity
_LONGEST_NAME = 32  # of an extra field, bytes


class LasWriter(CloudWriter):
    """Streams points to a LAS file, compressed where the name ends in .laz.

    Coordinates are kept to 0.05 mm, in the frame they come in: the file names no coordinate reference system. LAS has whole
    intensities from 0 to 65535; beside the rounded one each point keeps its own as `intensity_exact`. Columns with the names of
    LAS' own fields become these (colours of 8 bits as 16 bits), others extra fields.

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
        colored = {name for name, _ in self._others} >= set(COLORS)
        header = self._laspy.LasHeader(version="1.4", point_format=7 if colored else 6)
        header.scales, header.offsets = np.full(3, _SCALE), np.zeros(3)
        header.generating_software = "boxplus"
        if with_intensity:
            header.add_extra_dim(self._laspy.ExtraBytesParams(_EXACT, "f4", "intensity, not rounded"))
        own = self._own_fields()
        for name, kind in self._others:
            if name not in own:
                header.add_extra_dim(self._laspy.ExtraBytesParams(name, kind))
        compressed = self.path.suffix.lower() == ".laz"
        self._writer = self._laspy.open(file, mode="w", header=header, do_compress=compressed, closefd=False)

    def holds(self, columns: Columns) -> set[str]:
        """Fields of its own with values of their types, and extra ones with names of at most 32 bytes."""
        own, held = self._own_fields(), set[str]()
        for name, values in columns.items():
            if name not in own:
                fits = len(name.encode()) <= _LONGEST_NAME
            elif own[name].dtype is None:  # a field of a few bits
                fits = values.dtype.kind == "u" and values.max(initial=0) < 2 ** own[name].num_bits
            else:
                fits = np.can_cast(values.dtype, own[name].dtype, "safe")
            if fits and values.dtype.kind in "iuf" and name not in ("X", "Y", "Z", "intensity", _EXACT):
                held.add(name)
        return held if held >= set(COLORS) else held - set(COLORS)

    def _own_fields(self) -> dict[str, Any]:
        return {field.name: field for field in self._laspy.PointFormat(7).standard_dimensions}

    def _write(self, file: BinaryIO, records: NDArray[np.float32], columns: Columns) -> None:
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
        for name, values in columns.items():
            try:
                points[name] = values.astype(np.uint16) * 257 if name in COLORS and values.dtype == np.uint8 else values
            except OverflowError as error:  # of fields of a few bits
                self.abort()
                raise InputError(f"values of {name} that LAS can hold", f"up to {values.max()}", "leave it out") from error
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


def read_las(path: str | Path, *, everything: bool = False) -> PointCloud:
    """Read the points of a LAS or LAZ file; intensities where they are not all zero.

    Args:
        everything: read its other fields, too, where they say anything.

    Raises:
        InputError: laspy is not installed; the file is missing, cut or malformed; coordinates that float32 cannot hold, for which
            there is `read_survey`.
    """
    columns, intensity, cloud = _columns(Path(path))
    points = as_points(columns, Path(path))
    if not everything:
        return PointCloud(points, intensity)
    names = [name for name in cloud.point_format.dimension_names if name not in ("X", "Y", "Z", "intensity", _EXACT)]
    others = {name.replace(" ", "_"): np.array(cloud[name]) for name in names}
    silent = {"return_number": 1, "number_of_returns": 1}
    kept = {name: values for name, values in others.items() if values.ndim == 1 and (values != silent.get(name, 0)).any()}
    if set(COLORS) & kept.keys():
        colors = {name: others[name] for name in COLORS}
        if not any((values % 257).any() for values in colors.values()):  # 8 bits, spread over 16
            colors = {name: (values // 257).astype(np.uint8) for name, values in colors.items()}
        kept |= colors
    left_out = [name for name, values in others.items() if values.ndim != 1]
    left_out += ["the coordinate reference system"] * any("wkt" in text or "geo" in text for text in _records(cloud))
    return PointCloud(points, intensity, kept, tuple(left_out))


def _records(cloud: Any) -> list[str]:
    """Names of the variable length records of the header."""
    return [type(record).__name__.lower() for record in cloud.header.vlrs]


def read_survey(path: str | Path) -> tuple[PointCloud, NDArray[np.float64]]:
    """Read a LAS or LAZ file in coordinates of the Earth: points counted from an origin nearby, and that origin (3,) [m].

    The origin is zero along an axis whose coordinates lie within 4 km, and else the multiple of 1 km next to the middle of them;
    a position in the file is `origin + points`.

    Raises:
        InputError: as `read_las`; coordinates in degrees, in feet or from the middle of the Earth, where the file says
            so; an extent that float32 cannot hold.

    Example:
        `cloud, origin = read_survey("survey.laz"); (origin + cloud.points).mean(axis=0)`
    """
    source = Path(path)
    columns, intensity, cloud = _columns(source)
    if has("pyproj"):
        faults: tuple[type[BaseException], ...] = (*_faults(), RuntimeError)
        try:
            crs = cloud.header.parse_crs()
        except faults:  # what pyproj raises; the file names none that is known, and is taken as it is
            crs = None
        if crs is not None:
            _refuse_other_coordinates(crs, source)
    origin = np.array([_nearby(values) for values in columns])
    local = [values - offset for values, offset in zip(columns, origin, strict=True)]
    return PointCloud(as_points(local, source), intensity), origin


def _refuse_other_coordinates(crs: Any, path: Path) -> None:
    """What a file says itself of its coordinates is neither guessed nor passed over."""
    if crs.is_geographic:
        raise InputError("coordinates in metres", f"{crs.name}, in degrees ({path})", "convert the file to UTM")
    if crs.is_geocentric:
        raise InputError("z up", f"{crs.name}, from the middle of the Earth ({path})", "convert the file to UTM")
    units = {axis.name: axis for axis in crs.axis_info if axis.unit_conversion_factor != 1.0}  # heights may be in another one
    if units:
        said = ", ".join(f"{name} in {axis.unit_name}" for name, axis in units.items())
        factor = next(iter(units.values())).unit_conversion_factor
        raise InputError(
            "coordinates in metres along all axes", f"{crs.name}: {said} ({path})",
            f"convert the file to UTM and heights in metres, or multiply these by {factor:.10g} and name no reference system",
        )  # fmt: skip


def _nearby(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    if not len(known) or np.abs(known).max() <= _NEAR:
        return 0.0
    return float(np.round(0.5 * (known.min() + known.max()) / _ROUND) * _ROUND)


def _columns(path: Path) -> tuple[list[NDArray[np.float64]], NDArray[np.float32] | None, Any]:
    """x, y and z, intensity where there is any, and what laspy read."""
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
    return columns, intensity if exact or intensity.any() else None, cloud


def _faults() -> tuple[type[BaseException], ...]:
    """What laspy and lazrs raise about a file that is not right."""
    import lazrs
    from laspy.errors import LaspyException

    return LaspyException, lazrs.LazrsError, ValueError, OverflowError, MemoryError, KeyError, AttributeError, EOFError
