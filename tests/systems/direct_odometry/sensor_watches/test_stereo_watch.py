"""What both cameras of a stereo pair see lies on epipolar lines, or the calibration is contradicted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.cameras.distortion import RadialTangential
from boxplus.cameras.pinhole import Pinhole
from boxplus.manifolds import se3
from boxplus.sensors.images.image import Image
from boxplus.systems.direct_odometry.depth.sensed_depth import StereoPair
from boxplus.systems.direct_odometry.sensor_watches.stereo_watch import StereoWatch
from tests.systems.direct_odometry.scenes import CAMERA, SHAPE, Room

T_RIGHT_LEFT = np.array([1.0, 0.0, 0.0, 0.0, -0.2, 0.0, 0.0])
LENS = replace(CAMERA, distortion=RadialTangential(-0.28, 0.07, 1e-4, 2e-5))


def watched(
    seed: int,
    camera: Pinhole,
    stated: Pinhole,
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
    late_s: float = 0.0,
    count: int = 6,
) -> StereoWatch:
    """Pairs of images in motion, with what is stated of the second camera, whose images are late."""
    rng, room = np.random.default_rng(seed), Room(seed)
    velocities = np.random.default_rng([seed, 1]).normal(size=(count, 6)) * [0.6, 0.6, 0.6, 0.3, 0.3, 0.3]
    pair = StereoPair(stated, se3.compose(se3.exp([*turn, 0.0, 0.0, 0.0]), T_RIGHT_LEFT))
    watch = StereoWatch(pair)
    for velocity in velocities:
        T = se3.exp(np.concatenate([0.3 * rng.normal(size=3), 0.2 * rng.normal(size=3)]))
        later = se3.compose(T, se3.exp(late_s * velocity))
        grey = [room.render(pose, camera)[0] for pose in (T, se3.compose(later, se3.inverse(T_RIGHT_LEFT)))]
        left, right = (Image.from_array(each + rng.normal(0.0, 1.5, SHAPE)) for each in grey)
        watch.add(left, right, pair.depth(left, right, camera), camera, velocity)
    return watch


@pytest.mark.slow
@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("seed", range(3))
def test_a_right_calibration_is_not_contradicted(seed: int, camera: Pinhole) -> None:
    watch = watched(seed, camera, camera)
    assert watch.contradiction == ""
    for found in (watch._found, watch._found_late):
        q, sigma = found.estimate()
        assert (np.abs(q) < 5.0 * sigma + 2e-4).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_what_is_off_is_named(seed: int) -> None:
    assert (
        "focal length of the second camera that is stated +"
        in watched(seed, CAMERA, replace(CAMERA, fx=156.0, fy=156.0)).contradiction
    )
    assert "about the baseline" in watched(seed, CAMERA, CAMERA, (np.radians(0.3), 0.0, 0.0)).contradiction
    assert "about its axis" in watched(seed, CAMERA, CAMERA, (0.0, 0.0, np.radians(0.8))).contradiction


@pytest.mark.slow
@pytest.mark.parametrize("late_s", [0.006, -0.006])
@pytest.mark.parametrize("seed", range(2))
def test_second_images_that_are_late_are_named(seed: int, late_s: float) -> None:
    contradiction = watched(seed, CAMERA, CAMERA, late_s=late_s, count=60).contradiction
    assert f"a second image that is taken {'+' if late_s > 0.0 else '-'}" in contradiction


def test_a_camera_that_rests_tells_no_times() -> None:
    rng, room = np.random.default_rng(1), Room(1)
    pair = StereoPair(CAMERA, T_RIGHT_LEFT)
    watch = StereoWatch(pair)
    grey = [room.render(T)[0] for T in (se3.exp(np.zeros(6)), se3.inverse(T_RIGHT_LEFT))]
    left, right = (Image.from_array(each + rng.normal(0.0, 1.5, SHAPE)) for each in grey)
    for velocity in (np.zeros(6), None):
        watch.add(left, right, pair.depth(left, right, CAMERA), CAMERA, velocity)
    assert watch.contradiction == "" and (watch._found.frames, watch._found_late.frames) == (2, 0)


def test_nothing_seen_contradicts_nothing() -> None:
    assert StereoWatch(StereoPair(CAMERA, T_RIGHT_LEFT)).contradiction == ""
