"""Inverse depth and the warp of intrinsics: against NumPy, against central differences, at infinity."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.cameras import Pinhole, RadialTangential
from boxplus.errors import InputError
from boxplus.evaluation.nees import nees, nees_band
from boxplus.manifolds import quaternion
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import UnitQuaternion
from boxplus.manifolds.se3 import SE3, SE3Left
from boxplus.optimization.jacobian_check import check_jacobian
from boxplus.optimization.problem import Problem
from boxplus.residuals.camera.inverse_depth import InverseDepthReprojection
from boxplus.residuals.camera.inverse_depth_intrinsics import InverseDepthIntrinsics
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
    """T_anchor_world, T_observer_world within 0.3 rad and 0.4 m of each other, ρ (COUNT, 1), pixels in the anchor."""
    rng = np.random.default_rng(seed)
    anchors = SE3Left.random(rng, COUNT)
    observers = SE3Left.boxplus(anchors, rng.uniform(-1.0, 1.0, (COUNT, 6)) * np.repeat([0.15, 0.2], 3))
    return anchors, observers, rng.uniform(0.1, 0.9, (COUNT, 1)), rng.uniform([100, 80], [520, 400], (COUNT, 2))


def point(camera: Pinhole, seen: NDArray[np.float64], rho: NDArray[np.float64]) -> NDArray[np.float64]:
    """[x, y, ρ] of pixels (n, 2) of the anchor, and ρ (n, 1)."""
    return np.hstack([camera.unproject(seen)[0][:, :2], rho])


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
        got = InverseDepthReprojection(camera, pixels).evaluate(anchors, observers, point(camera, seen, rho))
        np.testing.assert_allclose(got, expected, atol=1e-8)

    def test_jacobians(self, camera: Pinhole) -> None:
        anchors, observers, rho, seen = views(3)
        assert_jacobians(InverseDepthReprojection(camera, random_pixels(4)), anchors, observers, point(camera, seen, rho))

    def test_pose_jacobians_at_infinity(self, camera: Pinhole) -> None:
        anchors, observers, rho, seen = views(5)
        # The derivative by ρ is one-sided there (docs/residuals/inverse_depth.md), and tested below.
        residual = InverseDepthReprojection(camera, random_pixels(6))
        infinite = point(camera, seen, 0.0 * rho)
        linear = residual.linearize(anchors, observers, infinite)
        assert not linear.jacobians[0][:, :, 3:].any() and not linear.jacobians[1][:, :, 3:].any()
        rotations = [linear.jacobians[0][:, :, :3], linear.jacobians[1][:, :, :3]]
        for slot, J in enumerate(rotations):
            for k in range(3):

                def at(h: float, slot: int = slot, k: int = k) -> NDArray[np.float64]:
                    x = [anchors, observers, infinite]
                    x[slot] = SE3Left.boxplus(x[slot], h * np.eye(6)[k])
                    return residual.evaluate(*x)

                difference = (8 * (at(1e-3) - at(-1e-3)) - (at(2e-3) - at(-2e-3))) / 12e-3
                np.testing.assert_allclose(J[:, :, k], difference, atol=1e-7 * np.abs(J).max())

    def test_points_at_infinity_are_the_limit_of_far_ones(self, camera: Pinhole) -> None:
        anchors, observers, rho, seen = views(7)
        residual = InverseDepthReprojection(camera, random_pixels(8))
        far = residual.linearize(anchors, observers, point(camera, seen, np.full_like(rho, 1.01e-6)))
        for none in (0.0, 0.99e-6, -3.0):
            infinite = residual.linearize(anchors, observers, point(camera, seen, np.full_like(rho, none)))
            assert infinite.valid.all()
            np.testing.assert_allclose(infinite.residuals, far.residuals, atol=2e-3)
            np.testing.assert_allclose(infinite.jacobians[2], far.jacobians[2], atol=1e-2)
            assert np.abs(infinite.jacobians[2][:, :, 2]).min(axis=1).max() > 1.0

    def test_no_parallax_leaves_the_depth_unobservable(self, camera: Pinhole) -> None:
        anchors, _, rho, seen = views(9)
        turned = SE3Left.boxplus(anchors, [0.1, -0.2, 0.05, 0.0, 0.0, 0.0])
        linear = InverseDepthReprojection(camera, random_pixels(10)).linearize(anchors, turned, point(camera, seen, rho))
        assert linear.valid.all()
        np.testing.assert_allclose(linear.jacobians[2][:, :, 2], 0.0, atol=1e-10)

    def test_the_anchor_measures_the_bearing_and_nothing_else(self, camera: Pinhole) -> None:
        anchors, _, rho, seen = views(23)
        pixels = random_pixels(24)
        linear = InverseDepthReprojection(camera, pixels).linearize(anchors, anchors, point(camera, seen, rho))
        np.testing.assert_allclose(linear.residuals, pixels - seen, atol=1e-9)
        np.testing.assert_allclose(linear.jacobians[0] + linear.jacobians[1], 0.0, atol=1e-9)
        np.testing.assert_allclose(linear.jacobians[2][:, :, 2], 0.0, atol=1e-9)
        assert np.abs(linear.jacobians[2][:, [0, 1], [0, 1]]).min() > 100.0

    def test_what_is_behind_the_observer_is_invalid(self, camera: Pinhole) -> None:
        identity = np.array([1.0, 0, 0, 0, 0, 0, 0])
        back = [1.0, 0, 0, 0, 0, 0, -2.0]  # two metres behind a point one metre away
        turned = [0.0, 0.0, 1.0, 0.0, 0, 0, 0]
        observers = np.array([back, identity, turned, identity])
        ahead = np.array([[0.0, 0.0, rho] for rho in (1.0, 1.0, 0.0, 1.0 / 0.05)])
        linear = InverseDepthReprojection(camera, random_pixels(11)[:4]).linearize(identity, observers, ahead)
        assert linear.valid.tolist() == [False, True, False, False]
        for array in (linear.residuals, *linear.jacobians):
            assert not array[[0, 2, 3]].any()


def test_rho_jacobian_is_that_of_the_specification() -> None:
    anchors, observers, rho, seen = views(12)
    R, t = between(anchors, observers)
    X = np.einsum("nij,nj->ni", R, CAMERA.unproject(seen, 1.0 / rho[:, 0])[0]) + t
    u, v, scale = X[:, 0] / X[:, 2], X[:, 1] / X[:, 2], 1.0 / (rho[:, 0] * X[:, 2])
    expected = -np.stack([CAMERA.fx * (t[:, 0] - u * t[:, 2]) * scale, CAMERA.fy * (t[:, 1] - v * t[:, 2]) * scale], axis=1)
    linear = InverseDepthReprojection(CAMERA, random_pixels(13)).linearize(anchors, observers, point(CAMERA, seen, rho))
    got = linear.jacobians[2][:, :, 2]
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9)


class TestIntrinsicsThroughAWarp:
    def test_equals_inverse_depth_at_the_same_intrinsics(self) -> None:
        anchors, observers, rho, seen = views(16)
        pixels = random_pixels(17)
        expected = InverseDepthReprojection(CAMERA, pixels).linearize(anchors, observers, point(CAMERA, seen, rho))
        got = InverseDepthIntrinsics(pixels).linearize(anchors, observers, np.hstack([seen, rho]), CAMERA.parameters)
        np.testing.assert_allclose(got.residuals, expected.residuals, atol=1e-9)
        per_pixel = expected.jacobians[2] / [CAMERA.fx, CAMERA.fy, 1.0]
        for slot, J in enumerate((*expected.jacobians[:2], per_pixel)):
            np.testing.assert_allclose(got.jacobians[slot], J, rtol=1e-9, atol=1e-9)

    def test_the_anchor_does_not_measure_the_intrinsics(self) -> None:
        anchors, _, rho, seen = views(25)
        pixels = random_pixels(26)
        linear = InverseDepthIntrinsics(pixels).linearize(anchors, anchors, np.hstack([seen, rho]), CAMERA.parameters)
        np.testing.assert_allclose(linear.residuals, pixels - seen, atol=1e-9)
        np.testing.assert_allclose(linear.jacobians[3], 0.0, atol=1e-9)

    def test_jacobians(self) -> None:
        anchors, observers, rho, seen = views(18)
        intrinsics = CAMERA.parameters * np.random.default_rng(19).uniform(0.9, 1.1, (COUNT, 4))
        residual = InverseDepthIntrinsics(random_pixels(20))
        # A differently scaled step for every variable: 1e-3 of a pixel or of a focal length would drown in rounding.
        for pose in (SE3Left, SE3, Product(UnitQuaternion, Euclidean(3))):
            manifolds = tuple(pose if m == SE3Left else m for m in residual.manifolds)
            x = (anchors, observers, np.hstack([seen, rho]), intrinsics)
            report = check_jacobian(residual, *x, manifolds=manifolds, step=[1e-3, 1e-3, 1e-3, 0.1])
            assert report.passed and report.invalid == report.unsteady == 0 and report.largest_residual > 1.0, str(report)

    def test_focal_lengths_that_are_not_positive_are_invalid(self) -> None:
        anchors, observers, rho, seen = views(21)
        intrinsics = np.tile(CAMERA.parameters, (COUNT, 1))
        intrinsics[0, 0], intrinsics[1, 1] = 0.0, -400.0
        linear = InverseDepthIntrinsics(random_pixels(22)).linearize(anchors, observers, np.hstack([seen, rho]), intrinsics)
        assert linear.valid.tolist() == [False, False] + [True] * (COUNT - 2)
        for array in (linear.residuals, *linear.jacobians):
            assert not array[:2].any() and np.isfinite(array).all()


def test_input_is_checked() -> None:
    with pytest.raises(InputError, match=r"pixels of shape \(N, 2\) \[px\] – got shape \(1, 3\)"):
        InverseDepthReprojection(CAMERA, [[1.0, 2.0, 3.0]])
    with pytest.raises(InputError, match=r"pixels finite .* – got NaN or infinity in row 1"):
        InverseDepthIntrinsics([[1.0, 2.0], [np.nan, 4.0]])
    with pytest.raises(InputError, match="z_min finite and not negative"):
        InverseDepthIntrinsics([[1.0, 2.0]], z_min=-1.0)


class TestConsistency:
    """Whether the covariance of a pose says how wrong it is, with noise in every pixel, the anchors' too."""

    RUNS, POINTS, VIEWS = 60, 40, 4

    def errors(self, intrinsics: bool) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Errors (RUNS, 6) of the last pose and their covariances; frame and scale are held by the first two."""
        found = []
        for seed in range(self.RUNS):
            rng = np.random.default_rng([7, seed])
            sigma = rng.uniform(0.3, 0.8)
            T = SE3Left.boxplus(
                np.tile([1.0, 0, 0, 0, 0, 0, 0], (self.VIEWS, 1)),
                np.concatenate([np.zeros((1, 6)), rng.uniform(-1.0, 1.0, (self.VIEWS - 1, 6)) * np.repeat([0.05, 0.5], 3)]),
            )
            T[1, 4] = 1.0  # scale
            z = rng.uniform(3.0, 8.0, self.POINTS)
            p = np.column_stack([rng.uniform(-0.4, 0.4, (self.POINTS, 2)) * z[:, None], z])
            view, of = (grid.ravel() for grid in np.mgrid[: self.VIEWS, : self.POINTS])
            in_view = np.einsum("nij,nj->ni", quaternion.to_matrix(T[view, :4]), p[of]) + T[view, 4:]
            pixels = CAMERA.project(in_view)[0] + sigma * rng.standard_normal((len(view), 2))
            problem = Problem()
            poses = problem.add_variables(SE3Left, T)
            first = pixels[view == 0]
            start = np.hstack([first, 1.0 / z[:, None]]) if intrinsics else point(CAMERA, first, 1.0 / z[:, None])
            points = problem.add_variables(Euclidean(3), start)
            connections = [poses[np.zeros(len(view), int)], poses[view], points[of]]
            if intrinsics:
                c = problem.add_variables(Euclidean(4), CAMERA.parameters)
                problem.fix(c)
                problem.add_residuals(InverseDepthIntrinsics(pixels, sigma=sigma), *connections, c)
            else:
                problem.add_residuals(InverseDepthReprojection(CAMERA, pixels, sigma=sigma), *connections)
            problem.fix(poses[:2])
            solution = problem.solve()
            assert solution.status == "converged"
            last = poses[[self.VIEWS - 1]]
            found.append((SE3Left.boxminus(solution[last], T[-1:])[0], solution.covariance(last)[0]))
        errors, covariances = (np.array(part) for part in zip(*found, strict=True))
        return errors, covariances

    @pytest.mark.parametrize("intrinsics", [False, True], ids=["calibrated", "with intrinsics"])
    def test_the_noise_of_the_anchor_is_counted(self, intrinsics: bool) -> None:
        average = float(nees(*self.errors(intrinsics)).mean())
        low, high = nees_band(6, self.RUNS, 0.99)
        assert low < average < high


def test_several_cameras_in_one_group_are_those_of_a_group_each() -> None:
    anchors, observers, rho, seen = views(21)
    pixels, b = random_pixels(22), point(CAMERA, seen, rho)
    of = np.random.default_rng(23).integers(0, 2, COUNT)
    together = InverseDepthReprojection([CAMERA, LENS], pixels, camera_of=of).linearize(anchors, observers, b)
    for number, camera in enumerate((CAMERA, LENS)):
        n = of == number
        alone = InverseDepthReprojection(camera, pixels[n]).linearize(anchors[n], observers[n], b[n])
        assert np.array_equal(together.residuals[n], alone.residuals)
        assert all(np.array_equal(J[n], own) for J, own in zip(together.jacobians, alone.jacobians, strict=True))


@pytest.mark.parametrize("camera_of", [None, [0] * COUNT + [0], [2] * COUNT, [-1] * COUNT, [0.5] * COUNT])
def test_a_camera_that_is_not_there_is_refused(camera_of: list[float] | None) -> None:
    with pytest.raises(InputError, match=r"camera_of \(40,\), integers from 0 to 1"):
        InverseDepthReprojection([CAMERA, LENS], random_pixels(1), camera_of=camera_of)
