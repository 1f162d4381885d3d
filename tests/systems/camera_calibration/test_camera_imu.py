"""Camera and IMU before a target: mounting, clock, covariance, and the size of the target, which cameras cannot see."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from boxplus.errors import InputError
from boxplus.manifolds.body_pose import BodyPose
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.sensors.imu import ImuSamples
from boxplus.simulation.cameras.target_session import TargetSession
from boxplus.simulation.imu import ImuModel
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
