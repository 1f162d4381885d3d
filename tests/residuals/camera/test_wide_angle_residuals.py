"""Residuals of points in cameras of wide angle: beyond 90° from the axis, on bodies, with intrinsics as variables."""

from __future__ import annotations

import numpy as np
import pytest

import boxplus as bp
from boxplus.cameras import CameraModel, DoubleSphere, Equidistant, Pinhole
from boxplus.manifolds import quaternion, se3
from boxplus.manifolds.se3 import SE3Left
from boxplus.optimization.jacobian_check import check_jacobian
from boxplus.residuals import InverseDepthReprojection, OnBody, Reprojection, ReprojectionIntrinsics, on_rig

FISHEYE = Equidistant(190.98, 190.97, 254.93, 256.90, 3.48e-3, 7.15e-4, -2.05e-3, 2.03e-4)
SPHERES = DoubleSphere(313.21, 313.21, 638.66, 514.39, -0.1818, 0.5919)
by_camera = pytest.mark.parametrize("camera", [FISHEYE, SPHERES], ids=lambda c: type(c).__name__)


def around(camera: Equidistant | DoubleSphere, seed: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses T_camera_world, and points in the world that the cameras see up to 95 % of their angle; also in the camera frame."""
    rng = np.random.default_rng(seed)
    poses = SE3Left.random(rng, count)
    theta, phi = 0.95 * camera.theta_max * rng.uniform(0, 1, count), rng.uniform(0, 2 * np.pi, count)
    direction = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    p_camera = rng.uniform(1.0, 8.0, (count, 1)) * direction
    R = quaternion.to_matrix(poses[:, :4])
    return poses, np.einsum("nji,nj->ni", R, p_camera - poses[:, 4:]), p_camera


@by_camera
def test_points_beyond_90_degrees(camera: Equidistant | DoubleSphere) -> None:
    poses, points, p_camera = around(camera, 1, 60)
    assert (p_camera[:, 2] < 0.0).any()
    pixels = np.random.default_rng(2).uniform(0.0, 500.0, (60, 2))
    for residual, x in (
        (Reprojection(camera, pixels), (poses, points)),
        (ReprojectionIntrinsics(camera, pixels), (poses, points, np.tile(camera.parameters, (60, 1)))),
    ):
        np.testing.assert_allclose(residual.evaluate(*x), pixels - camera.project(p_camera)[0], atol=1e-9)
        report = check_jacobian(residual, *x)
        assert report.passed and report.invalid == 0 and report.largest_residual > 1.0, str(report)


@by_camera
def test_what_has_no_projection_is_invalid_and_nan_is_not_hidden(camera: Equidistant | DoubleSphere) -> None:
    pose = np.array([[1.0, 0, 0, 0, 0, 0, 0]])
    points = np.array([[0.0, 0.0, -2.0], [0.0, 0.01, 0.0], [0.0, 0.0, 2.0]])
    residual = Reprojection(camera, np.zeros((3, 2)))
    linearized = residual.linearize(np.repeat(pose, 3, axis=0), points)
    assert linearized.valid.tolist() == [False, False, True]
    assert not linearized.residuals[:2].any() and not linearized.jacobians[1][:2].any()
    evaluated = residual.evaluate(np.repeat(pose, 3, axis=0), np.full((3, 3), np.nan))
    assert np.isnan(evaluated).all()


@by_camera
def test_inverse_depth_and_bodies(camera: Equidistant | DoubleSphere) -> None:
    rng = np.random.default_rng(3)
    count = 40
    anchors = SE3Left.random(rng, count)
    observers = SE3Left.boxplus(anchors, 0.2 * rng.normal(size=(count, 6)))
    bearing_rho = np.column_stack([rng.uniform(-1.5, 1.5, (count, 2)), rng.uniform(0.05, 0.5, count)])
    bearing_rho[::7, 2] = 1e-3  # far away
    residual = InverseDepthReprojection(camera, rng.uniform(0.0, 500.0, (count, 2)))
    report = check_jacobian(residual, anchors, observers, bearing_rho)
    assert report.passed and report.invalid == 0, str(report)
    poses, points, _ = around(camera, 4, count)
    mounting = bp.BodyPose.random(rng, count)
    body = se3.compose(se3.inverse(poses), se3.inverse(mounting))  # T_world_body = T_world_camera T_body_camera⁻¹
    seen = OnBody(Reprojection(camera, rng.uniform(0.0, 500.0, (count, 2))))
    report = check_jacobian(seen, body, mounting, points)
    assert report.passed and report.invalid == 0, str(report)


@pytest.mark.parametrize("seed", [5, 6])
def test_a_rig_of_different_cameras_is_solved(seed: int) -> None:
    """A body with a fisheye, a double sphere and a pinhole among known points: its pose comes back from a start that is off."""
    rng = np.random.default_rng(seed)
    cameras: list[CameraModel] = [FISHEYE, SPHERES, Pinhole(400.0, 400.0, 320.0, 240.0)]
    T_world_body, mountings = bp.BodyPose.random(rng, 1), bp.BodyPose.random(rng, 3)
    mountings[:, 4:] *= 0.1
    directions = rng.normal(size=(200, 3))
    points = T_world_body[:, 4:] + rng.uniform(3.0, 8.0, (200, 1)) * directions / np.linalg.norm(
        directions, axis=1, keepdims=True
    )
    pixels, camera_of, point_of = [], [], []
    for number, camera in enumerate(cameras):
        T_camera_world = se3.inverse(se3.compose(T_world_body, mountings[number : number + 1]))
        p_camera = se3.act(np.repeat(T_camera_world, len(points), axis=0), points)
        at, seen = camera.project(p_camera)
        angle = np.arctan2(np.hypot(p_camera[:, 0], p_camera[:, 1]), p_camera[:, 2])
        seen &= angle < (1.0 if isinstance(camera, Pinhole) else 0.9 * camera.theta_max)  # images end somewhere
        pixels.append(at[seen])
        camera_of += [number] * int(seen.sum())
        point_of += np.flatnonzero(seen).tolist()
    assert all(len(rows) > 5 for rows in pixels)
    problem = bp.Problem()
    start = bp.BodyPose.boxplus(T_world_body, rng.uniform(-0.1, 0.1, (1, 6)))
    body = problem.add_variables(bp.BodyPose, start, name="body")
    mounted = problem.add_variables(bp.BodyPose, mountings, name="mounting")
    known = problem.add_variables(bp.Euclidean(3), points, name="point")
    problem.fix(mounted)
    problem.fix(known)
    for residual, n in on_rig(Reprojection, cameras, camera_of, np.concatenate(pixels)):
        of, camera = np.array(point_of)[n], np.array(camera_of)[n]
        problem.add_residuals(residual, body[np.zeros(len(n), int)], mounted[camera], known[of])
    solution = problem.solve()
    np.testing.assert_allclose(bp.BodyPose.boxminus(solution[body], T_world_body), 0.0, atol=1e-7)


def test_the_intrinsics_of_a_fisheye_come_back() -> None:
    """Known poses and points, intrinsics started 2 % off."""
    poses, points, _ = around(FISHEYE, 6, 400)
    pixels, seen = FISHEYE.project(np.einsum("nij,nj->ni", quaternion.to_matrix(poses[:, :4]), points) + poses[:, 4:])
    assert seen.all()
    residual = ReprojectionIntrinsics(FISHEYE, pixels)
    c = FISHEYE.parameters * 1.02
    for _ in range(8):
        linearized = residual.linearize(poses, points, np.tile(c, (400, 1)))
        J = linearized.jacobians[2].reshape(-1, 8)
        c = c - np.linalg.lstsq(J, linearized.residuals.ravel(), rcond=None)[0]
    np.testing.assert_allclose(c, FISHEYE.parameters, rtol=1e-6, atol=1e-9)
