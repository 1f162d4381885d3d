"""A made-up house of lines and points, seen from around it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from boxplus.formats.reconstructions.vgg_lines import VggLines
from boxplus.manifolds import quaternion
from boxplus.manifolds.se3 import SE3Left

K = np.array([[600.0, 4.0, 320.0], [0.0, 610.0, 240.0], [0.0, 0.0, 1.0]])


def looking(places: np.ndarray, target: np.ndarray) -> np.ndarray:
    """T_camera_world (V, 7) of cameras at `places` (V, 3) that look at a point, v downwards."""
    poses = []
    for place in places:
        z = (target - place) / np.linalg.norm(target - place)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z])
        poses.append([*quaternion.from_matrix(R), *(-R @ place)])
    return np.array(poses)


def project(poses: np.ndarray, views: np.ndarray, p_world: np.ndarray) -> np.ndarray:
    R = quaternion.to_matrix(np.ascontiguousarray(poses[views, :4]))
    image = (np.einsum("nij,nj->ni", R, p_world) + poses[views, 4:]) @ K.T
    return image[:, :2] / image[:, 2:]


def seen(poses: np.ndarray, ends: np.ndarray, points: np.ndarray, noise_px: float, seed: int) -> VggLines:
    """All lines (L, 6) and points (P, 3) in all views."""
    random = np.random.default_rng(seed)
    views, lines = (grid.ravel() for grid in np.mgrid[: len(poses), : len(ends)])
    segments = np.hstack([project(poses, views, ends[lines, k : k + 3]) for k in (0, 3)])
    point_views, point_of = (grid.ravel() for grid in np.mgrid[: len(poses), : len(points)])
    pixels = project(poses, point_views, points[point_of])
    return VggLines(
        names=tuple(f"{view:03d}" for view in range(len(poses))),
        K=np.tile(K, (len(poses), 1, 1)),
        T_camera_world=poses,
        end_points_world=ends,
        view_of=views.astype(np.uint32),
        line_of=lines.astype(np.uint32),
        segments=segments + random.normal(0.0, noise_px, segments.shape),
        points_world=points,
        point_view_of=point_views.astype(np.uint32),
        point_of=point_of.astype(np.uint32),
        pixels=pixels + random.normal(0.0, noise_px, pixels.shape),
    )


def house(seed: int = 0, noise_px: float = 0.2, views: int = 7) -> VggLines:
    random = np.random.default_rng(seed)
    angle = np.linspace(-0.6, 0.6, views)
    places = np.column_stack([10.0 * np.sin(angle), -10.0 * np.cos(angle), 2.0 + 0.7 * np.sin(3.0 * angle)])
    ends = random.uniform(-2.5, 2.5, (15, 6))
    ends[:, 3:] = ends[:, :3] + random.normal(size=(15, 3)) * 1.5
    return seen(looking(places, np.zeros(3)), ends, random.uniform(-2.5, 2.5, (20, 3)), noise_px, seed)


def perturbed(data: VggLines, seed: int, share: float = 0.01) -> VggLines:
    """Cameras off by `share` radians and of the distance, lines and points as well."""
    random = np.random.default_rng(seed + 50)
    sigma = share * np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
    poses = SE3Left.boxplus(data.T_camera_world, sigma * random.normal(size=(len(data.names), 6)))
    return replace(
        data,
        T_camera_world=poses,
        end_points_world=data.end_points_world + 10.0 * share * random.normal(size=data.end_points_world.shape),
        points_world=data.points_world + 10.0 * share * random.normal(size=data.points_world.shape),
    )


def turning(seed: int, baseline: float, noise_px: float = 0.2, views: int = 7) -> VggLines:
    """The house from cameras `baseline` around one place, 10 m away, that look at different points of it."""
    random = np.random.default_rng(seed)
    places = np.array([0.0, -10.0, 2.0]) + baseline * random.normal(size=(views, 3))
    targets = random.uniform(-1.0, 1.0, (views, 3))
    poses = np.vstack([looking(place[None], target) for place, target in zip(places, targets, strict=True)])
    ends = random.uniform(-2.5, 2.5, (15, 6))
    ends[:, 3:] = ends[:, :3] + random.normal(size=(15, 3)) * 1.5
    return seen(poses, ends, random.uniform(-2.5, 2.5, (20, 3)), noise_px, seed)
