"""Reprojection errors of points: against NumPy, against central differences, at their singular cases."""

from __future__ import annotations

import bz2
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.cameras import CameraModel, DoubleSphere, Equidistant, Pinhole, Radial, RadialTangential
from boxplus.errors import InputError
from boxplus.manifolds import quaternion, so3
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import UnitQuaternion
from boxplus.manifolds.se3 import SE3, SE3Left
from boxplus.optimization.jacobian_check import check_jacobian
from boxplus.residuals.camera.bal_reprojection import BalCamera, BalReprojection
from boxplus.residuals.camera.reprojection import Reprojection
from boxplus.residuals.camera.reprojection_intrinsics import ReprojectionIntrinsics
from boxplus.residuals.residual import Residual

CAMERAS = [
    Pinhole(420.0, 430.0, 310.0, 245.0),
    Pinhole(420.0, 430.0, 310.0, 245.0, Radial(-0.21, 0.06)),
    Pinhole(420.0, 430.0, 310.0, 245.0, RadialTangential(-0.21, 0.06, 1e-3, -2e-3)),
    Pinhole(420.0, 430.0, 310.0, 245.0, RadialTangential(-0.21, 0.06, 1e-3, -2e-3, 0.02)),
    Equidistant(420.0, 430.0, 310.0, 245.0, -0.02, 0.03, -0.05, 0.02),
    DoubleSphere(420.0, 430.0, 310.0, 245.0, -0.24, 0.57),
]
by_model = pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: f"{type(c).__name__}, {len(c.parameters)} intrinsics")


def assert_jacobians(residual: Residual, *x: NDArray[np.float64]) -> None:
    """Against differences far from zero residual, on every update of the poses."""
    for pose in (SE3Left, SE3, Product(UnitQuaternion, Euclidean(3))):
        manifolds = tuple(pose if m == SE3Left else m for m in residual.manifolds)
        report = check_jacobian(residual, *x, manifolds=manifolds)
        assert report.passed and report.invalid == report.unsteady == 0 and report.largest_residual > 1.0, str(report)


def poses_and_points(seed: int, count: int, side: float = 1.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Random poses T_camera_world and world points that lie before their camera (behind for side = −1)."""
    rng = np.random.default_rng(seed)
    poses = SE3Left.random(rng, count)
    z = rng.uniform(1.0, 9.0, count)
    p_camera = np.stack([rng.uniform(-0.6, 0.6, count) * z, rng.uniform(-0.5, 0.5, count) * z, side * z], axis=1)
    R = quaternion.to_matrix(poses[:, :4])
    return poses, np.einsum("nji,nj->ni", R, p_camera - poses[:, 4:])


def to_camera(poses: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    moved: NDArray[np.float64] = np.einsum("nij,nj->ni", quaternion.to_matrix(poses[:, :4]), points) + poses[:, 4:7]
    return moved


def random_pixels(seed: int, count: int) -> NDArray[np.float64]:
    return np.random.default_rng(seed).uniform(0.0, 600.0, (count, 2))


class TestReprojection:
    @by_model
    def test_residual_is_measured_minus_projected(self, camera: CameraModel) -> None:
        poses, points = poses_and_points(1, 30)
        pixels = random_pixels(2, 30)
        residual = Reprojection(camera, pixels, sigma=0.5)
        np.testing.assert_allclose(
            residual.evaluate(poses, points), pixels - camera.project(to_camera(poses, points))[0], atol=1e-9
        )
        np.testing.assert_array_equal(residual.whitening.factors[0], 2.0 * np.eye(2))

    @by_model
    def test_jacobians(self, camera: CameraModel) -> None:
        assert_jacobians(Reprojection(camera, random_pixels(3, 40)), *poses_and_points(4, 40))

    def test_pose_jacobian_is_that_of_the_specification(self) -> None:
        """Written out without distortion (docs/residuals/reprojection.md)."""
        poses, points = poses_and_points(5, 20)
        camera = CAMERAS[0]
        J = Reprojection(camera, random_pixels(6, 20)).linearize(poses, points).jacobians[0]
        for n, (X, Y, Z) in enumerate(to_camera(poses, points)):
            u = [-X * Y / Z**2, 1 + X**2 / Z**2, -Y / Z, 1 / Z, 0, -X / Z**2]
            v = [-(1 + Y**2 / Z**2), X * Y / Z**2, X / Z, 0, 1 / Z, -Y / Z**2]
            np.testing.assert_allclose(J[n], -np.array([camera.fx * np.array(u), camera.fy * np.array(v)]), atol=1e-9)

    def test_points_up_to_z_min_are_invalid_and_their_rows_zero(self) -> None:
        pose = np.array([1.0, 0, 0, 0, 0, 0, 0])
        points = np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 0.05], [0.0, 0.0, 0.0], [0.0, 0.0, 0.06]])
        linear = Reprojection(CAMERAS[1], random_pixels(7, 4)).linearize(pose, points)
        assert linear.valid.tolist() == [False, False, False, True]
        for array in (linear.residuals, *linear.jacobians):
            assert not array[:3].any() and np.isfinite(array).all() and array[3].any()

    def test_invalid_rows_overwrite_what_was_there(self) -> None:
        residual = Reprojection(CAMERAS[0], random_pixels(8, 1))
        x = (np.array([[1.0, 0, 0, 0, 0, 0, 0]]), np.array([[0.0, 0.0, -1.0]]))
        index = (np.zeros(1, np.uint32), np.zeros(1, np.uint32))
        r, J, valid = np.ones((1, 2)), (np.ones((1, 2, 6)), np.ones((1, 2, 3))), np.ones(1, bool)
        residual.linearize_into(0, 1, x, index, r, J, valid)
        assert not r.any() and not J[0].any() and not J[1].any() and not valid[0]

    def test_a_nan_is_not_hidden_as_invalid(self) -> None:
        linear = Reprojection(CAMERAS[0], random_pixels(9, 1)).linearize([1.0, 0, 0, 0, 0, 0, np.nan], [0.0, 0.0, 1.0])
        assert linear.valid[0] and np.isnan(linear.residuals).all()

    def test_variables_are_gathered_and_only_the_rows_asked_for_written(self) -> None:
        poses, points = poses_and_points(10, 6)
        pixels = random_pixels(11, 6)
        residual, order = Reprojection(CAMERAS[2], pixels), np.array([4, 0, 3, 3, 1, 5], dtype=np.uint32)
        r, J, valid = np.full((6, 2), 7.0), (np.full((6, 2, 6), 7.0), np.full((6, 2, 3), 7.0)), np.zeros(6, bool)
        residual.linearize_into(2, 5, (poses, points), (order, order), r, J, valid)
        whole = residual.linearize(poses[order], points[order])
        np.testing.assert_array_equal(r[2:5], whole.residuals[2:5])
        np.testing.assert_array_equal(J[0][2:5], whole.jacobians[0][2:5])
        np.testing.assert_array_equal(J[1][2:5], whole.jacobians[1][2:5])
        assert (r[[0, 1, 5]] == 7.0).all() and (J[0][[0, 1, 5]] == 7.0).all() and not valid[[0, 1, 5]].any()

    def test_pixels_are_checked(self) -> None:
        with pytest.raises(InputError, match=r"expected pixels of shape \(N, 2\) \[px\] – got shape \(2,\) – give one row"):
            Reprojection(CAMERAS[0], [1.0, 2.0])
        with pytest.raises(InputError, match="NaN or infinity in row 1 – leave out what was not observed"):
            Reprojection(CAMERAS[0], [[1.0, 2.0], [np.nan, 1.0]])
        with pytest.raises(InputError, match="sigma positive and finite"):
            Reprojection(CAMERAS[0], [[1.0, 2.0]], sigma=0.0)


class TestReprojectionIntrinsics:
    @by_model
    def test_equals_the_calibrated_residual_at_the_same_intrinsics(self, camera: CameraModel) -> None:
        poses, points = poses_and_points(12, 25)
        pixels = random_pixels(13, 25)
        expected = Reprojection(camera, pixels).linearize(poses, points)
        got = ReprojectionIntrinsics(camera, pixels).linearize(poses, points, camera.parameters)
        np.testing.assert_array_equal(got.residuals, expected.residuals)
        np.testing.assert_array_equal(got.jacobians[0], expected.jacobians[0])
        np.testing.assert_array_equal(got.jacobians[1], expected.jacobians[1])

    @by_model
    def test_jacobians(self, camera: CameraModel) -> None:
        poses, points = poses_and_points(14, 40)
        intrinsics = camera.parameters * np.random.default_rng(15).uniform(0.9, 1.1, (40, len(camera.parameters)))
        assert_jacobians(ReprojectionIntrinsics(camera, random_pixels(16, 40)), poses, points, intrinsics)

    def test_points_up_to_z_min_are_invalid_and_their_rows_zero(self) -> None:
        camera = CAMERAS[3]
        linear = ReprojectionIntrinsics(camera, random_pixels(17, 2)).linearize(
            [1.0, 0, 0, 0, 0, 0, 0], [[0.1, 0.1, 0.04], [0.1, 0.1, 2.0]], camera.parameters
        )
        assert linear.valid.tolist() == [False, True]
        for array in (linear.residuals, *linear.jacobians):
            assert not array[0].any() and array[1].any()


def bal_cameras(seed: int, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    count = len(poses)
    f, k1, k2 = rng.uniform(300, 600, count), rng.uniform(-0.3, 0.3, count), rng.uniform(-0.1, 0.1, count)
    return np.column_stack([poses, f, k1, k2])


def read_bal(file: Path) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.uint32], NDArray[np.float64]]:
    """Cameras (m, 10), points (n, 3), (camera, point) of each observation (N, 2), pixels (N, 2)."""
    numbers = np.array(bz2.decompress(file.read_bytes()).split(), dtype=np.float64)
    m, n, count = numbers[:3].astype(int)
    observations = numbers[3 : 3 + 4 * count].reshape(-1, 4)
    cameras = numbers[3 + 4 * count :][: 9 * m].reshape(m, 9)
    points = numbers[3 + 4 * count + 9 * m :].reshape(n, 3)
    wxyz = quaternion.from_matrix(so3.exp(cameras[:, :3]))
    return np.column_stack([wxyz, cameras[:, 3:]]), points, observations[:, :2].astype(np.uint32), observations[:, 2:]


class TestBalReprojection:
    def test_residual_is_that_of_the_paper(self) -> None:
        poses, points = poses_and_points(18, 30, side=-1.0)
        cameras, pixels = bal_cameras(19, poses), random_pixels(20, 30)
        P = to_camera(poses, points)
        p = -P[:, :2] / P[:, 2:]
        r2 = (p**2).sum(axis=1, keepdims=True)
        f, k1, k2 = cameras[:, 7:8], cameras[:, 8:9], cameras[:, 9:]
        expected = pixels - f * (1 + k1 * r2 + k2 * r2**2) * p
        np.testing.assert_allclose(BalReprojection(pixels).evaluate(cameras, points), expected, atol=1e-9)

    @pytest.mark.parametrize("side", [-1.0, 1.0])
    def test_jacobians(self, side: float) -> None:
        """In front of the camera, and behind, where the model is defined as well."""
        poses, points = poses_and_points(21, 40, side=side)
        assert_jacobians(BalReprojection(random_pixels(22, 40)), bal_cameras(23, poses), points)

    def test_points_in_the_plane_of_the_camera_are_invalid(self) -> None:
        camera = [1.0, 0, 0, 0, 0, 0, 0, 500.0, 0.0, 0.0]
        linear = BalReprojection(random_pixels(24, 2)).linearize(camera, [[1.0, 0.0, 0.0], [1.0, 0.0, -1e-3]])
        assert linear.valid.tolist() == [False, True]
        for array in (linear.residuals, *linear.jacobians):
            assert not array[0].any() and array[1].any()

    def test_camera_is_a_pose_and_three_numbers_with_names(self) -> None:
        assert Product(SE3Left, Euclidean(3)) == BalCamera
        assert (BalCamera.size, BalCamera.dof) == (10, 9)
        assert BalCamera.tangent_names[6:] == ("focal length [px]", "k1", "k2")

    def test_z_min_is_checked(self) -> None:
        with pytest.raises(InputError, match="z_min finite and not negative – got nan"):
            BalReprojection([[0.0, 0.0]], z_min=np.nan)

    @pytest.mark.parametrize(
        ("name", "cost"),
        [
            ("dubrovnik-16-22106-pre", 4.185660e6),
            ("ladybug-49-7776-pre", 8.509125e5),
            ("trafalgar-21-11315-pre", 4.413239e6),
        ],
    )
    def test_cost_at_the_start_of_the_published_problems(self, shared_data: Path, name: str, cost: float) -> None:
        file = shared_data / "bal" / f"{name}.txt.bz2"
        if not file.is_file():
            pytest.skip(f"{file.name} is not on this machine")
        cameras, points, observed, pixels = read_bal(file)
        r = BalReprojection(pixels).evaluate(cameras[observed[:, 0]], points[observed[:, 1]])
        assert 0.5 * float((r**2).sum()) == pytest.approx(cost, rel=2e-7)


def test_cost_at_the_start_of_the_orb_matches(shared_data: Path) -> None:
    """`gbp_fr1desk` has forward-looking cameras with fixed intrinsics: t of T_camera_world, then the rotation vector."""
    file = shared_data / "bal" / "gbp_fr1desk.txt"
    if not file.is_file():
        pytest.skip(f"{file.name} is not on this machine")
    rows = [line for line in file.read_text().splitlines() if not line.startswith("#")]
    numbers = np.array(" ".join(rows).split(), dtype=np.float64)
    m, n, count = numbers[:3].astype(int)
    fx, fy, cx, cy = numbers[3:7]
    observations = numbers[7 : 7 + 4 * count].reshape(-1, 4)
    cameras = numbers[7 + 4 * count :][: 6 * m].reshape(m, 6)
    points = numbers[7 + 4 * count + 6 * m :].reshape(n, 3)
    poses = np.column_stack([quaternion.from_matrix(so3.exp(cameras[:, 3:])), cameras[:, :3]])
    residual = Reprojection(Pinhole(fx, fy, cx, cy), observations[:, 2:])
    linear = residual.linearize(poses[observations[:, 0].astype(int)], points[observations[:, 1].astype(int)])
    assert linear.valid.all()
    assert 0.5 * float((linear.residuals**2).sum()) == pytest.approx(3.858e8, rel=2e-4)
