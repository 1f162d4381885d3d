"""The judge of a frame, without images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from boxplus.errors import SingularProblemError
from boxplus.systems.visual_inertial_odometry import VioConfig
from boxplus.systems.visual_inertial_odometry.beginning import covariance_of
from boxplus.systems.visual_inertial_odometry.corners.partners import Partners
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks
from boxplus.systems.visual_inertial_odometry.health import Health, position_sigma
from boxplus.systems.visual_inertial_odometry.observations import Fit


def frame(k: int, corners: int = 40) -> Tracks:
    grey = np.array([100.0])
    pixels = np.zeros((corners, 1, 2))
    return Tracks(
        k * 50_000_000,
        np.arange(corners),
        pixels,
        np.ones((corners, 1, 3)),
        np.zeros(corners, np.bool_),
        {},
        3.0,
        grey,
        0.4 * grey,
    )


def fit(imu_ratio: float = 0.3) -> Fit:
    return Fit(40, 0, np.zeros(0, np.int64), 0.2, imu_ratio)


def judged(health: Health, imu_ratio: float, frames: int, position_sigma: float = 0.01) -> list[str]:
    return [health.judge(frame(k), fit(imu_ratio), False, 0.005, position_sigma)[0] for k in range(1, frames + 1)]


def test_an_imu_within_its_noise_is_ok_and_one_that_goes_on_beyond_it_a_contradiction() -> None:
    sound, off = Health(VioConfig()), Health(VioConfig())
    for health in (sound, off):
        health.begin(0)
    assert set(judged(sound, 0.7, 80)) == {"ok"} and sound.contradiction is None
    statuses = judged(off, 1.6, 80)
    assert statuses[0] == "ok" and statuses[-1] == "weak"
    assert off.contradiction is not None and "the IMU disagrees with the cameras" in off.contradiction


def test_landmarks_that_are_elsewhere_name_the_baseline_where_there_is_one() -> None:
    wrong = Fit(10, 30, np.zeros(0, np.int64), 0.2, 0.3)
    for cameras, named in ((1, False), (2, True)):
        health = Health(VioConfig())
        health.begin(0)
        for k in range(1, 80):
            tracks = frame(k)
            seen = replace(tracks, pixels=np.zeros((40, cameras, 2)))
            health.judge(seen, wrong, False, 0.005, 0.01)
        assert health.contradiction is not None and "of the landmarks seen are not where they should be" in health.contradiction
        assert ("baseline" in health.contradiction) == named


def test_corners_that_a_second_camera_does_not_find_contradict_and_no_judgement_does_not() -> None:
    for partners, named in ((Partners(0.03), True), (Partners(0.6), False), (None, False)):
        health = Health(VioConfig())
        health.begin(0)
        for k in range(1, 80):
            health.judge(replace(frame(k), partners=partners), fit(), False, 0.005, 0.01)
        assert (health.contradiction is not None) == named
        assert not named or "of the corners are found in a second camera" in str(health.contradiction)


def test_a_pose_that_nothing_determines_is_lost() -> None:
    class Open:
        def joint_covariance(self, *_: object, is_determined: bool) -> np.ndarray:
            raise SingularProblemError("pivot")

    covariance = covariance_of(Open(), None, None)  # type: ignore[arg-type]
    assert np.linalg.eigvalsh(covariance)[0] > 0.0
    health = Health(VioConfig())
    health.begin(0)
    status, reasons = health.judge(frame(1), fit(), False, 0.005, position_sigma(covariance))
    assert status == "lost" and "does not determine the pose" in reasons[0]


def test_a_gap_of_the_imu_that_images_do_not_bridge_tears_the_path() -> None:
    bridged, torn = Health(VioConfig()), Health(VioConfig())
    for health, sigma in ((bridged, 0.05), (torn, 9.0)):
        health.begin(0)
        status, reasons = health.judge(frame(1), fit(), False, 1.94, sigma)
        assert status == "weak" and "the IMU was silent for 1.94 s" in reasons[0]
    assert bridged.contradiction is None
    assert torn.contradiction is not None
    assert "a gap of 1.94 s in the IMU" in torn.contradiction and "is known to 9.0 m" in torn.contradiction
