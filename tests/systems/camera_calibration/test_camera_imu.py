"""Camera and IMU before a target: mounting, clock, covariance, and the size of the target, which cameras cannot see."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from boxplus.errors import InputError
from boxplus.manifolds.body_pose import BodyPose
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.runs.camera_calibration.summary import ImuFacts, imu_facts
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation.cameras.target_session import TargetSession
from boxplus.simulation.imu import ImuModel
from boxplus.systems.camera_calibration import imu as imu_part
from boxplus.systems.camera_calibration.calibration import calibrate_cameras
from boxplus.systems.camera_calibration.config import CameraCalibrationConfig
from boxplus.systems.camera_calibration.findings import judge
from boxplus.systems.camera_calibration.imu import CameraImuCalibration, calibrate_imu
from tests.systems.camera_calibration.sessions import GRID, RADTAN, T_IMU_CAM0, session

MODEL = ImuModel()
NOISE = ImuNoise(MODEL.gyro_noise_density, MODEL.accel_noise_density, MODEL.gyro_bias_walk, MODEL.accel_bias_walk)
LATE_S = 0.0123


def moved(**settings: Any) -> TargetSession:
    return session(RADTAN, **{"frames": 80, "rate_hz": 5.0, "time_offset_s": LATE_S, **settings})


def mount(seen: TargetSession, imu: ImuSamples | None = None) -> CameraImuCalibration:
    return calibrate_imu(seen.corners, GRID.corners, RADTAN, 0.2, seen.imu if imu is None else imu, NOISE)


def error_of(found: CameraImuCalibration) -> np.ndarray:
    return np.append(BodyPose.boxminus(found.T_imu_camera, T_IMU_CAM0), found.time_offset_s - LATE_S)


def test_mounting_and_clock_are_found_with_their_covariance() -> None:
    nees = []
    for seed in range(5):
        found = mount(moved(seed=60 + seed))
        error = error_of(found)
        nees.append(float(error @ np.linalg.solve(found.covariance, error)))
        assert abs(found.scale - 1.0) < 5.0 * found.scale_sigma
        np.testing.assert_allclose(found.gravity_target, [0.0, -1.0, 0.0], atol=2e-3)
        np.testing.assert_allclose(found.bias_gyro, MODEL.gyro_bias, atol=1e-3)
        assert found.imu_chi2 < 1.2 and 0.8 < found.corner_chi2 < 1.2
    low, high = chi2.ppf([0.005, 0.995], 7 * len(nees))
    assert low < sum(nees) < high


def test_the_imu_sees_that_the_target_has_another_size() -> None:
    seen = moved(seed=1)
    target = replace(GRID, tag_size=0.95 * GRID.tag_size)
    found = calibrate_cameras(
        seen.corners, target, CameraCalibrationConfig(lens="pinhole-radtan", max_views=20), imu=seen.imu, noise=NOISE
    )
    assert found.imu is not None and abs(found.imu.scale - 1.0 / 0.95) < 0.003
    text = {finding.code: finding.text for finding in judge(found) if finding.severity == "doubt"}
    assert "a tag would have 0.0998 m instead of 0.095" in text["target_size"]


def test_a_session_with_too_many_frames_is_thinned_without_losing_links_and_the_part_is_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(imu_part, "_MOST_FRAMES", 40)
    found = mount(moved(seed=4, frames=200))  # 40 s at 5 Hz: 0.6 s apart these would be 67
    assert found.frames == 40 and found.session_s == pytest.approx(39.8)
    assert found.used_s == pytest.approx((0.0, 39 * 0.6))
    sigma = np.sqrt(np.diag(found.covariance))
    assert (np.abs(error_of(found)) < 5.0 * sigma).all() and sigma[3:6].max() < 0.01
    assert mount(moved(seed=4, frames=80)).used_s == pytest.approx((0.0, 15.6))  # every second


@given(st.lists(st.sampled_from([0.05, 0.2, 0.21, 0.59, 0.7, 3.0]), min_size=1, max_size=900))
def test_thinning_keeps_order_limit_and_links(steps: list[float]) -> None:
    time_ns = np.round(np.concatenate([[0.0], np.cumsum(steps)]) * 1e9).astype(np.int64)
    kept = imu_part._thinned(time_ns)
    assert len(kept) == min(len(kept), 400) and (np.diff(kept) > 0).all()
    gaps = np.diff(time_ns[kept]) > 0.6e9
    assert (np.diff(kept)[gaps] == 1).all()  # only where the session itself has a gap
    if len(time_ns) <= 400:
        assert len(kept) == len(time_ns)


def test_images_that_give_no_pose_are_counted_not_stumbled_over(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = moved(seed=5, frames=30)
    monkeypatch.setattr(imu_part, "target_pose", lambda *_: None)
    with pytest.raises(InputError, match=r"at least 20 images in which the corners give the pose .* got 0 of 30"):
        mount(seen)


def test_pairs_of_frames_between_gaps_have_a_sigma_that_says_how_little_they_tell() -> None:
    seen = moved(seed=6, frames=160)
    sigma = []
    for together in (2, 3):
        found = mount(replace(seen, corners=seen.corners.rows(seen.corners.frame_of % (together + 3) < together)))
        sigma.append(np.sqrt(np.diag(found.covariance)))
        assert np.isfinite(sigma[-1]).all() and (np.abs(error_of(found)) < 5.0 * sigma[-1]).all()
    # Two frames do not tell velocity and bias of the accelerometer from the lever arm: refused as open. Three do better.
    assert sigma[0][3:6].max() > 0.1 and (sigma[1] < 0.5 * sigma[0]).all()


def test_a_size_that_the_imu_does_not_measure_is_a_doubt() -> None:
    seen = moved(seed=1, frames=40)
    config = CameraCalibrationConfig(lens="pinhole-radtan", max_views=10)
    found = calibrate_cameras(seen.corners, GRID, config, imu=seen.imu, noise=NOISE)
    assert found.imu is not None and "size_open" not in {finding.code for finding in judge(found)}
    blind = replace(found, imu=replace(found.imu, scale=math.nan, scale_sigma=math.inf, session_s=100.0))
    said = {finding.code: finding for finding in judge(blind)}
    assert said["size_open"].severity == "doubt" and "measure the target" in said["size_open"].text
    assert "from 0 to 8 s of 100 s" in said["imu_part"].text
    wide = replace(found, imu=replace(found.imu, scale=0.2, scale_sigma=2.6))
    assert {finding.code: finding.severity for finding in judge(wide)}["size_open"] == "remark"
    facts = imu_facts(blind)
    assert facts is not None and facts.target_scale is None and ImuFacts.model_validate_json(facts.model_dump_json()) == facts


def test_an_imu_of_another_unit_contradicts_the_cameras() -> None:
    seen = moved(seed=2)
    found = mount(seen, ImuSamples.from_arrays(seen.imu.time_ns, 1.1 * seen.imu.gyro, seen.imu.accel))
    assert max(found.imu_chi2, found.corner_chi2) > 2.0


def test_what_cannot_be_compared_is_refused() -> None:
    seen = moved(seed=3)
    with pytest.raises(InputError, match=r"times of the images, .* got frame numbers alone"):
        mount(replace(seen, corners=replace(seen.corners, time_ns=None)))
    with pytest.raises(InputError, match=r"at least 20 images .* check that both are of one recording and one clock"):
        mount(seen, ImuSamples.from_arrays(seen.imu.time_ns + 10**11, seen.imu.gyro, seen.imu.accel))
    with pytest.raises(InputError, match=r"less than 0.6 s apart"):
        mount(moved(rate_hz=1.0, frames=40))
    with pytest.raises(InputError, match=r"the noise densities of the IMU"):
        calibrate_cameras(seen.corners, GRID, imu=seen.imu)
