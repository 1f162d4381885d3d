"""Line reprojection: against NumPy, against central differences, at the singular cases of docs/residuals/line_reprojection.md."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.cameras import Pinhole, Radial
from boxplus.errors import InputError
from boxplus.manifolds import lines, quaternion
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.lines import Line3D
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import UnitQuaternion
from boxplus.manifolds.se3 import SE3, SE3Left
from boxplus.optimization.jacobian_check import check_jacobian
from boxplus.residuals.camera.line_reprojection import LineReprojection
from boxplus.residuals.residual import Residual

CAMERA = Pinhole(420.0, 430.0, 310.0, 245.0)
SKEWED = np.array([[420.0, 12.0, 310.0], [0.0, 430.0, 245.0], [0.0, 0.0, 1.0]])
IDENTITY = np.array([1.0, 0, 0, 0, 0, 0, 0])


def assert_jacobians(residual: Residual, *x: NDArray[np.float64]) -> None:
    """Against differences far from zero residual, on every update of the poses."""
    for pose in (SE3Left, SE3, Product(UnitQuaternion, Euclidean(3))):
        manifolds = tuple(pose if m == SE3Left else m for m in residual.manifolds)
        report = check_jacobian(residual, *x, manifolds=manifolds)
        assert report.passed and report.invalid == report.unsteady == 0 and report.largest_residual > 1.0, str(report)


def random_segments(seed: int, count: int) -> NDArray[np.float64]:
    return np.random.default_rng(seed).uniform(0.0, 600.0, (count, 4))


def seen_lines(seed: int, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Poses, lines (count, 5) and two points on each in its camera frame (count, 2, 3), in the field of view."""
    rng = np.random.default_rng(seed)
    poses = SE3Left.random(rng, count)
    z = rng.uniform(1.0, 9.0, (count, 2, 1))
    p_camera = np.concatenate([rng.uniform(-0.6, 0.6, (count, 2, 2)) * z, z], axis=2)
    R = quaternion.to_matrix(poses[:, :4])
    p_world = np.einsum("nji,nkj->nki", R, p_camera - poses[:, None, 4:])
    return poses, lines.from_points(p_world[:, 0], p_world[:, 1]), p_camera


def reference(K: NDArray[np.float64], p_camera: NDArray[np.float64], segments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances of the end points to the line through the two projected points, up to one sign for each residual."""
    start, end = p_camera[:, 0] @ K.T, p_camera[:, 1] @ K.T
    l = np.cross(start / start[:, 2:], end / end[:, 2:])
    l /= np.linalg.norm(l[:, :2], axis=1, keepdims=True)
    ones = np.ones((len(segments), 1))
    return np.stack([(np.hstack([segments[:, k : k + 2], ones]) * l).sum(axis=1) for k in (0, 2)], axis=1)


@pytest.mark.parametrize("camera", [CAMERA, SKEWED], ids=["pinhole", "with skew"])
def test_residual_is_the_distance_to_the_line_through_two_projected_points(camera: Pinhole | NDArray[np.float64]) -> None:
    poses, line, p_camera = seen_lines(1, 40)
    segments = random_segments(2, 40)
    expected = reference(camera.K if isinstance(camera, Pinhole) else camera, p_camera, segments)
    got = LineReprojection(camera, segments).evaluate(poses, line)
    sign = np.sign((got * expected).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(got, sign * expected, atol=1e-7)


@pytest.mark.parametrize("camera", [CAMERA, SKEWED], ids=["pinhole", "with skew"])
def test_jacobians(camera: Pinhole | NDArray[np.float64]) -> None:
    poses, line, _ = seen_lines(3, 60)
    assert_jacobians(LineReprojection(camera, random_segments(4, 60)), poses, line)


def test_jacobians_of_lines_through_the_origin_of_the_world() -> None:
    rng = np.random.default_rng(5)
    line = lines.from_plucker(np.concatenate([np.zeros((20, 3)), rng.normal(size=(20, 3))], axis=1))
    poses = SE3Left.random(rng, 20)
    poses[:, 6] += 4.0
    assert_jacobians(LineReprojection(CAMERA, random_segments(6, 20)), poses, line)


def test_each_observation_may_have_its_own_calibration() -> None:
    poses, line, _ = seen_lines(7, 6)
    segments = random_segments(8, 6)
    K = np.stack([CAMERA.K, SKEWED] * 3)
    got = LineReprojection(K, segments).evaluate(poses, line)
    np.testing.assert_array_equal(got[::2], LineReprojection(CAMERA.K, segments[::2]).evaluate(poses[::2], line[::2]))
    np.testing.assert_array_equal(got[1::2], LineReprojection(SKEWED, segments[1::2]).evaluate(poses[1::2], line[1::2]))


def test_moving_an_end_point_along_the_line_changes_nothing() -> None:
    """The residual does not constrain motion along the line (docs/residuals/line_reprojection.md)."""
    poses, line, p_camera = seen_lines(9, 30)
    pixels = CAMERA.project(p_camera)[0]
    along = pixels[:, 0] + np.random.default_rng(10).uniform(0.1, 3.0, (30, 1)) * (pixels[:, 1] - pixels[:, 0])
    segments = np.hstack([pixels[:, 0], along])
    long = np.hypot(*(segments[:, 2:] - segments[:, :2]).T) > 1.0
    np.testing.assert_allclose(LineReprojection(CAMERA, segments[long]).evaluate(poses[long], line[long]), 0.0, atol=1e-7)


def test_lines_through_the_camera_centre_and_at_infinity_are_invalid() -> None:
    rng = np.random.default_rng(11)
    pose = SE3Left.random(rng, 1)[0]
    centre = -quaternion.to_matrix(pose[:4]).T @ pose[4:]
    through_centre = lines.from_points(centre, centre + rng.normal(size=3))
    # In the plane of the image of an untilted camera every line is seen at infinity.
    in_plane = lines.from_points([1.0, 2.0, 0.0], [4.0, -1.0, 0.0])
    sound = lines.from_points([1.0, 2.0, 3.0], [4.0, -1.0, 5.0])
    poses = np.stack([pose, IDENTITY, IDENTITY])
    linear = LineReprojection(CAMERA, random_segments(12, 3)).linearize(poses, np.stack([through_centre, in_plane, sound]))
    assert linear.valid.tolist() == [False, False, True]
    for array in (linear.residuals, *linear.jacobians):
        assert not array[:2].any() and array[2].any()


def test_a_nan_is_not_hidden_as_invalid() -> None:
    line = Line3D.random(np.random.default_rng(13), 1)[0]
    line[4] = np.nan
    linear = LineReprojection(CAMERA, random_segments(14, 1)).linearize(IDENTITY, line)
    assert linear.valid[0] and np.isnan(linear.residuals).any()


def test_short_segments_are_refused_or_dropped(caplog: pytest.LogCaptureFixture) -> None:
    segments = random_segments(15, 5)
    segments[1, 2:] = segments[1, :2] + [0.6, 0.6]
    segments[3, 2:] = segments[3, :2]
    with pytest.raises(InputError, match="expected segments of 1 px and longer – got 2 shorter: rows 1, 3 – their direction is"):
        LineReprojection(CAMERA, segments)
    sigma = np.arange(1.0, 6.0)[:, None]
    with caplog.at_level(logging.WARNING):
        residual = LineReprojection(np.stack([CAMERA.K] * 5), segments, sigma=sigma, drop_short=True)
    assert "dropped 2 of 5 segments shorter than 1 px: rows 1, 3" in caplog.text
    assert residual.kept.tolist() == [0, 2, 4] and residual.dropped.tolist() == [1, 3] and residual.count == 3
    np.testing.assert_allclose(1.0 / residual.whitening.factors[:, 0, 0], [1.0, 3.0, 5.0])
    poses, line, _ = seen_lines(16, 5)
    whole = LineReprojection(CAMERA, random_segments(15, 5)).evaluate(poses, line)
    np.testing.assert_allclose(residual.evaluate(poses[residual.kept], line[residual.kept]), whole[[0, 2, 4]], rtol=1e-12)


def test_cameras_are_checked() -> None:
    segments = random_segments(17, 2)
    with pytest.raises(InputError, match="a lens bends straight lines: undistort the end points"):
        LineReprojection(Pinhole(400.0, 400.0, 300.0, 200.0, Radial(0.1, 0.0)), segments)
    with pytest.raises(InputError, match=r"a Pinhole, or K of shape \(3, 3\) or \(2, 3, 3\) – got shape \(3, 4\)"):
        LineReprojection(np.zeros((3, 4)), segments)
    with pytest.raises(InputError, match=r"divide K by K\[2, 2\]"):
        LineReprojection(np.stack([SKEWED, 2.0 * SKEWED]), segments)
    with pytest.raises(InputError, match=r"segments of shape \(N, 4\)"):
        LineReprojection(CAMERA, segments[:, :2])
