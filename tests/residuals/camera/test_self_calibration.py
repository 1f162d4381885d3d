"""Problems in which the camera's residuals meet: self-calibration, and inverse depths with points at infinity."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

import boxplus as bp
from boxplus.cameras import Radial, RadialTangential
from boxplus.manifolds import quaternion

VIEWS, POINTS = 6, 60


def scene(seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """T_camera_world (VIEWS, 7) round a cloud of points (POINTS, 3), all of them 3 to 7 m before every camera."""
    rng = np.random.default_rng(seed)
    ahead = np.tile([1.0, 0, 0, 0, 0, 0, 5.0], (VIEWS, 1))
    motion = rng.uniform(-1.0, 1.0, (VIEWS, 6)) * [0.3, 0.3, 0.3, 0.5, 0.5, 0.5]
    motion[0] = 0.0
    return bp.SE3.boxplus(ahead, motion), rng.uniform(-1.4, 1.4, (POINTS, 3))


def project(camera: bp.Pinhole, poses: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    pixels, seen = camera.project(np.einsum("nij,nj->ni", quaternion.to_matrix(poses[:, :4]), points) + poses[:, 4:])
    assert seen.all()
    return pixels


@pytest.mark.parametrize(
    "camera",
    [
        bp.Pinhole(500.0, 480.0, 320.0, 240.0),
        bp.Pinhole(500.0, 480.0, 320.0, 240.0, Radial(-0.2, 0.04)),
        bp.Pinhole(500.0, 480.0, 320.0, 240.0, RadialTangential(-0.2, 0.04, 1e-3, -2e-3)),
    ],
    ids=lambda c: f"{len(c.parameters)} intrinsics",
)
def test_intrinsics_are_found_with_poses_and_points(camera: bp.Pinhole) -> None:
    poses, points = scene(1)
    rng = np.random.default_rng(2)
    view, point = (grid.ravel() for grid in np.mgrid[:VIEWS, :POINTS])
    pixels = project(camera, poses[view], points[point])
    moved = bp.SE3Left.boxplus(poses, rng.normal(0.0, 0.01, (VIEWS, 6)))
    moved[:2] = poses[:2]  # frame and scale

    problem = bp.Problem()
    T = problem.add_variables(bp.SE3Left, moved)
    p = problem.add_variables(bp.Euclidean(3), points + rng.normal(0.0, 0.02, points.shape))
    guess = camera.parameters * 1.03
    guess[4:] = 0.0
    c = problem.add_variables(bp.Euclidean(len(guess)), guess)
    problem.add_residuals(bp.residuals.ReprojectionIntrinsics(camera, pixels), T[view], p[point], c[:])
    problem.fix(T[:2])
    solution = problem.solve()
    assert solution.cost < 1e-12
    np.testing.assert_allclose(solution[c][0], camera.parameters, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(solution[p], points, atol=1e-6)


def test_inverse_depths_are_found_also_at_infinity() -> None:
    camera = bp.Pinhole(500.0, 480.0, 320.0, 240.0, Radial(-0.1, 0.01))
    poses, points = scene(3)
    rng = np.random.default_rng(4)
    seen = project(camera, np.repeat(poses[:1], POINTS, axis=0), points)
    rho = 1.0 / (points[:, 2] + 5.0)
    rho[:10] = 0.0
    rays = camera.unproject(seen)[0]
    view, point = (grid.ravel() for grid in np.mgrid[:VIEWS, :POINTS])  # the anchor, 0, sees them too
    # The anchor's frame is the world moved back by 5 m; Y = R m + ρ t also serves points at infinity.
    p_world_times_rho = rays - rho[:, None] * [0.0, 0.0, 5.0]
    R, t = quaternion.to_matrix(poses[view, :4]), poses[view, 4:]
    pixels, ahead = camera.project(np.einsum("nij,nj->ni", R, p_world_times_rho[point]) + rho[point, None] * t)
    assert ahead.any()

    problem = bp.Problem()
    start = bp.SE3Left.boxplus(poses, rng.normal(0.0, 0.01, (VIEWS, 6)))
    start[:2] = poses[:2]  # frame and scale
    T = problem.add_variables(bp.SE3Left, start)
    inverse = problem.add_variables(bp.Euclidean(3), np.column_stack([rays[:, :2] + 0.01, np.full(POINTS, 0.15)]))
    residual = bp.residuals.InverseDepthReprojection(camera, pixels[ahead])
    problem.add_residuals(residual, T[np.zeros(int(ahead.sum()), int)], T[view[ahead]], inverse[point[ahead]])
    problem.fix(T[:2])
    solution = problem.solve()
    assert solution.cost < 1e-9
    np.testing.assert_allclose(solution[inverse][:, :2], rays[:, :2], atol=1e-6)
    np.testing.assert_allclose(np.maximum(solution[inverse][:, 2], 0.0), rho, atol=2e-6)  # any ρ < 10⁻⁶ is infinity
    np.testing.assert_allclose(np.abs(bp.SE3Left.boxminus(solution[T], poses)).max(), 0.0, atol=1e-6)
