"""Several cameras, the judgement of a calibration, and what it must say of sessions that went wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from boxplus.errors import InputError
from boxplus.manifolds.body_pose import BodyPose
from boxplus.systems.camera_calibration.calibration import CameraCalibration, calibrate_cameras
from boxplus.systems.camera_calibration.config import CameraCalibrationConfig
from boxplus.systems.camera_calibration.corners import TargetCorners
from boxplus.systems.camera_calibration.findings import Finding, axis_focal, judge
from boxplus.systems.camera_calibration.one_camera import calibrate_camera
from boxplus.systems.camera_calibration.stereo import join
from boxplus.systems.camera_calibration.target import AprilGrid
from tests.systems.camera_calibration.sessions import GRID, LENSES, RADTAN, SIZE, T_CAM0_CAM1, session

FISHEYE = LENSES["pinhole-equi"]


def calibrate(
    corners: TargetCorners, target: AprilGrid = GRID, **settings: object
) -> tuple[CameraCalibration, dict[str, Finding]]:
    """A calibration and its findings by code."""
    found = calibrate_cameras(corners, target, CameraCalibrationConfig(**settings))
    return found, {finding.code: finding for finding in judge(found)}


@pytest.fixture(scope="module")
def stereo() -> TargetCorners:
    """A sound session of two cameras, moving."""
    return session(RADTAN, RADTAN, frames=16, rate_hz=4.0, seed=11).corners


@pytest.mark.slow
def test_a_sound_session_has_no_findings_and_the_mounting_of_the_truth(stereo: TargetCorners) -> None:
    found, findings = calibrate(stereo)
    assert found.lens == "pinhole-radtan" and not findings and found.rig is not None and found.rig_holds
    error = BodyPose.boxminus(found.rig.rig.T_body_camera[1], T_CAM0_CAM1).ravel()
    own = found.rig.mounting(1)
    assert error @ np.linalg.solve(found.rig.covariance[own, own], error) < chi2.ppf(0.999, 6)
    assert np.linalg.norm(error[3:]) < 5e-4
    assert found.on_target.share < 0.02 and max(image.share for image in found.images) < 0.05
    assert all(half < 2.0 for half in found.halves)


def test_what_holds_of_a_whole_rig_is_said_once_with_its_cameras(stereo: TargetCorners) -> None:
    found, _ = calibrate(stereo)
    rig = replace(found.rig, unconverged="no minimum was reached")
    (told,) = [one for one in judge(replace(found, rig=rig)) if one.code == "unconverged"]
    assert told.text == "cam0, cam1: no minimum was reached"
    alone = [replace(single, unconverged="no minimum was reached") for single in found.singles]
    single = judge(replace(found, rig=None, singles=type(found.singles)(alone)))
    assert [one.text for one in single if one.code == "unconverged"] == [f"cam{k}: no minimum was reached" for k in (0, 1)]


@pytest.mark.slow
def test_covariance_of_the_rig_is_that_of_the_errors() -> None:
    nees = []
    for seed in range(4):
        corners = session(RADTAN, RADTAN, seed=40 + seed, frames=10).corners
        singles = [calibrate_camera(corners.of_camera(camera), GRID.corners, "pinhole-radtan") for camera in (0, 1)]
        rig, _ = join(corners, GRID.corners, singles)
        assert rig is not None
        error = np.concatenate(
            [model.parameters - RADTAN.parameters for model in rig.rig.models]
            + [BodyPose.boxminus(rig.rig.T_body_camera[1], T_CAM0_CAM1).ravel()]
        )
        nees.append(float(error @ np.linalg.solve(rig.covariance, error)))
    low, high = chi2.ppf([0.005, 0.995], 22 * len(nees))
    assert low < sum(nees) < high


def test_frontal_views_are_refused_with_the_parameter_and_its_sigma() -> None:
    _, findings = calibrate(session(RADTAN, tilt_deg=0.0).corners, lens="pinhole-radtan")
    assert findings["focal_open"].severity == "refused" and findings["frontal"].severity == "doubt"
    assert "do not determine the focal length: fx " in findings["focal_open"].text and "±" in findings["focal_open"].text


@pytest.mark.slow
def test_a_wrong_lens_shows_in_the_pattern_of_residuals_and_the_right_one_is_named() -> None:
    corners = session(FISHEYE, seed=4).corners
    found, findings = calibrate(corners)
    assert found.lens == "pinhole-equi" and "lens_pattern" not in findings
    wrong, findings = calibrate(corners, lens="pinhole-radtan")
    assert findings["lens_pattern"].severity == "doubt" and "take --lens " in findings["lens_pattern"].text
    assert wrong.images[0].share > 0.2


def test_a_target_with_another_spacing_is_seen_but_not_one_of_another_size() -> None:
    corners = session(RADTAN, seed=6).corners
    _, findings = calibrate(corners, replace(GRID, spacing=0.27), lens="pinhole-radtan")
    assert findings["target_shape"].severity == "doubt"
    larger, findings = calibrate(corners, replace(GRID, tag_size=1.1 * GRID.tag_size), lens="pinhole-radtan")
    assert not {"target_shape", "lens_pattern", "target_size"} & set(findings)
    right, _ = calibrate(corners, lens="pinhole-radtan")
    np.testing.assert_allclose(
        larger.singles[0].rig.models[0].parameters, right.singles[0].rig.models[0].parameters, rtol=1e-4, atol=1e-6
    )


def test_cameras_that_do_not_look_together_are_not_mounted() -> None:
    found, findings = calibrate(session(RADTAN, RADTAN, late_s=(0.0, 0.003), seed=3).corners, lens="pinhole-radtan")
    assert findings["not_rigid"].severity == "doubt" and "not taken together" in findings["not_rigid"].text
    assert not found.rig_holds and found.of_camera(1) == (found.singles[1], 0)
    np.testing.assert_allclose(found.singles[0].rig.models[0].parameters[0], RADTAN.parameters[0], rtol=5e-3)


def test_a_camera_that_is_a_frame_late_is_named(stereo: TargetCorners) -> None:
    frame = np.where(stereo.camera_of == 1, stereo.frame_of + 1, stereo.frame_of)
    inside = frame < 16
    _, findings = calibrate(replace(stereo.rows(inside), frame_of=frame[inside]), lens="pinhole-radtan")
    assert findings["late"].severity == "doubt" and findings["late"].text.startswith("cam1 is 1 frame behind cam0")


def test_cameras_swapped_in_some_frames_are_named(stereo: TargetCorners) -> None:
    swapped = np.isin(stereo.frame_of, (4, 9))
    found, findings = calibrate(
        replace(stereo, camera_of=np.where(swapped, 1 - stereo.camera_of, stereo.camera_of)), lens="pinhole-radtan"
    )
    assert f"swapped in 2 frames ({stereo.names[4]}, {stereo.names[9]})" in findings["swapped"].text
    assert found.rig_holds


def test_cameras_swapped_throughout_stand_the_other_way_round(stereo: TargetCorners) -> None:
    _, findings = calibrate(replace(stereo, camera_of=1 - stereo.camera_of), lens="pinhole-radtan")
    assert "cam1 is 110 mm to the left of cam0" in findings["left_of_first"].text


def test_focal_length_on_the_axis_is_what_small_angles_show() -> None:
    for kind, model in LENSES.items():
        covariance = np.diag(np.linspace(0.1, 0.2, len(model.parameters)))
        focal, sigma = axis_focal(kind, model.parameters, covariance)
        J, by_intrinsics = model.project_with_jacobians([[0.0, 0.0, 1.0]])[1][0], np.zeros((2, len(model.parameters)))
        np.testing.assert_allclose(focal, [J[0, 0], J[1, 1]], rtol=1e-12)
        for k in range(len(model.parameters)):
            step = np.zeros(len(model.parameters))
            step[k] = 1e-6
            ends = [axis_focal(kind, model.parameters + sign * step, covariance)[0] for sign in (1.0, -1.0)]
            by_intrinsics[:, k] = (ends[0] - ends[1]) / 2e-6
        np.testing.assert_allclose(sigma**2, np.diag(by_intrinsics @ covariance @ by_intrinsics.T), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1])
def test_mirrored_images_are_told(axis: int) -> None:
    """They fit as well as the true ones: a plane seen from its back."""
    corners = session(RADTAN, frames=16, seed=12).corners
    assert "mirrored" not in calibrate(corners)[1]
    pixels = corners.pixels.copy()
    pixels[:, axis] = SIZE[axis] - 1.0 - pixels[:, axis]
    assert calibrate(replace(corners, pixels=pixels))[1]["mirrored"].severity == "doubt"


def test_few_views_and_little_coverage_are_said() -> None:
    corners = session(RADTAN, frames=6, seed=1).corners
    left = corners.rows(corners.pixels[:, 0] < 0.45 * SIZE[0])
    _, findings = calibrate(left, lens="pinhole-radtan")
    assert findings["few_views"].severity == findings["coverage"].severity == "remark"


def test_what_the_target_does_not_have_is_refused() -> None:
    corners = session(RADTAN).corners
    with pytest.raises(InputError, match=r"corners 0 to 35 of 3 x 3 tags .* got 0 to 63"):
        calibrate(corners, AprilGrid(3, 3, 0.1, 0.3))
    with pytest.raises(InputError, match="cameras that saw the target together"):
        two = session(RADTAN, RADTAN, frames=20, seed=2).corners
        calibrate(two.rows((two.frame_of % 2) == two.camera_of), lens="pinhole-radtan")


def test_corners_that_make_no_sense_are_refused() -> None:
    corners = session(RADTAN).corners
    outside = corners.pixels.copy()
    outside[3] = (800.0, 10.0)
    with pytest.raises(InputError, match=r"images of 752 x 480 px of camera 0 .* \(800.0, 10.0\) and 0 more outside"):
        replace(corners, pixels=outside)
    with pytest.raises(InputError, match="at most once in an image"):
        corners.rows(np.zeros(2, dtype=np.intp))
    with pytest.raises(InputError, match="camera_of from 0 to 0"):
        replace(corners, camera_of=corners.camera_of + 1)
