"""Inverse depth and the warp of intrinsics: against NumPy, against central differences, at infinity."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.cameras import Pinhole, Radial, RadialTangential
from boxplus.errors import InputError
from boxplus.manifolds import quaternion
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import UnitQuaternion
from boxplus.manifolds.se3 import SE3, SE3Left
from boxplus.optimization.jacobian_check import check_jacobian
from boxplus.residuals.inverse_depth import InverseDepthReprojection
from boxplus.residuals.inverse_depth_intrinsics import InverseDepthIntrinsics
from boxplus.residuals.residual import Residual

CAMERA = Pinhole(420.0, 430.0, 310.0, 245.0)
LENS = Pinhole(420.0, 430.0, 310.0, 245.0, RadialTangential(-0.21, 0.06, 1e-3, -2e-3, 0.02))
COUNT = 40


def assert_jacobians(residual: Residual, *x: NDArray[np.float64]) -> None:
    """Against differences far from zero residual, on every update of the poses."""
    for pose in (SE3Left, SE3, Product(UnitQuaternion, Euclidean(3))):
        manifolds = tuple(pose if m == SE3Left else m for m in residual.manifolds)
        report = check_jacobian(residual, *x, manifolds=manifolds)
        assert report.passed and report.invalid == report.unsteady == 0 and report.largest_residual > 1.0, str(report)


def views(seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """T_anchor_world, T_observer_world within 0.3 rad and 0.4 m of each other, ρ (COUNT, 1), pixels of the anchor."""
    rng = np.random.default_rng(seed)
    anchors = SE3Left.random(rng, COUNT)
    observers = SE3Left.boxplus(anchors, rng.uniform(-1.0, 1.0, (COUNT, 6)) * np.repeat([0.15, 0.2], 3))
    return anchors, observers, rng.uniform(0.1, 0.9, (COUNT, 1)), rng.uniform([100, 80], [520, 400], (COUNT, 2))


def random_pixels(seed: int) -> NDArray[np.float64]:
    return np.random.default_rng(seed).uniform(0.0, 600.0, (COUNT, 2))


def between(anchors: NDArray[np.float64], observers: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    R_a, R_o = quaternion.to_matrix(anchors[:, :4]), quaternion.to_matrix(observers[:, :4])
    R = R_o @ R_a.swapaxes(1, 2)
    return R, observers[:, 4:] - np.einsum("nij,nj->ni", R, anchors[:, 4:])


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "distorted"])
class TestInverseDepth:
    def test_residual_goes_through_the_point_in_the_world(self, camera: Pinhole) -> None:
        anchors, observers, rho, seen = views(1)
        pixels = random_pixels(2)
        R, t = between(anchors, observers)
        X = np.einsum("nij,nj->ni", R, camera.unproject(seen, 1.0 / rho[:, 0])[0]) + t
        expected = pixels - camera.project(X)[0]
        got = InverseDepthReprojection(camera, seen, pixels).evaluate(anchors, observers, rho)
        np.testing.assert_allclose(got, expected, atol=1e-8)

    def test_jacobians(self, camera: Pinhole) -> None:
        anchors, observers, rho, seen = views(3)
        assert_jacobians(InverseDepthReprojection(camera, seen, random_pixels(4)), anchors, observers, rho)

    def test_pose_jacobians_at_infinity(self, camera: Pinhole) -> None:
        anchors, observers, rho, seen = views(5)
        # The derivative by ρ is one-sided there (SPEC.md 8.3), and tested below.
        residual = InverseDepthReprojection(camera, seen, random_pixels(6))
        linear = residual.linearize(anchors, observers, 0.0 * rho)
        assert not linear.jacobians[0][:, :, 3:].any() and not linear.jacobians[1][:, :, 3:].any()
        rotations = [linear.jacobians[0][:, :, :3], linear.jacobians[1][:, :, :3]]
        for slot, J in enumerate(rotations):
            for k in range(3):

                def at(h: float, slot: int = slot, k: int = k) -> NDArray[np.float64]:
                    x = [anchors, observers, 0.0 * rho]
                    x[slot] = SE3Left.boxplus(x[slot], h * np.eye(6)[k])
                    return residual.evaluate(*x)

                difference = (8 * (at(1e-3) - at(-1e-3)) - (at(2e-3) - at(-2e-3))) / 12e-3
                np.testing.assert_allclose(J[:, :, k], difference, atol=1e-7 * np.abs(J).max())

    def test_points_at_infinity_are_the_limit_of_far_ones(self, camera: Pinhole) -> None:
        anchors, observers, rho, seen = views(7)
        residual = InverseDepthReprojection(camera, seen, random_pixels(8))
        far = residual.linearize(anchors, observers, np.full_like(rho, 1.01e-6))
        for none in (0.0, 0.99e-6, -3.0):
            infinite = residual.linearize(anchors, observers, np.full_like(rho, none))
            assert infinite.valid.all()
            np.testing.assert_allclose(infinite.residuals, far.residuals, atol=2e-3)
            np.testing.assert_allclose(infinite.jacobians[2], far.jacobians[2], atol=1e-2)
            assert np.abs(infinite.jacobians[2]).min(axis=(1, 2)).max() > 1.0

    def test_no_parallax_leaves_the_depth_unobservable(self, camera: Pinhole) -> None:
        anchors, _, rho, seen = views(9)
        turned = SE3Left.boxplus(anchors, [0.1, -0.2, 0.05, 0.0, 0.0, 0.0])
        linear = InverseDepthReprojection(camera, seen, random_pixels(10)).linearize(anchors, turned, rho)
        assert linear.valid.all()
        np.testing.assert_allclose(linear.jacobians[2], 0.0, atol=1e-10)

    def test_what_is_behind_the_observer_is_invalid(self, camera: Pinhole) -> None:
        identity, seen = np.array([1.0, 0, 0, 0, 0, 0, 0]), [[310.0, 245.0]] * 4
        back = [1.0, 0, 0, 0, 0, 0, -2.0]  # two metres behind a point one metre away
        turned = [0.0, 0.0, 1.0, 0.0, 0, 0, 0]
        observers = np.array([back, identity, turned, identity])
        linear = InverseDepthReprojection(camera, seen, random_pixels(11)[:4]).linearize(
            identity, observers, [[1.0], [1.0], [0.0], [1.0 / 0.05]]
        )
        assert linear.valid.tolist() == [False, True, False, False]
        for array in (linear.residuals, *linear.jacobians):
            assert not array[[0, 2, 3]].any()


def test_rho_jacobian_is_that_of_the_specification() -> None:
    anchors, observers, rho, seen = views(12)
    R, t = between(anchors, observers)
    X = np.einsum("nij,nj->ni", R, CAMERA.unproject(seen, 1.0 / rho[:, 0])[0]) + t
    u, v, scale = X[:, 0] / X[:, 2], X[:, 1] / X[:, 2], 1.0 / (rho[:, 0] * X[:, 2])
    expected = -np.stack([CAMERA.fx * (t[:, 0] - u * t[:, 2]) * scale, CAMERA.fy * (t[:, 1] - v * t[:, 2]) * scale], axis=1)
    got = InverseDepthReprojection(CAMERA, seen, random_pixels(13)).linearize(anchors, observers, rho).jacobians[2][:, :, 0]
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9)


def test_anchor_may_be_another_camera() -> None:
    anchors, observers, rho, seen = views(14)
    pixels = random_pixels(15)
    expected = InverseDepthReprojection(CAMERA, LENS.undistort(seen)[0], pixels).evaluate(anchors, observers, rho)
    got = InverseDepthReprojection(CAMERA, seen, pixels, anchor_camera=LENS).evaluate(anchors, observers, rho)
    np.testing.assert_allclose(got, expected, atol=1e-8)


class TestIntrinsicsThroughAWarp:
    def test_equals_inverse_depth_at_the_same_intrinsics(self) -> None:
        anchors, observers, rho, seen = views(16)
        pixels = random_pixels(17)
        expected = InverseDepthReprojection(CAMERA, seen, pixels).linearize(anchors, observers, rho)
        got = InverseDepthIntrinsics(seen, pixels).linearize(anchors, observers, rho, CAMERA.parameters)
        np.testing.assert_allclose(got.residuals, expected.residuals, atol=1e-9)
        for slot in range(3):
            np.testing.assert_allclose(got.jacobians[slot], expected.jacobians[slot], rtol=1e-9, atol=1e-9)

    def test_jacobians(self) -> None:
        anchors, observers, rho, seen = views(18)
        intrinsics = CAMERA.parameters * np.random.default_rng(19).uniform(0.9, 1.1, (COUNT, 4))
        residual = InverseDepthIntrinsics(seen, random_pixels(20))
        assert_jacobians(residual, anchors, observers, rho, intrinsics)

    def test_focal_lengths_that_are_not_positive_are_invalid(self) -> None:
        anchors, observers, rho, seen = views(21)
        intrinsics = np.tile(CAMERA.parameters, (COUNT, 1))
        intrinsics[0, 0], intrinsics[1, 1] = 0.0, -400.0
        linear = InverseDepthIntrinsics(seen, random_pixels(22)).linearize(anchors, observers, rho, intrinsics)
        assert linear.valid.tolist() == [False, False] + [True] * (COUNT - 2)
        for array in (linear.residuals, *linear.jacobians):
            assert not array[:2].any() and np.isfinite(array).all()


def test_input_is_checked() -> None:
    with pytest.raises(InputError, match="as many anchor_pixels as pixels – got 1 and 2 – repeat an anchor's pixel"):
        InverseDepthReprojection(CAMERA, [[1.0, 2.0]], [[1.0, 2.0], [3.0, 4.0]])
    with pytest.raises(InputError, match="as many anchor_pixels as pixels"):
        InverseDepthIntrinsics([[1.0, 2.0]], [[1.0, 2.0], [3.0, 4.0]])
    with pytest.raises(InputError, match=r"distortion of the anchor's camera reaches – got \[9000\. +9000\.\] in row 0"):
        InverseDepthReprojection(Pinhole(400.0, 400.0, 0.0, 0.0, Radial(-0.3, 0.0)), [[9000.0, 9000.0]], [[1.0, 2.0]])
    with pytest.raises(InputError, match="z_min finite and not negative"):
        InverseDepthIntrinsics([[1.0, 2.0]], [[1.0, 2.0]], z_min=-1.0)
