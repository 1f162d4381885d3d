"""Cameras of wide angle: against the formulas of their papers and OpenCV, Jacobians against differences, and the way back."""

from __future__ import annotations

import dataclasses
import importlib.util

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.cameras import DoubleSphere, Equidistant, Pinhole
from boxplus.errors import InputError
from boxplus.residuals import LineReprojection, Photometric
from boxplus.systems.direct_alignment.direct_alignment import align_rgbd

WideAngle = Equidistant | DoubleSphere
CAMERAS: list[WideAngle] = [
    Equidistant(190.98, 190.97, 254.93, 256.90, 3.48e-3, 7.15e-4, -2.05e-3, 2.03e-4),  # TUM VI
    Equidistant(460.0, 455.0, 370.0, 240.0, -0.02, 0.03, -0.05, 0.02),
    Equidistant(300.0, 301.0, 320.0, 240.0),
    DoubleSphere(349.56, 349.53, 365.89, 249.31, -0.2409, 0.5658),  # EuRoC, as the TUM visnav course calibrates it
    DoubleSphere(313.21, 313.21, 638.66, 514.39, -0.1818, 0.5919),
    DoubleSphere(400.0, 410.0, 320.0, 240.0, 0.4, 0.3),
    DoubleSphere(400.0, 410.0, 320.0, 240.0, 0.0, 0.0),
]
by_camera = pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: f"{type(c).__name__} {c.fx}")


def reference(camera: WideAngle, p: np.ndarray) -> np.ndarray:
    """Both papers' formulas, one line a term, for (n, 3) points off the axis."""
    x, y, z = p.T
    rho = np.hypot(x, y)
    if isinstance(camera, Equidistant):
        theta = np.arctan2(rho, z)
        angle = sum(k * theta ** (2 * n + 1) for n, k in enumerate((1.0, camera.k1, camera.k2, camera.k3, camera.k4)))
        mx, my = angle * x / rho, angle * y / rho
    else:
        d1 = np.sqrt(x**2 + y**2 + z**2)
        d2 = np.sqrt(x**2 + y**2 + (camera.xi * d1 + z) ** 2)
        under = camera.alpha * d2 + (1 - camera.alpha) * (camera.xi * d1 + z)
        mx, my = x / under, y / under
    return np.stack([camera.fx * mx + camera.cx, camera.fy * my + camera.cy], axis=1)


def points(camera: WideAngle, seed: int, count: int, share: float = 0.97) -> np.ndarray:
    """Points at all angles up to a share of the largest, on and near the axis among them, at distances of 0.1 to 30 m."""
    rng = np.random.default_rng(seed)
    theta = share * camera.theta_max * np.concatenate([rng.uniform(0, 1, count), 10.0 ** rng.uniform(-9, -1, count)])
    phi, distance = rng.uniform(0, 2 * np.pi, 2 * count), 10.0 ** rng.uniform(-1, 1.5, 2 * count)
    return distance[:, None] * np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)


@by_camera
def test_projection_is_the_formula_of_the_paper(camera: WideAngle) -> None:
    p = points(camera, 1, 200)
    pixels, seen = camera.project(p)
    assert seen.all()
    np.testing.assert_allclose(pixels, reference(camera, p), rtol=1e-11, atol=1e-9)


@by_camera
def test_point_jacobian_is_the_derivative(camera: WideAngle) -> None:
    p = points(camera, 2, 200, 0.9)
    _, J, _, seen = camera.project_with_jacobians(p)
    assert seen.all()
    distance = np.linalg.norm(p, axis=1)
    for k in range(3):
        h = 1e-3 * distance[:, None] * np.eye(3)[k]
        near = 8 * (camera.project(p + h)[0] - camera.project(p - h)[0])
        far = camera.project(p + 2 * h)[0] - camera.project(p - 2 * h)[0]
        difference = (near - far) / (12e-3 * distance[:, None])
        scale = np.abs(J * distance[:, None, None]).max()
        np.testing.assert_allclose((J[:, :, k] - difference) * distance[:, None] / scale, 0.0, atol=2e-8)


@by_camera
def test_intrinsics_jacobian_is_the_derivative(camera: WideAngle) -> None:
    p = points(camera, 3, 100, 0.8)
    _, _, J, _ = camera.project_with_jacobians(p)
    names, parameters = camera.parameter_names, camera.parameters
    assert J.shape == (len(p), 2, len(names)) == (len(p), 2, len(parameters))
    for k, name in enumerate(names):
        h = 1e-5 * max(1.0, abs(parameters[k]))
        if name == "alpha" and parameters[k] - h < 0.0:
            continue  # at its bound; the derivative there is that of the other cameras
        high, low = (dataclasses.replace(camera, **{name: parameters[k] + sign * h}) for sign in (1, -1))
        difference = (reference(high, p) - reference(low, p)) / (2 * h)
        np.testing.assert_allclose(J[:, :, k], difference, atol=2e-6 * max(1.0, np.abs(J[:, :, k]).max()))


@by_camera
def test_the_jacobian_does_not_jump_where_the_series_ends(camera: WideAngle) -> None:
    near, far = (camera.project_with_jacobians([t * 1.2, t * 1.6, 2.0])[1] for t in (0.9999999e-3, 1.0000001e-3))
    np.testing.assert_allclose(near, far, atol=1e-7 * camera.fx)


@by_camera
def test_bearings_invert_project(camera: WideAngle) -> None:
    p = points(camera, 4, 500, 0.999)
    pixels, _ = camera.project(p)
    bearings, found = camera.bearings(pixels)
    assert found.all()
    np.testing.assert_allclose(bearings, p / np.linalg.norm(p, axis=1, keepdims=True), atol=2e-7)
    inner = points(camera, 5, 500, 0.9)
    bearings, _ = camera.bearings(camera.project(inner)[0])
    np.testing.assert_allclose(bearings, inner / np.linalg.norm(inner, axis=1, keepdims=True), atol=1e-11)
    ahead = inner[inner[:, 2] > 0.05]
    back, found = camera.unproject(camera.project(ahead)[0], ahead[:, 2])
    assert found.all()
    np.testing.assert_allclose(back, ahead, rtol=1e-9, atol=1e-9)


@given(
    st.floats(-0.3, 0.3), st.floats(-0.2, 0.2), st.floats(-0.1, 0.1), st.floats(-0.05, 0.05),
    st.floats(-900.0, 1600.0), st.floats(-900.0, 1600.0),
)  # fmt: skip
def test_an_equidistant_bearing_is_right_or_not_found(k1: float, k2: float, k3: float, k4: float, u: float, v: float) -> None:
    camera = Equidistant(300.0, 310.0, 320.0, 240.0, k1, k2, k3, k4)
    bearing, found = camera.bearings([u, v])
    if found:
        assert abs(np.linalg.norm(bearing) - 1.0) < 1e-12
        pixel, seen = camera.project(bearing)
        angle = np.arctan2(np.hypot(bearing[0], bearing[1]), bearing[2])
        assert seen or angle > camera.theta_max - 1e-6
        if seen:
            np.testing.assert_allclose(pixel, [u, v], atol=1e-8)
    else:
        assert np.isnan(bearing).all()
        reach = np.hypot((u - 320.0) / 300.0, (v - 240.0) / 310.0)
        edge = camera.theta_max
        assert reach > edge * (1 + k1 * edge**2 + k2 * edge**4 + k3 * edge**6 + k4 * edge**8) - 1e-9


@given(st.floats(-0.9, 1.5), st.floats(0.0, 1.0), st.floats(-900.0, 1600.0), st.floats(-900.0, 1600.0))
def test_a_double_sphere_bearing_is_right_or_not_found(xi: float, alpha: float, u: float, v: float) -> None:
    camera = DoubleSphere(300.0, 310.0, 320.0, 240.0, xi, alpha)
    bearing, found = camera.bearings([u, v])
    if found:
        assert abs(np.linalg.norm(bearing) - 1.0) < 1e-9
        pixel, seen = camera.project(bearing)
        assert seen
        np.testing.assert_allclose(pixel, [u, v], atol=1e-5)
    else:
        assert np.isnan(bearing).all()


def test_what_is_behind_too_near_or_beyond_the_fold_is_not_seen() -> None:
    fisheye = Equidistant(300.0, 300.0, 320.0, 240.0, -0.1, 0.0, 0.0, 0.0)
    fold = np.sqrt(1.0 / 0.3)  # d/dθ (θ − 0.1 θ³) = 0
    assert fisheye.theta_max == pytest.approx(fold)
    directions = [[np.sin(t), 0.0, np.cos(t)] for t in (0.99 * fold, 1.01 * fold)]
    assert fisheye.project(directions)[1].tolist() == [True, False]
    for camera in CAMERAS:
        pixels, seen = camera.project([[0, 0, -2.0], [0, 0, 0.04], [np.nan, 0, 1], [0, 0, 0], [0, 0, 0.06], [1e-13, 0, -1]])
        assert seen.tolist() == [False, False, False, False, True, False]
        assert np.isnan(pixels[~seen]).all()
    sideways = Equidistant(190.98, 190.97, 254.93, 256.90, 3.48e-3, 7.15e-4, -2.05e-3, 2.03e-4)
    pixels, seen = sideways.project([[1.0, 0.0, 0.0], [1.0, 0.0, -0.2]])
    assert seen.all()  # more than 180° of view
    assert sideways.unproject(pixels)[1].tolist() == [False, False]  # no point at a depth
    assert sideways.bearings(pixels)[1].all()


def test_special_cases_are_pinholes() -> None:
    """A double sphere with ξ = α = 0 is a pinhole; undistortion gives the pixels of one."""
    p = points(CAMERAS[6], 6, 50, 0.8)
    pinhole = Pinhole(400.0, 410.0, 320.0, 240.0)
    np.testing.assert_allclose(CAMERAS[6].project(p)[0], pinhole.project(p)[0], atol=1e-9)
    for camera in CAMERAS:
        ahead = points(camera, 7, 50, 0.4)
        undistorted, found = camera.undistort(camera.project(ahead)[0])
        assert found.all()
        expected = Pinhole(camera.fx, camera.fy, camera.cx, camera.cy, z_min=0.0).project(ahead)[0]
        np.testing.assert_allclose(undistorted, expected, atol=1e-8)


@pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="OpenCV (extra `vision`) is not installed")
@pytest.mark.parametrize("camera", [c for c in CAMERAS if isinstance(c, Equidistant)], ids=lambda c: f"{c.fx}")
def test_equidistant_is_the_fisheye_of_opencv(camera: Equidistant) -> None:
    import cv2

    p = points(camera, 8, 100, 1.2 / camera.theta_max)  # OpenCV's knows directions before the camera only
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    D = np.array([camera.k1, camera.k2, camera.k3, camera.k4])
    theirs, _ = cv2.fisheye.projectPoints(p[:, None], np.zeros(3), np.zeros(3), K, D)
    ours, seen = camera.project(p)
    assert seen.all()
    np.testing.assert_allclose(ours, theirs[:, 0], atol=1e-6)
    rays = cv2.fisheye.undistortPoints(theirs, K, D)[:, 0]
    np.testing.assert_allclose(camera.unproject(ours)[0][:, :2], rays, rtol=1e-5, atol=1e-6)


def test_batches_keep_their_leading_axes() -> None:
    p = points(CAMERAS[0], 9, 3).reshape(2, 3, 3)
    pixels, J_point, J_intrinsics, seen = CAMERAS[0].project_with_jacobians(p)
    assert (pixels.shape, J_point.shape, J_intrinsics.shape, seen.shape) == ((2, 3, 2), (2, 3, 2, 3), (2, 3, 2, 8), (2, 3))
    bearings, found = CAMERAS[0].bearings(pixels)
    assert bearings.shape == (2, 3, 3) and found.shape == (2, 3)


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        (Equidistant, {"fx": 0.0}, "fx positive"),
        (Equidistant, {"k3": np.nan}, "k3 finite"),
        (Equidistant, {"nearest": -1.0}, "nearest finite and not negative"),
        (DoubleSphere, {"alpha": 1.2}, "alpha in \\[0, 1\\] – got 1.2 – Kalibr writes xi before alpha"),
        (DoubleSphere, {"xi": -1.0}, "xi above −1"),
    ],
)
def test_impossible_cameras_are_refused(kind: type[WideAngle], changes: dict[str, float], message: str) -> None:
    camera = next(camera for camera in CAMERAS if type(camera) is kind)
    with pytest.raises(InputError, match=message):
        dataclasses.replace(camera, **changes)


def test_what_takes_a_pinhole_refuses_other_lenses() -> None:
    image = np.zeros((40, 40), np.float32)
    fisheye = Equidistant(30.0, 30.0, 20.0, 20.0)
    with pytest.raises(InputError, match="a Pinhole for photometric residuals – got Equidistant"):
        Photometric(fisheye, image, image, [[20.0, 20.0]], [1.0])  # type: ignore[arg-type]
    with pytest.raises(InputError, match="a Pinhole for direct alignment – got Equidistant"):
        align_rgbd(image, image + 1.0, image, fisheye)  # type: ignore[arg-type]
    with pytest.raises(InputError):
        LineReprojection(fisheye, [[1.0, 2.0, 10.0, 20.0]])  # type: ignore[arg-type]
