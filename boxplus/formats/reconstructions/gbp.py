"""Bundle adjustment problems as published with "Bundle Adjustment on a Graph Processor" (Ortiz et al., CVPR 2020)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.numbers.writer import write_rows
from boxplus.formats.output import atomic_file
from boxplus.formats.reconstructions.bal import check_indices
from boxplus.formats.reconstructions.bal_text import read_bal_text
from boxplus.manifolds import quaternion, so3


@dataclass(frozen=True, slots=True, eq=False)
class GbpProblem:
    """m calibrated cameras looking along +z, n points and k observations.

    Attributes:
        intrinsics: (4,) float64, fx, fy, cx, cy of all cameras [px].
        T_camera_world: (m, 7) float64, [qw, qx, qy, qz, x, y, z].
        points: (n, 3) float64, p_world [m].
        camera_of, point_of: (k,) int64, the camera and the point of each observation.
        pixels: (k, 2) float64, x to the right and y downwards [px].

    Raises:
        InputError: on construction, where an index is out of range.

    Example:
        >>> zero = np.zeros(1, int)
        >>> problem = bp.formats.GbpProblem(
        ...     intrinsics=np.array([500.0, 500.0, 320.0, 240.0]), T_camera_world=np.array([[1.0, 0, 0, 0, 0, 0, 0]]),
        ...     points=np.array([[0.0, 0.0, 4.0]]), camera_of=zero, point_of=zero, pixels=np.array([[320.0, 240.0]]),
        ... )
        >>> problem.T_camera_world.shape
        (1, 7)
    """

    intrinsics: NDArray[np.float64]
    T_camera_world: NDArray[np.float64]
    points: NDArray[np.float64]
    camera_of: NDArray[np.int64]
    point_of: NDArray[np.int64]
    pixels: NDArray[np.float64]

    def __post_init__(self) -> None:
        check_indices(self.camera_of, len(self.T_camera_world), self.point_of, len(self.points), "bundle adjustment problem")


def read_gbp(path: str | Path) -> GbpProblem:
    """Read such a file, plain or bzip2.

    It is a BAL file with comments, a second line `fx fy cx cy`, and cameras of six numbers: translation of T_camera_world,
    then the rotation vector.

    Raises:
        InputError: as `read_bal_text`.

    Example:
        >>> zero = np.zeros(1, int)
        >>> problem = bp.formats.GbpProblem(
        ...     intrinsics=np.array([500.0, 500.0, 320.0, 240.0]), T_camera_world=np.array([[1.0, 0, 0, 0, 0, 0, 0]]),
        ...     points=np.array([[0.0, 0.0, 4.0]]), camera_of=zero, point_of=zero, pixels=np.array([[320.0, 240.0]]),
        ... )
        >>> bp.formats.write_gbp("scene.gbp", problem)
        >>> bp.formats.read_gbp("scene.gbp").pixels.tolist()
        [[320.0, 240.0]]
    """
    header, camera_of, point_of, pixels, cameras, points = read_bal_text(path, 6, "the intrinsics fx fy cx cy", 4)
    poses = np.hstack([_quaternions(cameras[:, 3:]), cameras[:, :3]])
    return GbpProblem(header, poses, points, camera_of, point_of, pixels)


def _quaternions(rotation_vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Exp_q of (m, 3) rotation vectors (docs/manifolds.md), wxyz."""
    half = 0.5 * np.linalg.norm(rotation_vectors, axis=1, keepdims=True)
    return np.hstack([np.cos(half), 0.5 * np.sinc(half / np.pi) * rotation_vectors])


def write_gbp(path: str | Path, problem: GbpProblem) -> None:
    """Write such a file, without comments; it appears only when it is whole.

    Raises:
        OutputError: the file cannot be written.

    Example:
        >>> zero = np.zeros(1, int)
        >>> problem = bp.formats.GbpProblem(
        ...     intrinsics=np.array([500.0, 500.0, 320.0, 240.0]), T_camera_world=np.array([[1.0, 0, 0, 0, 0, 0, 0]]),
        ...     points=np.array([[0.0, 0.0, 4.0]]), camera_of=zero, point_of=zero, pixels=np.array([[320.0, 240.0]]),
        ... )
        >>> bp.formats.write_gbp("scene.gbp", problem)
        >>> bp.formats.read_gbp("scene.gbp").points.tolist()
        [[0.0, 0.0, 4.0]]
    """
    rotation = so3.log(quaternion.to_matrix(np.ascontiguousarray(problem.T_camera_world[:, :4])))
    with atomic_file(path) as file:
        file.write(f"{len(problem.T_camera_world)} {len(problem.points)} {len(problem.pixels)}\n".encode())
        write_rows(file, "", np.empty((1, 0), np.int64), problem.intrinsics[None])
        write_rows(file, "", np.column_stack([problem.camera_of, problem.point_of]), problem.pixels)
        for block in (np.hstack([problem.T_camera_world[:, 4:], rotation]), problem.points):
            numbers = block.reshape(-1, 1)
            write_rows(file, "", np.empty((len(numbers), 0), np.int64), numbers)
