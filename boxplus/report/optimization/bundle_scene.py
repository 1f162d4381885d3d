"""What is drawn of a reconstruction: points with their errors, cameras, and which way is up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.reconstructions.bal import BalProblem
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.manifolds import quaternion, so3
from boxplus.systems.bundle_adjustment.reconstruction_problem import mean_error_of_points

_MOST_POINTS = 40_000


@dataclass(frozen=True, slots=True)
class BundleScene:
    """A reconstruction as it is drawn.

    Attributes:
        centers: (m, 3) of the cameras, world frame.
        forward, up: (m, 3) where each camera looks, and what is up in its image.
        points: (n, 3) world frame.
        point_errors: (n,) mean reprojection error of each [px], NaN where none is valid.
    """

    centers: NDArray[np.float64]
    forward: NDArray[np.float64]
    up: NDArray[np.float64]
    points: NDArray[np.float64]
    point_errors: NDArray[np.float64]


def scene_of(reconstruction: Reconstruction, errors: NDArray[np.float64], point_of: NDArray[np.int64]) -> BundleScene:
    """The scene, from (k,) errors [px] of the observations and the point of each."""
    R, t = _poses(reconstruction)
    looks_back = isinstance(reconstruction, BalProblem)  # BAL's cameras look along −z with y up, all others along z with y down
    sign = -1.0 if looks_back else 1.0
    return BundleScene(
        centers=-np.einsum("nji,nj->ni", R, t),
        forward=sign * R[:, 2],
        up=-sign * R[:, 1],
        points=reconstruction.points,
        point_errors=mean_error_of_points(len(reconstruction.points), errors, point_of),
    )


def camera_centers(reconstruction: Reconstruction) -> NDArray[np.float64]:
    """(m, 3) centres of the cameras, world frame."""
    R, t = _poses(reconstruction)
    return np.asarray(-np.einsum("nji,nj->ni", R, t))


def _poses(reconstruction: Reconstruction) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """R_camera_world (m, 3, 3) and the translations (m, 3)."""
    if isinstance(reconstruction, BalProblem):
        return so3.exp(reconstruction.cameras[:, :3]), reconstruction.cameras[:, 3:6]
    T = reconstruction.T_camera_world
    return quaternion.to_matrix(np.ascontiguousarray(T[:, :4])), T[:, 4:]


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """From where scenes before and after are drawn, alike.

    Attributes:
        up: (3,) mean of what is up in the images.
        right, depth: (3,) the horizontal axes of the view from above, `depth` away from the cameras.
        low, high: (3,) corners of a box that holds the cameras and nearly all points.
        error_range: what the colours of the points span [px].
    """

    up: NDArray[np.float64]
    right: NDArray[np.float64]
    depth: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    error_range: tuple[float, float]

    @classmethod
    def of(cls, before: BundleScene, after: BundleScene) -> Viewpoint:
        up = _unit(after.up.mean(axis=0), np.array([0.0, 0.0, 1.0]))
        gaze = np.median(after.points, axis=0) - after.centers.mean(axis=0)
        depth = _unit(gaze - up * (up @ gaze), np.cross(up, [1.0, 0.0, 0.0]))
        depth = _unit(depth - up * (up @ depth), np.cross(up, [0.0, 1.0, 0.0]))
        low, high = np.percentile(after.points, [2.0, 98.0], axis=0)
        low, high = np.minimum(low, after.centers.min(axis=0)), np.maximum(high, after.centers.max(axis=0))
        margin = 0.05 * float((high - low).max()) + 1e-9
        known = np.concatenate([scene.point_errors[np.isfinite(scene.point_errors)] for scene in (before, after)])
        known = known[known > 0.0]
        bottom, top = np.percentile(known, [5.0, 97.0]) if len(known) else (0.1, 1.0)
        return cls(up, np.cross(depth, up), depth, low - margin, high + margin, (float(bottom), float(max(top, 1.01 * bottom))))

    def inside(self, scene: BundleScene) -> NDArray[np.bool_]:
        """(n,) which points lie within the box."""
        return np.asarray(((scene.points >= self.low) & (scene.points <= self.high)).all(axis=1))

    def shown(self, scene: BundleScene) -> NDArray[np.intp]:
        """The points within the box, an even selection where they are many."""
        inside = np.flatnonzero(self.inside(scene))
        return inside[:: max(1, -(-len(inside) // _MOST_POINTS))]


def frustum_lines(scene: BundleScene, size: float) -> NDArray[np.float64]:
    """(m, 10, 3) points of a line that draws a pyramid for every camera, NaN at its end."""
    right = np.cross(scene.forward, scene.up)
    corners = [
        scene.centers + size * (scene.forward + 0.6 * horizontal * right + 0.45 * vertical * scene.up)
        for horizontal, vertical in ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
    ]
    c, (p0, p1, p2, p3) = scene.centers, corners
    path = np.stack([c, p0, p1, c, p2, p1, p2, p3, c, p0, p3, np.full_like(c, np.nan)], axis=1)
    return np.asarray(path)


def _unit(vector: NDArray[np.float64], otherwise: NDArray[np.float64]) -> NDArray[np.float64]:
    length = float(np.linalg.norm(vector))
    if length > 1e-6:
        return np.asarray(vector / length)
    return np.asarray(otherwise / max(float(np.linalg.norm(otherwise)), 1e-12))
