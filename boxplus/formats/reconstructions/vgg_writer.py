"""Line sets of the Visual Geometry Group as files, in the form that `read_vgg_lines` reads."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.output import atomic_file, make_folder
from boxplus.formats.reconstructions.vgg_lines import VggLines
from boxplus.manifolds import quaternion


def write_vgg_lines(folder: str | Path, data: VggLines) -> Path:
    """Write cameras, segments, lines and their matches, and points where there are any; every file appears when it is whole.

    Each observation gets a feature of its own: what was seen and not matched is not part of `VggLines`.

    Raises:
        OutputError: a file cannot be written.
    """
    root = make_folder(folder)
    R = quaternion.to_matrix(np.ascontiguousarray(data.T_camera_world[:, :4]))
    P = data.K @ np.concatenate([R, data.T_camera_world[:, 4:, None]], axis=2)
    for name, camera in zip(data.names, P, strict=True):
        _write(root / f"{name}.P", camera)
    _features(root, data, "lines", data.segments, data.view_of, data.line_of, len(data.end_points_world))
    _write(root / "l3d", data.end_points_world)
    if len(data.points_world):
        _features(root, data, "corners", data.pixels, data.point_view_of, data.point_of, len(data.points_world))
        _write(root / "p3d", data.points_world)
    return root


def _features(
    root: Path,
    data: VggLines,
    kind: str,
    values: NDArray[np.float64],
    view_of: NDArray[np.uint32],
    feature_of: NDArray[np.uint32],
    count: int,
) -> None:
    """One file of features a view, and the table of matches."""
    table = np.full((count, len(data.names)), "*", dtype=object)
    for view, name in enumerate(data.names):
        rows = np.flatnonzero(view_of == view)
        _write(root / f"{name}.{kind}", values[rows])
        table[feature_of[rows], view] = [str(row) for row in range(len(rows))]
    _lines(root / f"nview-{kind}", (" ".join(row) for row in table.tolist()))


def _write(path: Path, table: NDArray[np.float64]) -> None:
    _lines(path, (" ".join(map(repr, row)) for row in table.tolist()))


def _lines(path: Path, lines: Iterable[str]) -> None:
    with atomic_file(path) as file:
        file.write("".join(f"{line}\n" for line in lines).encode())
