"""Multi-view line sets of the Visual Geometry Group, Oxford: cameras, segments, 3D lines and which segment shows which line.

A folder holds for every view a camera `*.P` (3 × 4, up to scale) and segments `*.lines` (x0 y0 x1 y1, then columns that are
not used), and for all views `*l3d` (x0 y0 z0 x1 y1 z1, a row a line) and `*nview-lines` (a row a line, a column a view: the
row of the segment in that view, or * where there is none). Points are there as well in most sets: `*.corners` (x y) of every
view, `*p3d` (x y z) and `*nview-corners`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from boxplus._arguments import as_path
from boxplus.errors import InputError
from boxplus.manifolds import quaternion


@dataclass(frozen=True, slots=True, eq=False)
class VggLines:
    """V views of L lines in N observations, and of P points in M.

    Attributes:
        names: of the views, their camera files without ending.
        K: (V, 3, 3) calibration matrices, upper triangular, K[2, 2] = 1, with skew [px].
        T_camera_world: (V, 7) wxyz and xyz, z forward.
        end_points_world: (L, 6) two points of each line.
        view_of, line_of: (N,) the view and the line of each observation.
        segments: (N, 4) u_start, v_start, u_end, v_end [px].
        points_world: (P, 3); none where the folder has no points.
        point_view_of, point_of: (M,) the view and the point of each observation of a point.
        pixels: (M, 2) [px].
        reflected: the files have the world behind the cameras, a mirror image; it was reflected through the origin, which no
            image shows, so that z is forward.

    Example:
        >>> K, turned = np.diag([500.0, 500.0, 1.0]), [1.0, 0, 0, 0]
        >>> views = np.array([[*turned, 0, 0, 4], [*turned, -1, 0, 4], [*turned, 0, -1, 4]])  # T_camera_world
        >>> ends = np.array([[-1.0, 0.5, 0.0, 1.0, 0.5, 0.5]])  # of one line, in the world
        >>> p = ends.reshape(2, 3) + views[:, None, 4:]
        >>> segments = (500.0 * p[..., :2] / p[..., 2:]).reshape(3, 4)
        >>> view_of, line_of = np.arange(3, dtype=np.uint32), np.zeros(3, np.uint32)
        >>> lines = bp.formats.VggLines(("a", "b", "c"), np.tile(K, (3, 1, 1)), views, ends, view_of, line_of, segments)
        >>> lines.segments.round(1)[0]
        array([-125. ,   62.5,  111.1,   55.6])
    """

    names: tuple[str, ...]
    K: NDArray[np.float64]
    T_camera_world: NDArray[np.float64]
    end_points_world: NDArray[np.float64]
    view_of: NDArray[np.uint32]
    line_of: NDArray[np.uint32]
    segments: NDArray[np.float64]
    points_world: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    point_view_of: NDArray[np.uint32] = field(default_factory=lambda: np.zeros(0, np.uint32))
    point_of: NDArray[np.uint32] = field(default_factory=lambda: np.zeros(0, np.uint32))
    pixels: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    reflected: bool = False


def read_vgg_lines(folder: str | Path) -> VggLines:
    """Read a line set.

    Where there are several files of matches (Corridor), the one with as many rows as there are 3D lines is read.

    Raises:
        InputError: a file is missing or a line of it malformed; the message names file and line number.

    Example:
        >>> lines = bp.formats.read_vgg_lines("Corridor")  # a folder as the group in Oxford publishes it
        >>> len(lines.names), len(lines.end_points_world), lines.segments.shape
        (6, 12, (72, 4))
    """
    root = as_path(folder, "a line set")
    if not root.is_dir():
        raise InputError("a folder with *.P, *.lines, *l3d and *nview-lines", f"{root}", "check the path")
    cameras = sorted(root.glob("*.P"))
    if not cameras:
        raise InputError("a camera file *.P for every view", f"none in {root}", "check the path")
    P = np.stack([_read_camera(file) for file in cameras])
    segments = [_read_table(_existing(file.with_suffix(".lines"), "segment"), 4) for file in cameras]
    lines = sorted(root.glob("*l3d"))
    if len(lines) != 1:
        raise InputError("one file *l3d of 3D lines", f"{len(lines)} in {root}", "check the path")
    end_points = _read_table(lines[0], 6)
    candidates = sorted(root.glob("*nview-lines"))
    matches = [file for file in candidates if sum(1 for _ in _rows(file)) == len(end_points)]
    if len(matches) != 1:
        raise InputError(
            f"one file *nview-lines with {len(end_points)} rows, one for each 3D line",
            f"{len(matches)} of {[file.name for file in candidates]} in {root}",
            "remove the files of another reconstruction",
        )
    view_of, line_of, observed = _read_matches(matches[0], segments, "segment")
    points, point_view_of, point_of, pixels = _read_points(root, cameras)
    K, T_camera_world = _decompose(P)
    # A camera matrix is known up to its sign, and so is which side of a camera the world lies on.
    R = quaternion.to_matrix(T_camera_world[:, :4].copy())
    middle = 0.5 * (end_points[:, :3] + end_points[:, 3:])[line_of]
    depth = np.einsum("ni,ni->n", R[view_of, 2], middle) + T_camera_world[view_of, 6]
    reflected = bool(len(depth) and np.median(depth) < 0.0)
    if reflected:
        T_camera_world[:, 4:] *= -1.0
        end_points, points = -end_points, -points
    return VggLines(
        names=tuple(file.stem for file in cameras),
        K=K,
        T_camera_world=T_camera_world,
        end_points_world=end_points,
        view_of=view_of,
        line_of=line_of,
        segments=observed.reshape(-1, 4),
        points_world=points,
        point_view_of=point_view_of,
        point_of=point_of,
        pixels=pixels.reshape(-1, 2),
        reflected=reflected,
    )


def _read_points(
    root: Path, cameras: list[Path]
) -> tuple[NDArray[np.float64], NDArray[np.uint32], NDArray[np.uint32], NDArray[np.float64]]:
    """Points, and view, point and pixel of each of their observations; nothing where the folder has no points."""
    points, matches = sorted(root.glob("*p3d")), sorted(root.glob("*nview-corners"))
    if not points and not matches:
        return np.zeros((0, 3)), np.zeros(0, np.uint32), np.zeros(0, np.uint32), np.zeros((0, 2))
    if len(points) != 1 or len(matches) != 1:
        raise InputError(
            "one file *p3d of points and one *nview-corners of their matches, or neither",
            f"{len(points)} and {len(matches)} in {root}",
            "remove the files of another reconstruction",
        )
    p_world = _read_table(points[0], 3)
    corners = [_read_table(_existing(file.with_suffix(".corners"), "corner"), 2) for file in cameras]
    view_of, point_of, pixels = _read_matches(matches[0], corners, "corner")
    count = sum(1 for _ in _rows(matches[0]))
    if count != len(p_world):
        raise InputError(f"{len(p_world)} rows in {matches[0].name}, one for each point", f"{count}", "take both files anew")
    return p_world, view_of, point_of, pixels


def _existing(file: Path, kind: str) -> Path:
    if not file.is_file():
        raise InputError(f"the {kind}s of the view in {file.name}", "no such file", "put it beside the camera file")
    return file


def _rows(file: Path) -> Iterator[tuple[int, list[str]]]:
    """Line number, from 1, and words of every line that is not empty."""
    for number, line in enumerate(file.read_text(encoding="ascii", errors="replace").splitlines(), start=1):
        words = line.split()
        if words:
            yield number, words


def _read_table(file: Path, columns: int) -> NDArray[np.float64]:
    """(n, columns): the first numbers of every line."""
    table = []
    for number, words in _rows(file):
        try:
            row = [float(word) for word in words[:columns]]
        except ValueError:
            row = []
        if len(row) < columns or not np.isfinite(row).all():
            raise InputError(
                f"{columns} numbers", f"{' '.join(words)!r} ({file}, line {number})", "repair the line or take the file anew"
            )
        table.append(row)
    return np.array(table, dtype=np.float64).reshape(-1, columns)


def _read_camera(file: Path) -> NDArray[np.float64]:
    P = _read_table(file, 4)
    if P.shape != (3, 4) or np.linalg.matrix_rank(P[:, :3]) < 3:
        raise InputError(
            "a projection matrix of 3 × 4 numbers, the left 3 × 3 regular", f"shape {P.shape} ({file})", "check the file"
        )
    return P


def _read_matches(
    file: Path, features: list[NDArray[np.float64]], kind: str
) -> tuple[NDArray[np.uint32], NDArray[np.uint32], NDArray[np.float64]]:
    view_of, line_of, observed = [], [], []
    for line, (number, words) in enumerate(_rows(file)):
        is_match = [word == "*" or word.isdecimal() for word in words]
        if len(words) != len(features) or not all(is_match):
            raise InputError(
                f"{len(features)} row numbers or *, one for each view",
                f"{' '.join(words)!r} ({file}, line {number})",
                "repair the line or take the file anew",
            )
        for view, word in enumerate(words):
            if word == "*":
                continue
            if int(word) >= len(features[view]):
                raise InputError(
                    f"a {kind} from 0 to {len(features[view]) - 1} in view {view}",
                    f"{word} ({file}, line {number})",
                    f"the matches belong to other {kind}s",
                )
            view_of.append(view)
            line_of.append(line)
            observed.append(features[view][int(word)])
    return np.array(view_of, np.uint32), np.array(line_of, np.uint32), np.array(observed, np.float64)


def _decompose(P: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """K (V, 3, 3) and T_camera_world (V, 7) with P ~ K [R t], focal lengths positive, R a rotation."""
    K, poses = np.empty((len(P), 3, 3)), np.empty((len(P), 7))
    for v, given in enumerate(P):
        signed = given * np.sign(np.linalg.det(given[:, :3]))  # P is known up to scale, also a negative one
        upper, orthogonal = scipy.linalg.rq(signed[:, :3])
        signs = np.sign(np.diag(upper))
        upper, R = upper * signs, signs[:, None] * orthogonal
        poses[v, :4] = quaternion.from_matrix(R)
        poses[v, 4:] = scipy.linalg.solve_triangular(upper, signed[:, 3])
        K[v] = np.triu(upper) / upper[2, 2]
    return K, poses
