"""Pinhole cameras: projection against a direct reference, Jacobians against central differences, undistortion."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.cameras import Pinhole, Radial, RadialTangential
from boxplus.errors import InputError

DISTORTIONS = [
    None,
    Radial(-0.28, 0.07),
    RadialTangential(-0.28, 0.07, 2e-4, -3e-4),
    RadialTangential(0.26, -0.95, -5e-3, 2.6e-3, 1.16),
]
MODELS = [Pinhole(458.6, 457.3, 367.2, 248.4, distortion) for distortion in DISTORTIONS]


def reference_projection(camera: Pinhole, p: np.ndarray) -> np.ndarray:
    """Textbook projection of (n, 3) points, one line a term."""
    k1, k2, p1, p2, k3 = camera.padded_parameters[4:]
    x, y = p[:, 0] / p[:, 2], p[:, 1] / p[:, 2]
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    yd = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return np.stack([camera.fx * xd + camera.cx, camera.fy * yd + camera.cy], axis=1)


def points_in_view(rng: np.random.Generator, count: int) -> np.ndarray:
    z = rng.uniform(0.3, 30.0, count)
    return np.stack([rng.uniform(-0.7, 0.7, count) * z, rng.uniform(-0.5, 0.5, count) * z, z], axis=1)


def with_parameters(camera: Pinhole, parameters: np.ndarray) -> Pinhole:
    model = type(camera.distortion)(*parameters[4:]) if camera.distortion is not None else None
    return Pinhole(*parameters[:4], model, camera.z_min)


@pytest.mark.parametrize("camera", MODELS, ids=lambda c: f"{len(c.parameters)} intrinsics")
class TestModels:
    def test_projection_is_the_textbook_formula(self, camera: Pinhole) -> None:
        points = points_in_view(np.random.default_rng(1), 50)
        pixels, valid = camera.project(points)
        assert valid.all()
        np.testing.assert_allclose(pixels, reference_projection(camera, points), rtol=1e-13)

    def test_point_jacobian_is_the_derivative(self, camera: Pinhole) -> None:
        points = points_in_view(np.random.default_rng(2), 40)
        _, J, _, _ = camera.project_with_jacobians(points)
        for k in range(3):
            h = 1e-3 * points[:, 2:3] * np.eye(3)[k]
            difference = (
                8 * (camera.project(points + h)[0] - camera.project(points - h)[0])
                - camera.project(points + 2 * h)[0]
                + camera.project(points - 2 * h)[0]
            ) / (12 * 1e-3 * points[:, 2:3])
            np.testing.assert_allclose(J[:, :, k], difference, atol=1e-7 * np.abs(J).max())

    def test_intrinsics_jacobian_is_the_derivative(self, camera: Pinhole) -> None:
        points = points_in_view(np.random.default_rng(3), 40)
        _, _, J, _ = camera.project_with_jacobians(points)
        parameters = camera.parameters
        assert J.shape == (40, 2, len(parameters)) and len(camera.parameter_names) == len(parameters)
        for k in range(len(parameters)):
            h = 1e-3 * max(1.0, abs(parameters[k])) * np.eye(len(parameters))[k]
            high, low = with_parameters(camera, parameters + h), with_parameters(camera, parameters - h)
            # Pixels are linear in every intrinsic, so two points are exact.
            difference = (reference_projection(high, points) - reference_projection(low, points)) / (2 * h[k])
            np.testing.assert_allclose(J[:, :, k], difference, rtol=1e-9, atol=1e-9 * max(1.0, np.abs(J).max()))

    def test_unproject_inverts_project(self, camera: Pinhole) -> None:
        points = points_in_view(np.random.default_rng(4), 200)
        pixels, _ = camera.project(points)
        back, valid = camera.unproject(pixels, points[:, 2])
        assert valid.all()
        np.testing.assert_allclose(back, points, rtol=1e-9, atol=1e-9)

    def test_undistorted_pixels_are_those_of_the_camera_without_distortion(self, camera: Pinhole) -> None:
        points = points_in_view(np.random.default_rng(5), 30)
        undistorted, valid = camera.undistort(camera.project(points)[0])
        assert valid.all()
        ideal = dataclasses.replace(camera, distortion=None)
        np.testing.assert_allclose(undistorted, ideal.project(points)[0], atol=1e-8)


@given(st.floats(-0.6, 0.6), st.floats(-0.45, 0.45), st.floats(-0.3, 0.3), st.floats(-0.1, 0.1), st.floats(-3e-3, 3e-3))
def test_undistortion_is_right_or_says_that_it_is_not(x: float, y: float, k1: float, k2: float, p1: float) -> None:
    camera = Pinhole(400.0, 410.0, 320.0, 240.0, RadialTangential(k1, k2, p1, -p1))
    pixel, valid = camera.project([x, y, 1.0])
    back, found = camera.unproject(pixel)
    if valid and found:
        np.testing.assert_allclose(camera.project(back)[0], pixel, atol=1e-8)
    assert not found or np.isfinite(back).all()
    assert found or np.isnan(back).all()


def test_points_up_to_z_min_are_not_projected() -> None:
    pixels, valid = MODELS[1].project([[0.0, 0.0, 0.05], [0.0, 0.0, 0.0501], [0.1, 0.1, -3.0], [np.nan, 0.0, 1.0]])
    assert valid.tolist() == [False, True, False, False]
    assert np.isnan(pixels[[0, 2, 3]]).all()
    assert dataclasses.replace(MODELS[1], z_min=0.0).project([0.0, 0.0, 0.01])[1]


def test_points_beyond_the_fold_of_the_distortion_are_not_seen() -> None:
    camera = Pinhole(400.0, 400.0, 320.0, 240.0, Radial(-0.3, 0.0))
    fold = np.sqrt(1.0 / 0.9)  # d/dr (r − 0.3 r³) = 0
    _, valid = camera.project([[0.99 * fold, 0.0, 1.0], [1.01 * fold, 0.0, 1.0]])
    assert valid.tolist() == [True, False]
    reach = fold - 0.3 * fold**3
    _, found = camera.unproject([[320 + 400 * 0.999 * reach, 240.0], [320 + 400 * 1.001 * reach, 240.0]])
    assert found.tolist() == [True, False]


def test_batches_keep_their_leading_axes() -> None:
    points = points_in_view(np.random.default_rng(6), 6).reshape(2, 3, 3)
    pixels, J_point, J_intrinsics, valid = MODELS[2].project_with_jacobians(points)
    assert (pixels.shape, J_point.shape, J_intrinsics.shape, valid.shape) == ((2, 3, 2), (2, 3, 2, 3), (2, 3, 2, 8), (2, 3))
    rays, found = MODELS[2].unproject(pixels, points[..., 2])
    assert rays.shape == (2, 3, 3) and found.shape == (2, 3)


def test_line_matrix_maps_a_moment_to_the_line_through_two_pixels() -> None:
    camera = MODELS[0]
    rng = np.random.default_rng(7)
    p, q = points_in_view(rng, 2)
    l = camera.K_line @ np.cross(p, q - p)
    through = np.cross([*camera.project(p)[0], 1.0], [*camera.project(q)[0], 1.0])
    np.testing.assert_allclose(l / np.linalg.norm(l), through / np.linalg.norm(through) * np.sign(l @ through), atol=1e-12)
    np.testing.assert_allclose(camera.K_line, np.linalg.det(camera.K) * np.linalg.inv(camera.K).T, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"fx": 0.0}, r"expected fx positive and finite \[px\] – got 0.0 – a camera that looks along −z"),
        ({"fy": np.nan}, "expected fy positive"),
        ({"cx": np.inf}, "expected cx finite"),
        ({"z_min": -1.0}, "expected z_min finite and not negative"),
    ],
)
def test_impossible_cameras_are_refused(arguments: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Pinhole(**{"fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0, **arguments})


def test_coefficients_that_are_not_finite_are_refused() -> None:
    with pytest.raises(InputError, match="expected k2 finite – got nan – take the coefficients from a calibration"):
        Radial(0.1, np.nan)
    with pytest.raises(InputError, match="expected k3 finite"):
        RadialTangential(0.1, 0.0, 0.0, 0.0, np.inf)


def test_shapes_are_checked() -> None:
    with pytest.raises(InputError, match=r"p_camera of shape \(\.\.\., 3\)"):
        MODELS[0].project([1.0, 2.0])
    with pytest.raises(InputError, match=r"pixels of shape \(\.\.\., 2\)"):
        MODELS[0].unproject([1.0, 2.0, 3.0])
