"""Lines from their segments in posed images, and why some cannot be had (Bartoli and Sturm, 2005, section 4.1).

A segment and the centre of its camera span a plane π = [n; −n·c]; the line lies in all planes of its segments. With the unit
normals nᵢ in the rows of N, its direction is where ‖N d‖ is least, and a point of it where Σ (nᵢ·(p − cᵢ))² is. The second
singular value of N says how far the planes are from being one: it is small where the cameras stay in one plane with the line,
above all where they move along it, and where the line is far away. What the noise of the end points makes of it decides.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.manifolds import lines as line_manifold
from boxplus.manifolds import quaternion

Floats = NDArray[np.float64]
LineState = Literal["found", "too short", "one view", "along the line", "behind", "disagrees"]

_SURE = 3.0  # times its standard deviation is the angle between the planes that determines a line
_DISAGREES = 6.0  # standard deviations of an end point from the line, root mean square

_SHORT_PX = 1.0  # [px] a segment below that has no direction

REASONS: dict[LineState, str] = {
    "too short": "of which all segments are shorter than 1 px and have no direction; they are left out, as they were given",
    "one view": "seen in one view only, which gives a plane and not a line",
    "along the line": "seen from cameras that move along them or in one plane with them: their planes are one within the noise",
    "behind": "behind cameras that see them",
    "disagrees": "not explained by any one line: segments of different lines are matched",
}


@dataclass(frozen=True, slots=True, eq=False)
class LineTriangulation:
    """Lines from segments.

    Attributes:
        lines: (L, 5) on `Line3D`; NaN where there is none.
        end_points_world: (L, 6) the middle ones of the ends that the segments give; NaN where there is none.
        states: (L,) `found`, or why not.
        angle, angle_std: (L,) between the planes: root mean square of their normals off the best plane of normals through the
            line, and its standard deviation by the noise of the end points [rad].

    Example:
        >>> from boxplus.systems.bundle_adjustment import triangulate_lines
        >>> data = bp.formats.read_vgg_lines("Corridor")
        >>> count = len(data.end_points_world)
        >>> found = triangulate_lines(data.K, data.T_camera_world, data.segments, data.view_of, data.line_of, count)
        >>> sorted(set(found.states)), found.lines.shape == (count, 5)
        (['found'], True)
    """

    lines: Floats
    end_points_world: Floats
    states: tuple[LineState, ...]
    angle: Floats
    angle_std: Floats

    @property
    def found(self) -> NDArray[np.bool_]:
        """(L,) which lines there are."""
        return np.array([state == "found" for state in self.states], dtype=np.bool_)

    def notes(self, states: Collection[LineState] = tuple(REASONS)) -> list[str]:
        """A sentence for each of these reasons why lines are not determined, with their numbers."""
        said = []
        for state, reason in REASONS.items():
            rows = [row for row, found in enumerate(self.states) if found == state]
            if rows and state in states:
                listed = ", ".join(map(str, rows[:10])) + (", …" if len(rows) > 10 else "")
                what = "1 line is" if len(rows) == 1 else f"{len(rows)} lines are"
                said.append(f"{what} not determined, {reason}: {listed}")
        return said


def triangulate_lines(
    K: ArrayLike,
    T_camera_world: ArrayLike,
    segments: ArrayLike,
    view_of: ArrayLike,
    line_of: ArrayLike,
    count: int,
    sigma_px: float = 1.0,
) -> LineTriangulation:
    """Lines from segments in images with known cameras.

    Args:
        K: (V, 3, 3) calibration matrices, K[2, 2] = 1 [px].
        T_camera_world: (V, 7) wxyz and xyz, world to camera.
        segments: (N, 4) end points u v u v, without distortion [px].
        view_of, line_of: (N,) the view and the line of each segment.
        count: number of lines L.
        sigma_px: standard deviation of an end point across its segment [px].

    Raises:
        InputError: arrays that do not match, or indices beyond them.

    Example:
        >>> from boxplus.systems.bundle_adjustment import triangulate_lines
        >>> K = np.tile([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]], (2, 1, 1))
        >>> T = [[1.0, 0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, -1.0, 0, 0]]           # the second camera stands 1 m to the right
        >>> upright = [[320.0, 115.0, 320.0, 365.0], [195.0, 115.0, 195.0, 365.0]]
        >>> level = [[195.0, 240.0, 445.0, 240.0], [70.0, 240.0, 320.0, 240.0]]
        >>> triangulate_lines(K, T, upright + level, [0, 1, 0, 1], [0, 0, 1, 1], 2).states
        ('found', 'along the line')
    """
    K, poses, seen = as_floats(K, "K"), as_floats(T_camera_world, "T_camera_world"), as_floats(segments, "segments")
    views, rows = np.asarray(view_of, dtype=np.int64).ravel(), np.asarray(line_of, dtype=np.int64).ravel()
    fits = K.shape == (len(poses), 3, 3) and poses.shape == (len(poses), 7) and seen.shape == (len(views), 4)
    if not fits or rows.shape != views.shape:
        raise InputError(
            "K (V, 3, 3), T_camera_world (V, 7), segments (N, 4), view_of and line_of (N,)",
            f"shapes {K.shape}, {poses.shape}, {seen.shape}, {views.shape} and {rows.shape}",
            "give one row for each segment",
        )
    if len(views) and (views.min() < 0 or views.max() >= len(poses) or rows.min() < 0 or rows.max() >= count):
        raise InputError(
            f"views from 0 to {len(poses) - 1} and lines from 0 to {count - 1}", "an index beyond them", "count from zero"
        )
    long = have_direction(seen)
    planes = _planes(K, poses, seen, views)
    lines, ends = np.full((count, 5), np.nan), np.full((count, 6), np.nan)
    angle, angle_std = np.full(count, np.nan), np.full(count, np.nan)
    states: list[LineState] = ["one view"] * count
    order = np.argsort(rows, kind="stable")
    bounds = np.searchsorted(rows[order], np.arange(count + 1))
    for line in range(count):
        shown = order[bounds[line] : bounds[line + 1]]
        own = shown[long[shown]]
        if len(shown) and not len(own):
            states[line] = "too short"
        if len(np.unique(views[own])) < 2:
            continue
        states[line] = _triangulate(planes.of(own), sigma_px, line, lines, ends, angle, angle_std)
    return LineTriangulation(lines, ends, tuple(states), angle, angle_std)


def have_direction(segments: Floats) -> NDArray[np.bool_]:
    """(N,) which of the segments (N, 4) are long enough to have one."""
    return np.asarray(np.hypot(*(segments[:, 2:] - segments[:, :2]).T) >= _SHORT_PX)


@dataclass(frozen=True, slots=True, eq=False)
class _Planes:
    """For each segment, in the world.

    Attributes:
        normals, centres: (N, 3) of the plane, and of its camera.
        rays: (N, 2, 3) unit vectors to both ends.
        tilt, turn: (N,) by how much a pixel of noise of each end tilts the plane about the segment, and turns it about the
            ray to the segment's middle [rad].
    """

    normals: Floats
    centres: Floats
    rays: Floats
    tilt: Floats
    turn: Floats

    def of(self, rows: NDArray[np.int64]) -> _Planes:
        """Those of some segments."""
        return _Planes(self.normals[rows], self.centres[rows], self.rays[rows], self.tilt[rows], self.turn[rows])

    def std_across(self, direction: Floats) -> Floats:
        """(N,) what a pixel of noise does to the normals across a line of this direction [rad]."""
        middle = self.rays.mean(axis=1)
        cosine = middle @ direction / np.linalg.norm(middle, axis=1)
        std: Floats = np.sqrt(self.tilt**2 * (1.0 - cosine**2) + self.turn**2 * cosine**2)
        return std


def _planes(K: Floats, poses: Floats, segments: Floats, views: NDArray[np.int64]) -> _Planes:
    R = quaternion.to_matrix(np.ascontiguousarray(poses[:, :4]))
    centres = -np.einsum("vji,vj->vi", R, poses[:, 4:])
    ends = segments.reshape(-1, 2, 2)
    image = np.concatenate([ends, np.ones((len(ends), 2, 1))], axis=2)
    rays = np.einsum("nij,nkj->nki", np.linalg.inv(K)[views], image)
    rays = np.einsum("nji,nkj->nki", R[views], rays)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    normals = np.cross(rays[:, 0], rays[:, 1])
    length = np.linalg.norm(normals, axis=1)
    pixel = 1.0 / np.sqrt(K[views, 0, 0] * K[views, 1, 1])
    tilt, turn = np.sqrt(0.5) * pixel, np.sqrt(2.0) * pixel / np.maximum(length, 1e-9)
    return _Planes(normals / np.maximum(length, 1e-12)[:, None], centres[views], rays, tilt, turn)


def _triangulate(
    planes: _Planes, sigma_px: float, line: int, lines: Floats, ends: Floats, angle: Floats, angle_std: Floats
) -> LineState:
    count = len(planes.normals)
    _, values, Vt = np.linalg.svd(planes.normals)
    direction = Vt[2]
    angle[line] = values[1] / np.sqrt(count)
    angle_std[line] = sigma_px * float(np.sqrt(np.mean(planes.std_across(direction) ** 2)))
    if not angle[line] > _SURE * angle_std[line]:
        return "along the line"
    # The point nearest to the cameras: the direction itself is not determined by the planes.
    middle = planes.centres.mean(axis=0)
    offsets = np.einsum("ni,ni->n", planes.normals, planes.centres - middle)
    across = Vt[:2]
    local, *_ = np.linalg.lstsq(planes.normals @ across.T, offsets, rcond=None)
    point = middle + local @ across
    along = _along(point, direction, planes)
    depth = np.einsum("nki,nki->nk", planes.rays, point + along[..., None] * direction - planes.centres[:, None])
    if (depth <= 0.0).any():
        return "behind"
    # The distance of the segments' ends from the line that was found, in pixels.
    nearest = point + along[..., None] * direction - planes.centres[:, None]
    error = np.einsum("nki,ni->nk", nearest / np.linalg.norm(nearest, axis=2, keepdims=True), planes.normals)
    if np.sqrt(np.mean((error / (np.sqrt(2.0) * planes.tilt[:, None])) ** 2)) > _DISAGREES * sigma_px:
        return "disagrees"
    low, high = (float(np.median(pick(along, axis=1))) for pick in (np.min, np.max))
    ends[line, :3], ends[line, 3:] = point + low * direction, point + high * direction
    lines[line] = line_manifold.from_points(ends[line, :3], ends[line, 3:])
    return "found"


def _along(point: Floats, direction: Floats, planes: _Planes) -> Floats:
    """(N, 2) where on the line the rays to both ends of every segment pass it nearest."""
    offset = point - planes.centres[:, None]
    cosine = planes.rays @ direction
    a = np.einsum("nki,nki->nk", planes.rays, np.broadcast_to(offset, planes.rays.shape))
    b = offset @ direction
    nearest: Floats = (cosine * a - b) / np.maximum(1.0 - cosine * cosine, 1e-12)
    return nearest
