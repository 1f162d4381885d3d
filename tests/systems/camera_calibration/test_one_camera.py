"""One camera before a target: start without a guess, estimate, covariance, and the views that do not suffice."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from scipy.stats import chi2

from boxplus.errors import InputError
from boxplus.manifolds import se3
from boxplus.manifolds.body_pose import BodyPose
from boxplus.optimization.jacobian_check import check_jacobian
from boxplus.residuals.camera.on_body import OnBody
from boxplus.residuals.camera.reprojection_intrinsics import ReprojectionIntrinsics
from boxplus.systems.camera_calibration.lens import LENSES as KINDS
from boxplus.systems.camera_calibration.lens import LensKind
from boxplus.systems.camera_calibration.one_camera import calibrate_camera
from boxplus.systems.camera_calibration.start import reprojection_errors, starting_lenses, target_pose
from boxplus.systems.camera_calibration.target import AprilGrid
from tests.systems.camera_calibration.sessions import GRID, LENSES, RADTAN, SIZE, session

PLACES = GRID.corners


def test_corners_of_the_grid_are_those_of_kalibr() -> None:
    grid = AprilGrid(rows=2, columns=3, tag_size=0.1, spacing=0.5)
    assert grid.count == 24
    np.testing.assert_allclose(grid.corners[:4, :2], [[0, 0], [0.1, 0], [0.1, 0.1], [0, 0.1]], atol=1e-15)
    np.testing.assert_allclose(grid.corners[4 * 2, :2], [0.3, 0.0], atol=1e-15)  # the third tag of the first row
    np.testing.assert_allclose(grid.corners[4 * 3 + 2, :2], [0.1, 0.25], atol=1e-15)  # above the first one
    with pytest.raises(InputError, match="tag_size positive"):
        AprilGrid(rows=2, columns=3, tag_size=0.0, spacing=0.3)


@pytest.mark.parametrize("kind", KINDS)
def test_every_lens_is_linearised_as_differences_say(kind: LensKind) -> None:
    rng, model = np.random.default_rng(0), LENSES[kind]
    count = 12
    p_camera = rng.uniform([-0.6, -0.4, 0.5], [0.6, 0.4, 1.5], (count, 3))
    body, mounting = BodyPose.random(rng, count), BodyPose.random(rng, count)
    p_target = se3.act(se3.compose(body, mounting), p_camera)
    pixels = model.project(p_camera)[0] + rng.normal(0.0, 30.0, (count, 2))
    residual = OnBody(ReprojectionIntrinsics(model, pixels))
    assert check_jacobian(residual, body, mounting, p_target, np.tile(model.parameters, (count, 1))).passed


@pytest.mark.parametrize("kind", KINDS)
def test_a_view_gives_the_pose_through_any_lens_and_past_wrong_corners(kind: LensKind) -> None:
    rng, model = np.random.default_rng(1), LENSES[kind]
    seen = session(model, frames=6, sigma_px=0.0, seed=3)
    for frame in range(6):
        rows = seen.corners.frame_of == frame
        pixels, places = seen.corners.pixels[rows], PLACES[seen.corners.corner_of[rows]]
        T = target_pose(model, pixels, places)
        assert T is not None
        np.testing.assert_allclose(se3.act(T, places), se3.act(target_pose(model, pixels, places), places))
        assert reprojection_errors(model, T, pixels, places).max() < 1e-6
        wrong = pixels.copy()
        wrong[:3] += rng.normal(0.0, 40.0, (3, 2))
        T_robust = target_pose(model, wrong, places)
        assert T_robust is not None and np.median(reprojection_errors(model, T_robust, pixels, places)) < 1.5
    assert target_pose(model, pixels[:4], places[:4]) is None


def test_the_start_finds_the_focal_length_without_a_guess() -> None:
    seen = session(RADTAN, frames=10).corners
    views = [(seen.pixels[rows], PLACES[seen.corner_of[rows]]) for rows in (seen.frame_of == frame for frame in range(10))]
    (_, best), *_ = starting_lenses("pinhole-radtan", SIZE, views, 3)
    assert 0.7 < best.parameters[0] / RADTAN.parameters[0] < 1.4


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "seeds"), [("pinhole-radtan", 8), ("pinhole-equi", 4), ("ds-none", 4)])
def test_covariance_is_that_of_the_errors(kind: LensKind, seeds: int) -> None:
    model = LENSES[kind]
    nees = []
    for seed in range(seeds):
        found = calibrate_camera(session(model, seed=seed).corners, PLACES, kind)
        error = found.rig.models[0].parameters - model.parameters
        nees.append(float(error @ np.linalg.solve(found.covariance, error)))
        assert abs(found.sigma_px / 0.2 - 1.0) < 0.1
    low, high = chi2.ppf([0.005, 0.995], len(error) * seeds)
    assert low < sum(nees) < high


def test_outliers_are_left_out_and_named_and_do_not_matter() -> None:
    corners = session(RADTAN, frames=20, seed=5).corners
    rng = np.random.default_rng(0)
    wrong = rng.random(len(corners.pixels)) < 0.04
    moved = corners.pixels.copy()
    moved[wrong] = np.clip(moved[wrong] + rng.normal(0.0, 12.0, (wrong.sum(), 2)), 0.0, np.array(SIZE) - 1.0)
    spoiled = corners.rows(np.arange(len(moved)))
    object.__setattr__(spoiled, "pixels", moved)
    clean, found = (calibrate_camera(seen, PLACES, "pinhole-radtan") for seen in (corners, spoiled))
    large = wrong & (np.linalg.norm(moved - corners.pixels, axis=1) > 2.0)
    assert not found.kept[large].any() and (~found.kept[~wrong]).sum() <= 2
    sigma = np.sqrt(np.diag(clean.covariance))
    assert (np.abs(found.rig.models[0].parameters - clean.rig.models[0].parameters) < 1.5 * sigma).all()


def test_views_that_face_the_target_have_a_focal_length_with_a_sigma_that_says_so() -> None:
    shares = []
    for seen in (session(RADTAN, tilt_deg=0.0), session(RADTAN)):
        found = calibrate_camera(seen.corners, PLACES, "pinhole-radtan")
        shares.append(np.sqrt(np.diag(found.covariance))[:2] / found.rig.models[0].parameters[:2])
    assert shares[0].max() > 0.2 and shares[1].max() < 0.005


def test_too_few_views_are_refused() -> None:
    with pytest.raises(InputError, match=r"at least 4 views with 12 corners .* got 3 of camera 0 .* 20 to 60 views"):
        calibrate_camera(session(RADTAN, frames=3).corners, PLACES, "pinhole-radtan")


@pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="OpenCV (extra `vision`) is not installed")
def test_the_minimum_is_that_of_opencv() -> None:
    import cv2

    seen = session(RADTAN, frames=16, seed=2).corners
    found = calibrate_camera(seen, PLACES, "pinhole-radtan")
    assert found.kept.all()
    views = [seen.frame_of == frame for frame in range(16)]
    flags = cv2.CALIB_FIX_K3
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 200, 1e-14)
    rms, K, distortion, _, _ = cv2.calibrateCamera(
        [PLACES[seen.corner_of[rows]].astype(np.float32) for rows in views],
        [seen.pixels[rows].astype(np.float32) for rows in views],
        SIZE, None, None, flags=flags, criteria=criteria,
    )  # fmt: skip
    theirs = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.ravel(distortion)[:4]])
    sigma = np.sqrt(np.diag(found.covariance))
    assert (np.abs(found.rig.models[0].parameters - theirs) < 0.02 * sigma).all()  # float32 in, one minimum out
    assert found.rms_px() == pytest.approx(rms, rel=1e-4)
