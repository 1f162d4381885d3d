"""Scenes for bundle adjustment with what goes wrong in them: points behind cameras, cameras turned around or in one place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from boxplus.formats.reconstructions.bal import BalProblem
from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.formats.reconstructions.gbp import GbpProblem
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.manifolds import quaternion, so3
from boxplus.manifolds.se3 import SE3Left
from boxplus.systems.bundle_adjustment.bundle_adjustment import adjust_bundle
from boxplus.systems.bundle_adjustment.sightings import Sightings
from tests.small_problems import in_camera, scene

FOCAL, SIGMA = 500.0, 0.5
FORMATS = ("bal", "gbp", "colmap")


def reconstruction(
    seed: int, format: str = "gbp", *, cameras: int = 8, points: int = 150, share: float = 0.6, sigma: float = SIGMA
) -> Reconstruction:
    """Cameras half around a cloud, each seeing a share of the points, perturbed."""
    rng = np.random.default_rng([seed, 1])
    T, p, camera_of, point_of = scene(seed, cameras, points)
    seen = rng.random(len(camera_of)) < share
    camera_of, point_of = camera_of[seen], point_of[seen]
    return perturbed(rng, T, p, camera_of, point_of, format, 0.02, 0.05, sigma)


def turning(
    seed: int, baseline: float, format: str = "gbp", *, sigma: float = SIGMA, cameras: int = 6, points: int = 60
) -> Reconstruction:
    """Cameras `baseline` around one place that look in nearly the same direction at points 4 to 12 m away."""
    rng = np.random.default_rng([seed, 2])
    z = rng.uniform(4.0, 12.0, points)
    p = np.column_stack([rng.uniform(-0.3, 0.3, (points, 2)) * z[:, None], z])
    R = so3.exp(rng.uniform(-0.15, 0.15, (cameras, 3)))
    center = rng.normal(size=(cameras, 3))
    center *= baseline / np.linalg.norm(center, axis=1, keepdims=True)
    T = np.hstack([quaternion.from_matrix(R), -np.einsum("nij,nj->ni", R, center)])
    camera_of, point_of = (grid.ravel() for grid in np.mgrid[:cameras, :points])
    return perturbed(rng, T, p, camera_of, point_of, format, 0.005, 0.05, sigma)


def perturbed(rng, T, p, camera_of, point_of, format, off_pose, off_point, sigma=SIGMA) -> Reconstruction:
    """With noisy pixels and a start beside the truth."""
    P = in_camera(T[camera_of], p[point_of])
    pixels = FOCAL * P[:, :2] / P[:, 2:] + sigma * rng.standard_normal((len(P), 2))
    T = SE3Left.boxplus(T, off_pose * rng.standard_normal((len(T), 6)))
    start = p + off_point * rng.standard_normal(p.shape)
    if format == "bal":
        half_turn = np.array([1.0, -1.0, -1.0])
        R = quaternion.to_matrix(T[:, :4]) * half_turn[:, None]
        cameras = np.hstack([so3.log(R), T[:, 4:] * half_turn, np.tile([FOCAL, 0.0, 0.0], (len(T), 1))])
        return BalProblem(cameras, start, camera_of, point_of, pixels * [1.0, -1.0])
    if format == "gbp":
        return GbpProblem(np.array([FOCAL, FOCAL, 0.0, 0.0]), T, start, camera_of, point_of, pixels)
    return ColmapModel(
        camera_ids=np.array([3]),
        camera_models=("PINHOLE",),
        camera_sizes=np.array([[640, 480]]),
        camera_params=(np.array([FOCAL, FOCAL, 0.0, 0.0]),),
        image_ids=np.arange(100, 100 + len(T)),
        image_names=tuple(f"{k}.png" for k in range(len(T))),
        camera_of=np.zeros(len(T), dtype=np.int64),
        T_camera_world=T,
        point_ids=np.arange(1000, 1000 + len(p)),
        points=start,
        colors=np.zeros((len(p), 3), np.uint8),
        errors=np.full(len(p), -1.0),
        image_of=camera_of,
        point_of=point_of,
        pixels=pixels,
    )


def with_points_behind(start: Reconstruction, share: float, kind: str, seed: int) -> tuple[Reconstruction, np.ndarray]:
    """A share of the points put behind cameras: mirrored at one that sees them, or somewhere beyond all of them."""
    rng, sightings = np.random.default_rng([seed, 3]), Sightings.of(start)
    seen = np.unique(sightings.point_of)
    bad = np.sort(rng.choice(seen, max(1, int(share * len(seen))), replace=False))
    points = start.points.copy()
    for k in bad:
        centers = sightings.centers[sightings.camera_of[sightings.point_of == k]]
        points[k] = 2.0 * centers[0] - points[k] if kind == "mirrored" else centers.mean(axis=0) * rng.uniform(1.3, 4.0)
    return replace(start, points=points), bad


def turned_around(start: BalProblem | GbpProblem | ColmapModel, chosen: np.ndarray) -> Reconstruction:
    """Cameras that look the other way, from where they are."""
    turn = np.array([-1.0, 1.0, -1.0])
    if isinstance(start, BalProblem):
        cameras = start.cameras.copy()
        cameras[chosen, :3] = so3.log(so3.exp(cameras[chosen, :3]) * turn[:, None])
        cameras[chosen, 3:6] *= turn
        return replace(start, cameras=cameras)
    T = start.T_camera_world.copy()
    T[chosen, :4] = quaternion.from_matrix(quaternion.to_matrix(np.ascontiguousarray(T[chosen, :4])) * turn[:, None])
    T[chosen, 4:] *= turn
    return replace(start, T_camera_world=T)


def note_of(start: Reconstruction, beginning: str, **settings) -> str:
    notes = adjust_bundle(start, **settings).notes
    found = [note for note in notes if beginning in note]
    assert len(found) == 1, notes
    return found[0]
