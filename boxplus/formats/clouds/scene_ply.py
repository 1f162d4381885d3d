"""PLY files of scenes: coloured points, and edges between them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError
from boxplus.formats.output import atomic_file

_VERTEX = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])


def write_scene_ply(path: str | Path, points: ArrayLike, colors: ArrayLike, edges: ArrayLike | None = None) -> None:
    """Write a binary little-endian PLY file; it appears only when it is whole.

    Args:
        points: (n, 3) [m], kept as float64.
        colors: (n, 3) uint8, red, green, blue; or (3,) for all.
        edges: (m, 2) indices of the points they join, as elements `edge` with `vertex1` and `vertex2`.

    Raises:
        InputError: shapes that do not match, or an edge to a point that is not there.
        OutputError: the file cannot be written.

    Example:
        >>> bp.formats.write_scene_ply("scene.ply", np.eye(3), np.full((3, 3), 255, np.uint8), edges=[[0, 1]])
        >>> bp.formats.read_ply("scene.ply").points.shape
        (3, 3)
    """
    xyz = np.asarray(points, dtype=np.float64)
    rgb = np.asarray(colors, dtype=np.uint8)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or rgb.shape not in ((3,), xyz.shape):
        raise InputError("points (n, 3) and colors (n, 3) or (3,)", f"{xyz.shape} and {rgb.shape}", "give matching arrays")
    pairs: NDArray[np.int64] = np.asarray(edges if edges is not None else np.zeros((0, 2)), dtype=np.int64)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or (len(pairs) and (pairs.min() < 0 or pairs.max() >= len(xyz))):
        raise InputError(f"edges (m, 2) between points 0 to {len(xyz) - 1}", f"shape {pairs.shape}", "give indices of points")
    vertices = np.zeros(len(xyz), _VERTEX)
    for k, (axis, color) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        vertices[axis], vertices[color] = xyz[:, k], rgb[..., k]
    header = ["ply", "format binary_little_endian 1.0", "comment written by boxplus", f"element vertex {len(xyz)}"]
    header += [f"property double {name}" for name in "xyz"]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    if len(pairs):
        header += [f"element edge {len(pairs)}", "property int vertex1", "property int vertex2"]
    with atomic_file(path) as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode())
        file.write(vertices.tobytes())
        file.write(pairs.astype("<i4").tobytes())
