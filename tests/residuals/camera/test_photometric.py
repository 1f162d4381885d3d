"""The photometric error: plain NumPy, differences inside of pixel cells, and the formulas of its page in docs/."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from boxplus.cameras.distortion import RadialTangential
from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se3
from boxplus.manifolds.se3 import SE3, SE3Left
from boxplus.optimization.jacobian_check import check_jacobian
from boxplus.residuals.camera.photometric import DSO_PATTERN, Photometric
from boxplus.residuals.camera.photometric_sampling import sample

HEIGHT, WIDTH = 60, 80
CAMERA = Pinhole(70.0, 75.0, 39.5, 29.5)
LENS = Pinhole(70.0, 75.0, 39.5, 29.5, RadialTangential(0.1, -0.05, 1e-3, 2e-3))
T_21 = se3.exp(np.array([0.05, -0.03, 0.08, 0.1, -0.05, 0.1]))
BRIGHTNESS = np.array([0.1, 3.0])
seeds = st.integers(0, 2**32 - 1)


def images(seed: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """White noise: neighbouring pixels have nothing in common, so that no wrong gradient is right by chance."""
    rng = np.random.default_rng(seed)
    first, second = rng.uniform(0.0, 255.0, (2, HEIGHT, WIDTH)).astype(np.float32)
    return first, second


def warp(camera: Pinhole, pixels: NDArray[np.float64], depth: NDArray[np.float64]) -> NDArray[np.float64]:
    rays, _ = camera.unproject(pixels)
    R = quaternion.to_matrix(T_21[:4])
    return camera.project(depth[:, None] * rays @ R.T + T_21[4:])[0]


def inner_pixels(seed: int, camera: Pinhole, count: int = 30) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels of image 1 and depths that land well inside of a cell of image 2, away from the kinks of the interpolant."""
    rng = np.random.default_rng(seed)
    pixels, depth = rng.uniform([20.0, 20.0], [60.0, 40.0], (20 * count, 2)), rng.uniform(2.0, 5.0, 20 * count)
    share = warp(camera, pixels, depth) % 1.0
    inner = ((share > 0.2) & (share < 0.8)).all(axis=1)
    assert inner.sum() >= count
    return pixels[inner][:count], depth[inner][:count]


@given(seeds)
@settings(max_examples=20)
def test_sampling_is_bilinear_with_its_exact_gradient(seed: int) -> None:
    image, rng = images(seed)[0], np.random.default_rng(seed)
    pixels = np.floor(rng.uniform([0.0, 0.0], [WIDTH - 1.0, HEIGHT - 1.0], (200, 2))) + rng.uniform(0.05, 0.95, (200, 2))
    values, gradients, valid = sample(image, pixels)
    assert valid.all()

    def oracle(at: NDArray[np.float64]) -> NDArray[np.float64]:
        return map_coordinates(image.astype(np.float64), at.T[::-1], order=1)

    np.testing.assert_allclose(values, oracle(pixels), atol=1e-11)
    for axis in range(2):
        step = 0.01 * np.eye(2)[axis]
        np.testing.assert_allclose(gradients[:, axis], (oracle(pixels + step) - oracle(pixels - step)) / 0.02, atol=1e-9)


def test_sampling_at_the_border() -> None:
    image = images(0)[0]
    inside = [(0.0, 0.0), (WIDTH - 1.0 - 1e-9, 0.0), (3.0, HEIGHT - 1.0 - 1e-9)]
    outside = [(-1e-9, 1.0), (1.0, -1e-9), (WIDTH - 1.0, 1.0), (1.0, HEIGHT - 1.0), (np.nan, 1.0), (np.inf, 1.0), (1.0, -np.inf)]
    values, gradients, valid = sample(image, [inside + outside])
    assert valid.shape == (1, 10) and valid[0, :3].all() and not valid[0, 3:].any()
    assert np.isnan(values[0, 3:]).all() and np.isnan(gradients[0, 3:]).all()
    assert values[0, 0] == image[0, 0]


VARIANTS = [
    {},
    {"brightness": True},
    {"inverse_depth": True},
    {"intrinsics": True},
    {"inverse_depth": True, "intrinsics": True, "brightness": True},
]


def build(
    camera: Pinhole, seed: int, variant: dict[str, object]
) -> tuple[Photometric, list[NDArray[np.float64]], list[NDArray[np.float64]]]:
    """The residual, a value for every variable, and steps that stay inside of pixel cells."""
    pixels, depth = inner_pixels(seed, camera)
    given_depth = None if variant.get("inverse_depth") else depth
    residual = Photometric(camera, *images(seed), pixels, given_depth, **variant)  # type: ignore[arg-type]
    x, steps = [T_21], [np.full(6, 5e-4)]
    if variant.get("inverse_depth"):
        x, steps = [*x, 1.0 / depth[:, None]], [*steps, np.array([1e-3])]
    if variant.get("intrinsics"):
        x, steps = [*x, camera.parameters], [*steps, np.full(4, 2e-2)]
    if variant.get("brightness"):
        x, steps = [*x, BRIGHTNESS], [*steps, np.full(2, 1e-3)]
    return residual, x, steps


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: "+".join(v) or "pose")
@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "distorted"])
def test_jacobians(camera: Pinhole, variant: dict[str, object]) -> None:
    if camera is LENS and "intrinsics" in variant:
        with pytest.raises(InputError, match="without distortion where the intrinsics are variables"):
            build(camera, 1, variant)
        return
    for seed in range(3):
        residual, x, steps = build(camera, seed, variant)
        for side in (SE3Left, SE3):
            report = check_jacobian(residual, *x, manifolds=(side, *residual.manifolds[1:]), step=steps)
            assert report.passed and report.invalid == report.unsteady == 0 and report.largest_residual > 10.0, str(report)


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "distorted"])
def test_a_patch_is_its_pixels(camera: Pinhole) -> None:
    variant = {"inverse_depth": True, "brightness": True}
    pixels, depth = inner_pixels(2, camera)
    pair = images(2)
    x = [T_21, 1.0 / depth[:, None], BRIGHTNESS]
    patch = Photometric(camera, *pair, pixels, pattern=DSO_PATTERN, **variant).linearize(*x)  # type: ignore[arg-type]
    assert patch.valid.all()
    for k, offset in enumerate(DSO_PATTERN):
        single = Photometric(camera, *pair, pixels + offset, **variant).linearize(*x)  # type: ignore[arg-type]
        assert np.array_equal(patch.residuals[:, k], single.residuals[:, 0])
        for J_patch, J_single in zip(patch.jacobians, single.jacobians, strict=True):
            assert np.array_equal(J_patch[:, k], J_single[:, 0])


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "distorted"])
def test_residual_and_pose_jacobian_are_the_formulas(camera: Pinhole) -> None:
    first, second = images(3)
    pixels, depth = inner_pixels(3, camera)
    found = Photometric(camera, first, second, pixels, depth).linearize(T_21)
    rays, _ = camera.unproject(pixels)
    X = depth[:, None] * rays @ quaternion.to_matrix(T_21[:4]).T + T_21[4:]
    p_2, P, _, _ = camera.project_with_jacobians(X)
    I_1, _, _ = sample(first, pixels)
    I_2, gradient, _ = sample(second, p_2)
    np.testing.assert_allclose(found.residuals[:, 0], I_1 - I_2, atol=1e-9)
    minus_cross = np.array([[[0, z, -y], [-z, 0, x], [y, -x, 0]] for x, y, z in X])  # −[X']x
    motion = np.concatenate([minus_cross, np.tile(np.eye(3), (len(X), 1, 1))], axis=2)
    expected = -np.einsum("ni,nij,njk->nk", gradient, P, motion)
    np.testing.assert_allclose(found.jacobians[0][:, 0], expected, rtol=1e-9, atol=1e-6)


def test_intrinsics_and_inverse_depth_jacobians_are_those_of_the_spec() -> None:
    first, second = images(4)
    pixels, depth = inner_pixels(4, CAMERA)
    fx, fy, cx, cy = c = CAMERA.parameters
    fixed = Photometric(CAMERA, first, second, pixels, depth, intrinsics=True).linearize(T_21, c)
    free = Photometric(CAMERA, first, second, pixels, inverse_depth=True).linearize(T_21, 1.0 / depth[:, None])
    r, t = quaternion.to_matrix(T_21[:4]), T_21[4:]
    for n, ((u1, v1), Z) in enumerate(zip(pixels, depth, strict=True)):
        m1, m2 = (u1 - cx) / fx, (v1 - cy) / fy
        X = Z * r @ [m1, m2, 1.0] + t
        u, v, kappa = X[0] / X[2], X[1] / X[2], Z / X[2]
        J_c = np.array(
            [
                [
                    u + kappa * (r[2, 0] * u - r[0, 0]) * m1,
                    kappa * fx / fy * (r[2, 1] * u - r[0, 1]) * m2,
                    1.0 + kappa * (r[2, 0] * u - r[0, 0]),
                    kappa * fx / fy * (r[2, 1] * u - r[0, 1]),
                ],
                [
                    kappa * fy / fx * (r[2, 0] * v - r[1, 0]) * m1,
                    v + kappa * (r[2, 1] * v - r[1, 1]) * m2,
                    kappa * fy / fx * (r[2, 0] * v - r[1, 0]),
                    1.0 + kappa * (r[2, 1] * v - r[1, 1]),
                ],
            ]
        )
        J_rho = Z / X[2] * np.array([fx * (t[0] - u * t[2]), fy * (t[1] - v * t[2])])
        _, gradient, _ = sample(second, [fx * u + cx, fy * v + cy])
        np.testing.assert_allclose(fixed.jacobians[1][n, 0], -gradient @ J_c, rtol=1e-8, atol=1e-7)
        np.testing.assert_allclose(free.jacobians[1][n, 0, 0], -gradient @ J_rho, rtol=1e-8, atol=1e-6)


def test_a_point_at_infinity_has_the_limits_of_the_derivatives() -> None:
    first, second = images(5)
    pixels = inner_pixels(5, CAMERA)[0]
    residual = Photometric(CAMERA, first, second, pixels, inverse_depth=True)
    near = residual.linearize(T_21, [1.001e-6])
    for rho in (0.999e-6, 0.0, -0.3):
        infinite = residual.linearize(T_21, [rho])
        assert np.array_equal(near.valid, infinite.valid) and infinite.valid.any()
        np.testing.assert_allclose(infinite.residuals, near.residuals, atol=0.05)
        assert np.array_equal(infinite.jacobians[0][:, 0, 3:], np.zeros((len(pixels), 3)))
    still = np.concatenate([T_21[:4], np.zeros(3)])
    assert np.array_equal(residual.linearize(still, [0.4]).jacobians[1], np.zeros((len(pixels), 1, 1)))  # no parallax


def test_invalid_residuals_are_zero() -> None:
    first, second = images(6)
    pixels = np.array([[40.0, 30.0], [3.0, 30.0], [40.0, 4.0]])
    residual = Photometric(CAMERA, first, second, pixels, [2.0, 2.0, 2.0], pattern=DSO_PATTERN, brightness=True)
    to_the_left = np.array([1.0, 0, 0, 0, -0.05, -0.05, 0.0])
    found = residual.linearize(to_the_left, BRIGHTNESS)
    assert found.valid.tolist() == [True, False, True]
    behind = residual.linearize(np.array([1.0, 0, 0, 0, 0, 0, -2.0]), BRIGHTNESS)
    assert not behind.valid.any()
    for linearization, rows in ((found, [1]), (behind, [0, 1, 2])):
        assert not linearization.residuals[rows].any()
        assert not any(J[rows].any() for J in linearization.jacobians)


def test_refusals() -> None:
    first, second = images(7)
    pixels, depth = np.array([[30.0, 20.0]]), np.array([2.0])

    def refused(message: str, *arguments: object, **options: object) -> None:
        with pytest.raises(InputError, match=message):
            Photometric(*arguments, **options)  # type: ignore[arg-type]

    refused(r"image_1 of shape \(height, width\)", CAMERA, np.zeros((5, 5, 3)), second, pixels, depth)
    holed = second.copy()
    holed[4, 7] = np.nan
    refused(r"image_2 finite – got nan at row and column \(4, 7\)", CAMERA, first, holed, pixels, depth)
    refused("patches inside of image 1 – got .* of patch 0", CAMERA, first, second, [[1.0, 20.0]], depth, pattern=DSO_PATTERN)
    refused("pixels_1 finite", CAMERA, first, second, [[np.nan, 2.0]], depth)
    refused("pattern finite", CAMERA, first, second, pixels, depth, pattern=(0, 0))
    refused("depth_1 positive and finite – got 0.0 for pixel 0", CAMERA, first, second, pixels, [0.0])
    refused(r"depth_1 of shape \(1,\)", CAMERA, first, second, pixels, [1.0, 2.0])
    refused("expected depth_1 – got none", CAMERA, first, second, pixels)
    refused("no depth_1 where the inverse depth", CAMERA, first, second, pixels, depth, inverse_depth=True)


def test_a_smoothed_gradient_is_that_of_a_parabola_and_does_not_jump() -> None:
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    image = 0.5 * u * u - 0.25 * v * v + 3.0 * u
    pixels = np.random.default_rng(0).uniform([20.0, 20.0], [60.0, 40.0], (40, 2))
    pixels[0] = 30.0, 30.0  # where the exact one has a kink
    given = {"depth_1": np.full(40, 2.0)}
    smoothed = Photometric(CAMERA, image, image, pixels, **given, gradient="smoothed")
    exact = Photometric(CAMERA, image, image, pixels, **given)
    still = SE3Left.identity()
    J = smoothed.linearize(still).jacobians[0]
    assert np.array_equal(smoothed.evaluate(still), exact.evaluate(still))
    along = np.column_stack([pixels[:, 0] + 3.0, -0.5 * pixels[:, 1]]) * [CAMERA.fx, CAMERA.fy]
    assert np.allclose(J[:, 0, 3:5], -along / 2.0, atol=1e-3)
    assert not np.allclose(exact.linearize(still).jacobians[0][:, 0, 3:5], -along / 2.0, atol=1.0)
    at_border = Photometric(CAMERA, image, image, [[0.5, 20.0], [1.0, 20.0], [78.0, 20.0]], np.full(3, 2.0), gradient="smoothed")
    assert at_border.linearize(still).valid.tolist() == [False, True, False]
    with pytest.raises(InputError, match=r"got 'central' – leave it"):
        Photometric(CAMERA, image, image, pixels, **given, gradient="central")
