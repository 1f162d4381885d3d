"""Bundle adjustment problems and pose graphs small enough for a test, with known answers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from boxplus.cameras.distortion import Radial, RadialTangential
from boxplus.cameras.pinhole import Pinhole
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.formats.reconstructions.bal import BalProblem
from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.formats.reconstructions.gbp import GbpProblem
from boxplus.manifolds import quaternion, se2, se3, so3
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3, SE3Left

SIGMA_PX = 0.5
PARAMS = {
    "SIMPLE_PINHOLE": [500.0, 320.0, 240.0],
    "PINHOLE": [500.0, 505.0, 320.0, 240.0],
    "SIMPLE_RADIAL": [500.0, 320.0, 240.0, 0.05],
    "RADIAL": [500.0, 320.0, 240.0, 0.05, -0.02],
    "OPENCV": [500.0, 505.0, 320.0, 240.0, 0.05, -0.02, 0.001, -0.002],
}


def scene(seed: int = 0, cameras: int = 6, points: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """T_camera_world (m, 7) of cameras half around a cloud of points, points (n, 3), camera and point of each observation."""
    rng = np.random.default_rng(seed)
    p_world = rng.uniform(-2.0, 2.0, (points, 3))
    angle = np.linspace(-1.2, 1.2, cameras)
    vectors = np.stack([0.1 * rng.standard_normal(cameras), angle, 0.1 * rng.standard_normal(cameras)], axis=1)
    T = np.hstack([quaternion.from_matrix(so3.exp(vectors)), np.tile([0.0, 0.0, 9.0], (cameras, 1))])
    camera_of, point_of = (grid.ravel() for grid in np.mgrid[:cameras, :points])
    return T, p_world, camera_of, point_of


def in_camera(T: np.ndarray, p_world: np.ndarray) -> np.ndarray:
    """Points (k, 3) in the frames of their cameras."""
    return np.einsum("nij,nj->ni", quaternion.to_matrix(np.ascontiguousarray(T[:, :4])), p_world) + T[:, 4:]


def pinhole(model: str, params: list[float]) -> Pinhole:
    """The camera of one of COLMAP's models."""
    one = model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
    fx, fy, rest = (params[0], params[0], params[1:]) if one else (params[0], params[1], params[2:])
    k = list(rest[2:])
    distortion = None if not k else RadialTangential(*k) if len(k) == 4 else Radial(k[0], k[1] if len(k) > 1 else 0.0)
    return Pinhole(fx, fy, rest[0], rest[1], distortion)


def colmap_model(model: str = "SIMPLE_RADIAL", format: str = "text", off: float = 1.0) -> ColmapModel:
    """Poses and points are perturbed `off` times; every eleventh observation belongs to no point."""
    rng = np.random.default_rng(1)
    T, p_world, camera_of, point_of = scene()
    pixels, seen = pinhole(model, PARAMS[model]).project(in_camera(T[camera_of], p_world[point_of]))
    assert seen.all()
    measured = pixels + SIGMA_PX * rng.standard_normal(pixels.shape)
    start = PARAMS[model].copy()
    start[0] *= 1.0 + 0.02 * off
    if model in ("PINHOLE", "OPENCV"):
        start[1] *= 1.0 + 0.02 * off
    return ColmapModel(
        camera_ids=np.array([7]),
        camera_models=(model,),
        camera_sizes=np.array([[640, 480]]),
        camera_params=(np.array(start),),
        image_ids=np.arange(1, len(T) + 1),
        image_names=tuple(f"{k:03}.png" for k in range(len(T))),
        camera_of=np.zeros(len(T), dtype=np.int64),
        T_camera_world=SE3Left.boxplus(T, 0.02 * off * rng.standard_normal((len(T), 6))),
        point_ids=np.arange(10, 10 + len(p_world)),
        points=p_world + 0.05 * off * rng.standard_normal(p_world.shape),
        colors=rng.integers(0, 256, p_world.shape).astype(np.uint8),
        errors=np.full(len(p_world), -1.0),
        image_of=camera_of,
        point_of=np.where(np.arange(len(point_of)) % 11 == 10, -1, point_of),
        pixels=measured,
        format="text" if format == "text" else "binary",
    )


def bal_problem(off: float = 1.0) -> BalProblem:
    """Cameras that look along −z, f = 500 and a little distortion."""
    rng = np.random.default_rng(2)
    T, p_world, camera_of, point_of = scene()
    half_turn = np.array([0.0, 1.0, 0.0, 0.0])  # about x: from a camera that looks along z to one that looks along −z
    q = quaternion.multiply(np.tile(half_turn, (len(T), 1)), np.ascontiguousarray(T[:, :4]))
    T = np.hstack([q, T[:, 4:] * [1.0, -1.0, -1.0]])
    p = in_camera(T[camera_of], p_world[point_of])
    n = -p[:, :2] / p[:, 2:]
    r2 = (n**2).sum(axis=1, keepdims=True)
    pixels = 500.0 * (1.0 + 0.05 * r2 - 0.02 * r2 * r2) * n + SIGMA_PX * rng.standard_normal(n.shape)
    cameras = np.hstack([so3.log(quaternion.to_matrix(q)), T[:, 4:], np.tile([500.0, 0.05, -0.02], (len(T), 1))])
    cameras[:, :6] += 0.02 * off * rng.standard_normal((len(T), 6))
    return BalProblem(cameras, p_world + 0.05 * off * rng.standard_normal(p_world.shape), camera_of, point_of, pixels)


def gbp_problem() -> GbpProblem:
    """A calibrated camera at f = 500."""
    model = colmap_model("SIMPLE_PINHOLE")
    intrinsics = np.array([500.0, 500.0, 320.0, 240.0])
    _, _, camera_of, point_of = scene()
    return GbpProblem(intrinsics, model.T_camera_world, model.points, camera_of, point_of, model.pixels)


def loop_graph(dimension: int, with_poses: bool = True, count: int = 24) -> PoseGraph:
    """Twice around a circle, with edges between the rounds, noise of 0.02 and poses that drift."""
    rng = np.random.default_rng(3)
    manifold, group = (SE3, se3) if dimension == 3 else (SE2, se2)
    step = np.zeros(manifold.dof)
    step[2 if dimension == 3 else 0], step[3 if dimension == 3 else 1] = 4.0 * np.pi / count, 1.0
    truth = [manifold.identity()]
    for _ in range(count - 1):
        truth.append(manifold.boxplus(truth[-1], step))
    poses = np.array(truth)
    half = count // 2
    i = np.concatenate([np.arange(count - 1), np.arange(half)])
    j = np.concatenate([np.arange(1, count), np.arange(half) + half])
    exact = group.compose(group.inverse(poses[i]), poses[j])
    measured = manifold.boxplus(exact, 0.02 * rng.standard_normal((len(i), manifold.dof)))
    information = np.tile(np.eye(manifold.dof) / 0.02**2, (len(i), 1, 1))
    drift = np.linspace(0.0, 0.5, count)[:, None] * rng.standard_normal(manifold.dof)
    start = manifold.boxplus(poses, drift) if with_poses else None
    no_pose = np.zeros(0, dtype=np.int64)
    return PoseGraph(3 if dimension == 3 else 2, np.arange(count), start, np.stack([i, j], 1), measured, information, no_pose)


def write_small_files(folder: Path) -> None:
    """scene.txt.bz2 (BAL) and loops.g2o."""
    from boxplus.formats.graphs.g2o import write_g2o
    from boxplus.formats.reconstructions.bal import write_bal

    write_bal(folder / "scene.txt.bz2", bal_problem())
    write_g2o(folder / "loops.g2o", loop_graph(3))
