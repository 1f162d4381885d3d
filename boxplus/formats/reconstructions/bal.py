"""Bundle adjustment problems in the format of "Bundle Adjustment in the Large" (Agarwal et al., ECCV 2010)."""

from __future__ import annotations

import bz2
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.numbers.writer import write_rows
from boxplus.formats.output import atomic_file
from boxplus.formats.reconstructions.bal_text import read_bal_text

CAMERA_SIZE = 9


@dataclass(frozen=True, slots=True, eq=False)
class BalProblem:
    """m cameras, n points and k observations.

    The camera looks along −z of its frame: with P = R p_world + t and p = −P / P_z, a point is seen at
    f (1 + k1 |p|² + k2 |p|⁴) p, in pixels from the centre of the image, x to the right and y upwards.

    Attributes:
        cameras: (m, 9) float64, rotation vector of R_camera_world [rad], t of T_camera_world, f [px], k1, k2.
        points: (n, 3) float64, p_world.
        camera_of, point_of: (k,) int64, the camera and the point of each observation.
        pixels: (k, 2) float64 [px].
        source: where the problem comes from; error messages begin with it.

    Raises:
        InputError: on construction, where shapes do not match, a value is not finite or an index is out of range.

    Example:
        >>> scene = bp.formats.read_bal("scene.txt.bz2")
        >>> scene.cameras.shape, scene.pixels.shape, int(scene.camera_of.max())
        ((6, 9), (240, 2), 5)
    """

    cameras: NDArray[np.float64]
    points: NDArray[np.float64]
    camera_of: NDArray[np.int64]
    point_of: NDArray[np.int64]
    pixels: NDArray[np.float64]
    source: str = "bundle adjustment problem"

    def __post_init__(self) -> None:
        shapes = {
            "cameras": (len(self.cameras), CAMERA_SIZE),
            "points": (len(self.points), 3),
            "camera_of": (len(self.pixels),),
            "point_of": (len(self.pixels),),
            "pixels": (len(self.pixels), 2),
        }
        for name, shape in shapes.items():
            kind = np.int64 if name.endswith("_of") else np.float64
            array = np.ascontiguousarray(getattr(self, name), dtype=kind)
            if array.shape != shape:
                raise InputError(f"{name} of shape {shape}", f"{array.shape} ({self.source})", "give matching arrays")
            if kind is np.float64 and not np.isfinite(array).all():
                row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
                raise InputError(f"finite {name}", f"{array[row].tolist()} ({self.source}, row {row})", "remove or correct it")
            object.__setattr__(self, name, array)
        check_indices(self.camera_of, len(self.cameras), self.point_of, len(self.points), self.source)


def check_indices(camera_of: NDArray[np.int64], cameras: int, point_of: NDArray[np.int64], points: int, source: str) -> None:
    """Refuse observations (k,) of cameras and points that are not there.

    Raises:
        InputError: the message names the first one.
    """
    for name, index, count in (("camera", camera_of, cameras), ("point", point_of, points)):
        bad = np.flatnonzero((index < 0) | (index >= count))
        if bad.size:
            raise InputError(
                f"{name} indices from 0 to {count - 1}",
                f"{index[bad[0]]} ({source}, observation {bad[0]})",
                "give indices from 0",
            )


def read_bal(path: str | Path) -> BalProblem:
    """Read a BAL file, plain or bzip2.

    Raises:
        InputError: as `read_bal_text`.

    Example:
        >>> bp.formats.read_bal("scene.txt.bz2").points.shape
        (40, 3)
    """
    _, camera_of, point_of, pixels, cameras, points = read_bal_text(path, CAMERA_SIZE)
    return BalProblem(cameras, points, camera_of, point_of, pixels, str(path))


def write_bal(path: str | Path, problem: BalProblem) -> None:
    """Write a BAL file, compressed where its name ends in .bz2; it appears only when it is whole.

    Raises:
        OutputError: the file cannot be written.

    Example:
        >>> bp.formats.write_bal("copy.txt.bz2", bp.formats.read_bal("scene.txt.bz2"))
        >>> bp.formats.read_bal("copy.txt.bz2").points.shape
        (40, 3)
    """
    with atomic_file(path) as raw:
        if str(path).endswith(".bz2"):
            with bz2.open(raw, "wb") as file:
                _write(cast(BinaryIO, file), problem)
        else:
            _write(raw, problem)


def _write(file: BinaryIO, problem: BalProblem) -> None:
    file.write(f"{len(problem.cameras)} {len(problem.points)} {len(problem.pixels)}\n".encode())
    write_rows(file, "", np.column_stack([problem.camera_of, problem.point_of]), problem.pixels)
    for block in (problem.cameras, problem.points):
        numbers = block.reshape(-1, 1)
        write_rows(file, "", np.empty((len(numbers), 0), np.int64), numbers)
