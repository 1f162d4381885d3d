"""A point cloud as files carry it: positions and, where present, one intensity each; and what its readers share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError

FARTHEST_M = 65_536.0
"""Coordinates with more digits than float32 has are read as far as this: beyond, they would be moved by more than 4 mm."""

HEADER_LIMIT = 64 * 1024
"""A point cloud header is shorter than this [bytes]; what is longer is no header."""


Columns = Mapping[str, NDArray[np.generic]]
"""Values of points by name, (N,) each."""

COLORS = ("red", "green", "blue")
"""Columns of colours, uint8, or uint16 where a file has more than 8 bits of them."""


@dataclass(frozen=True, slots=True)
class PointCloud:
    """N points.

    Attributes:
        points: (N, 3) float32, in the file's frame [m].
        intensity: (N,) float32 in the sensor's unit, or None.
        columns: what else a file says of each point, by name, (N,) each; only where it was asked for.
        left_out: what it says beside that, and was not read; only where it was asked for.

    Example:
        >>> cloud = bp.formats.PointCloud(np.zeros((2, 3), np.float32), None)
        >>> cloud.points.shape, cloud.intensity
        ((2, 3), None)
    """

    points: NDArray[np.float32]
    intensity: NDArray[np.float32] | None
    columns: Columns = field(default_factory=dict)
    left_out: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.points)


def as_records(points: ArrayLike, intensity: ArrayLike | None) -> NDArray[np.float32]:
    """Points and intensities side by side, little-endian float32 of shape (N, 3) or (N, 4), ready to be written.

    Raises:
        InputError: shapes that do not match.
    """
    xyz = np.asarray(points)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.kind not in "fiu":
        raise InputError(
            "points as numbers of shape (N, 3)", f"{xyz.dtype} of shape {xyz.shape}", "give one row x, y, z per point"
        )
    if intensity is None:
        return np.ascontiguousarray(xyz, dtype="<f4")
    strength = np.asarray(intensity)
    if strength.shape != (len(xyz),):
        raise InputError(
            f"intensity of shape ({len(xyz)},), one per point", f"shape {strength.shape}", "give one value per point or None"
        )
    records = np.empty((len(xyz), 4), dtype="<f4")
    records[:, :3] = xyz
    records[:, 3] = strength
    return records


@contextmanager
def opened(path: Path, kind: str) -> Iterator[BinaryIO]:
    """The file, opened for reading.

    Raises:
        InputError: it cannot be opened or read.
    """
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise InputError(f"a readable {kind} file", f"{path}: {error.strerror}", "check the path") from error


def read_header(file: BinaryIO, path: Path, last_line: str) -> list[str]:
    """The header lines of a point cloud file, up to and with the one that begins with `last_line`.

    Raises:
        InputError: there is no such line near the beginning.
    """
    lines: list[str] = []
    size = 0
    while size < HEADER_LIMIT:
        raw = file.readline(HEADER_LIMIT)
        if not raw:
            break
        size += len(raw)
        lines.append(raw.decode("ascii", errors="replace").strip())
        if lines[-1].split(" ")[0] == last_line:
            return lines
    got = f"none ({path}, line {len(lines)})"
    raise InputError(f"a header that ends with {last_line!r}", got, "the file is cut or of another kind")


def read_records(file: BinaryIO, path: Path, dtype: np.dtype[np.void], count: int) -> NDArray[np.void]:
    """`count` binary records from the file's position on.

    Raises:
        InputError: the file holds fewer.
    """
    begin = file.tell()
    left = file.seek(0, 2) - begin
    if left < count * dtype.itemsize:
        raise InputError(
            f"{count} points of {dtype.itemsize} bytes, as the header says",
            f"{left // dtype.itemsize} ({path})",
            "the file was cut; write it again or correct the count in its header",
        )
    file.seek(begin)
    return np.frombuffer(file.read(count * dtype.itemsize), dtype=dtype, count=count)


def read_text_table(file: BinaryIO, path: Path, columns: int, count: int, first_line: int) -> NDArray[np.float64]:
    """`count` lines of `columns` numbers from the file's position on.

    Raises:
        InputError: too few lines, or a line that does not hold that many numbers; the message names the line.
    """
    rows: list[NDArray[np.float64]] = []
    for row in range(count):
        raw = file.readline()
        where = f"{path}, line {first_line + row}"
        if not raw:
            raise InputError(f"{count} points, as the header says", f"{row} ({where})", "the file was cut; write it again")
        try:
            values = np.array(raw.split(), dtype=np.float64)
        except ValueError:
            values = np.empty(0)
        if values.size != columns:
            raise InputError(
                f"{columns} numbers", f"{raw[:60].decode('ascii', 'replace').strip()!r} ({where})", "correct the line"
            )
        rows.append(values)
    return np.stack(rows) if rows else np.empty((0, columns))


def as_points(columns: Sequence[NDArray[np.generic]], path: Path) -> NDArray[np.float32]:
    """(N, 3) float32 of the columns x, y, z.

    Raises:
        InputError: coordinates so far from the origin (of a map projection, say) that float32 would move them by millimetres.
    """
    for axis, values in zip("xyz", columns, strict=True):
        if values.dtype.kind in "iu" or values.dtype.itemsize > 4:
            farthest = float(np.max(np.abs(values[np.isfinite(values)], dtype=np.float64), initial=0.0))
            if farthest > FARTHEST_M:
                raise InputError(
                    f"coordinates within {FARTHEST_M / 1e3:.0f} km of the origin, which float32 holds to 4 mm",
                    f"{axis} up to {farthest:.1f} m ({path})",
                    "subtract a local origin from them first",
                )
    return np.stack([values.astype(np.float32) for values in columns], axis=1)


def cloud_from_columns(columns: Columns, path: Path, *, everything: bool = False, left_out: Sequence[str] = ()) -> PointCloud:
    """Pick x, y, z and intensity out of a file's columns.

    Args:
        everything: keep the other columns, too, and what was `left_out` of the file.

    Raises:
        InputError: no x, y and z.
    """
    lower = {name.lower(): values for name, values in columns.items()}
    if not {"x", "y", "z"} <= lower.keys():
        raise InputError("points with x, y and z", f"{', '.join(columns) or 'nothing'} ({path})", "name the coordinates x, y, z")
    points = as_points([lower[axis] for axis in "xyz"], path)
    found = next((name for name in ("intensity", "scalar_intensity", "reflectivity", "i") if name in lower), None)
    intensity = None if found is None else np.ascontiguousarray(lower[found], dtype=np.float32)
    if not everything:
        return PointCloud(points, intensity)
    others = {name: values for name, values in columns.items() if name.lower() not in ("x", "y", "z", found)}
    return PointCloud(points, intensity, others, tuple(left_out))
